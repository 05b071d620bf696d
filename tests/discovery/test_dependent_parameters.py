"""Parameters that depend on a state or an input: what they add, which are asked, what they promise, what is said of them."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from linear_plant import DT, recording

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.acceptance import gated_selection, with_interactions
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.trials import Search
from simpel_cli.discovery.search.unexplained.dependent_parameters import dependent_parameters, slopes_of
from simpel_cli.discovery.search.unexplained.function_screening import changed_by
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.verdict.remainder import left_in_words, remainder_of
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.augmented import augment
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression, Scales, dependent
from simulators.model import Declared, Model

FRICTION = Expression("friction", acts_on="v", term="-c*v*w", parameters={
    "c": {"range": [0, 2], "unit": "1/s"}, "w": {"range": [0.5, 2], "unit": "1", "neutral": 1.0},
})  # fmt: skip
RATE = 0.6  # of the loss of the warmer node, 1/s
ROWS, NOISE = 40, 0.02


def swing() -> Model:
    return Declared(
        "swing", dt=DT,
        states={"angle": {"unit": "rad", "range": [-3.2, 3.2], "periodic": True}, "v": {"unit": "rad/s", "range": [-5, 5]}},
        inputs={"u": {"unit": "V", "range": [-3, 3]}},
        parameters={
            "g": {"unit": "1/s^2", "range": [1, 3]}, "b": {"unit": "1/s^2/V", "range": [0.8, 1.8]},
            "d": {"unit": "1/s", "range": [0.1, 0.9]}, "c": {"unit": "1/s^2", "range": [-1, 1]},
        },
        dynamics={"angle": "v", "v": "b*u - g*sin(angle) - d*v*abs(u) + c"},
    ).model()  # fmt: skip


def scales_of(model: Model) -> Scales:
    return Scales({q.name: 2.0 for q in (*model.states, *model.inputs)}, {q.name: 1.0 for q in model.states}, DT)


def test_what_depends_on_a_quantity_is_added_to_the_parameter_of_the_model_and_of_an_effect() -> None:
    """Against the rates at the parameters that it comes to, row by row."""
    model, random = swing(), np.random.default_rng(0)
    (friction,) = FRICTION.attach(model, scales_of(model), ["angle", "v"])
    loss = dependent(model, scales_of(model), "d", "v", "1/s", 0.5, 3)
    size = dependent(model, scales_of(model), friction.parameters[0].name, "angle", "1/s", 0.5, 4)
    augmented = augment(model, [friction, loss, size], ["angle", "v"])
    names = [q.name for q in augmented.params]
    p = random.uniform(0.1, 0.9, len(names))
    for constant, value in loss.constants:
        p[names.index(constant)] = value
    for _ in range(5):
        x, u = random.uniform(-2, 2, 2), random.uniform(-2, 2, 1)
        known = dict(zip(names, p, strict=True))
        # sines of a box of half width 1.3 sizes of 2; harmonics of an angle
        waves = [np.sin(np.pi * j / 2 * (x[1] / 2.6 + 1)) for j in (1, 2, 3)]
        loss_here = known["d"] + sum(known[k.name] * w for k, w in zip(loss.parameters, waves, strict=True))
        turns = [np.sin(x[0]), np.cos(x[0]), np.sin(2 * x[0]), np.cos(2 * x[0])]
        of_friction = [k.name for k in friction.parameters]
        size_here = known[of_friction[0]] + sum(known[k.name] * w for k, w in zip(size.parameters, turns, strict=True))
        wanted = known["b"] * u[0] - known["g"] * np.sin(x[0]) - loss_here * x[1] * abs(u[0]) + known["c"]
        wanted -= size_here * x[1] * known[of_friction[1]]
        np.testing.assert_allclose(np.asarray(augmented.function(x, u, p)[0]).ravel(), [x[1], wanted], rtol=1e-12)


def test_the_rates_that_a_parameter_changes_and_what_their_slopes_depend_on() -> None:
    model = swing()
    (friction,) = FRICTION.attach(model, scales_of(model), ["angle", "v"])
    augmented = augment(model, [friction], ["angle", "v"])
    slopes = slopes_of(augmented)
    size, shape = (k.name for k in friction.parameters)
    assert slopes.arguments["b"] == {"v": {"u"}}
    assert slopes.arguments["g"] == {"v": {"angle"}}
    assert slopes.arguments["d"] == {"v": {"v", "u"}}
    assert slopes.arguments["c"] == {"v": frozenset()}
    assert slopes.arguments[size] == {"v": {"v"}}
    assert {"b", "g", "d", "c", size, shape} <= slopes.linear
    quadratic = Expression("hinge", acts_on="v", term="-k*max(v - e, 0)", parameters={
        "k": {"range": [0, 2], "unit": "1/s"}, "e": {"range": [0, 2], "unit": "rad/s", "neutral": 1.0},
    })  # fmt: skip
    (hinge,) = quadratic.attach(model, scales_of(model), ["angle", "v"])
    linear = slopes_of(augment(model, [hinge], ["angle", "v"])).linear
    assert [k.label for k in hinge.parameters if k.name in linear] == ["k"]


def two_nodes() -> Model:
    """A node that warms a second one, which loses `a` of what it is warmer than its surroundings."""
    return Declared(
        "nodes", dt=DT,
        states={"first": {"unit": "degC", "range": [-3, 5]}, "second": {"unit": "degC", "range": [-3, 5]}},
        inputs={"u": {"unit": "1", "range": [-3, 3]}},
        parameters={"k": {"unit": "degC/s", "range": [0.5, 1.5]}, "a": {"unit": "1/s", "range": [0.2, 1.2]}},
        dynamics={"first": "k*u - 0.5*first", "second": "0.8*first - a*second"},
    ).model()  # fmt: skip


def warmed(share: float, seed: int) -> Recording:
    """Episodes in which the second node's loss grows by `share` of itself with each degree of the first."""
    random, fine, episodes = np.random.default_rng(seed), 40, []
    for k in range(7):
        x, states, inputs = random.normal(size=2), [], 0.6 + random.normal(size=ROWS).repeat(4)[:ROWS]
        for u in inputs:
            states.append(x)
            for _ in range(fine):
                loss = RATE * (1 + share * x[0])
                x = x + DT / fine * np.array([u - 0.5 * x[0], 0.8 * x[0] - loss * x[1]])
        measured = np.array(states) + NOISE * random.normal(size=(ROWS, 2))
        episodes.append(Episode(f"{k}", np.arange(ROWS) * DT, measured, inputs[:, None], np.zeros((ROWS, 0))))
    noise = {"first": NOISE, "second": NOISE}
    return Recording(tuple(episodes[:5]), tuple(episodes[5:]), (), noise, (), (Check("c", True, ""),), ())


OVERFLOW = Expression("overflow", acts_on="second", term="-c*max(second - e, 0)", parameters={
    "c": {"range": [0, 1], "unit": "1/s"}, "e": {"range": [-1, 3], "unit": "degC", "neutral": 3.0, "starts": [0.0, 1.0]},
})  # fmt: skip


def test_functions_of_one_argument_are_not_asked_again() -> None:
    plan = setup(swing(), recording_of_swing(), (), [FRICTION], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=12))
    base = search.base()
    asked = {(t.acts_on, *t.depends_on) for t in dependent_parameters(search, base, plan.scales, 2)}
    # b u of u, g sin(angle) of the angle, and whatever c depends on, are forces of one argument
    assert asked == {("b", "angle"), ("b", "v"), ("g", "v"), ("g", "u"), ("d", "angle"), ("d", "v"), ("d", "u")}
    chosen = search.best((0,), search.fitter(search.hypotheses((0,), 0, base.optimum.z)))
    size, shape = (k.name for k in search.terms[0].parameters)
    more = {(t.acts_on, *t.depends_on) for t in dependent_parameters(search, chosen, plan.scales, 2)} - asked
    assert more == {(size, "angle"), (size, "u"), (shape, "angle"), (shape, "u")}


def recording_of_swing() -> Recording:
    """Of another plant with the same columns: only magnitudes are read off it."""
    return recording()


@pytest.mark.parametrize(("share", "seed"), [(0.25, 0), (0.25, 1), (0.0, 0)])
def test_a_loss_that_depends_on_another_node_is_said_to_be_that(tmp_path: Path, share: float, seed: int) -> None:
    """An overflow does much of it, as long as nobody asks: it gives way. Where nothing is missing, nothing is said."""
    attach = partial(setup, two_nodes(), warmed(share, seed), (), [OVERFLOW], 2)
    plan = attach()
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=10))
    assessor, terminal = Assessor(plan, 10), Terminal(True, tmp_path / "run.log")
    selection, gates, _ = gated_selection(search, assessor, select(search), terminal)
    chosen, alone = (NoiseProfile(search, assessor, t) for t in (selection.chosen, selection.base))
    left, gates = with_interactions(chosen, alone, selection, gates, attach, Discovery(), terminal)
    assert gates == []
    assert left.chosen.terms == ()
    if not share:
        assert left.remainder is None
        return
    assert [search.terms[t].effect for t in selection.chosen.terms] == ["overflow"]
    found = remainder_of(search, left, None, assessor(left.chosen.optimum.z, plan.windows))
    assert (found["parameter"], found["depends_on"], found["acts_on"]) == ("a", ["first"], "second")
    assert found["log_evidence_gain"] > 20
    assert left_in_words(found) == "A parameter is no constant: a depends on first"


def test_a_parameter_that_acts_on_two_rates_changes_both() -> None:
    model = Declared(
        "two", dt=DT,
        states={"a": {"unit": "m", "range": [-3, 3]}, "b": {"unit": "m", "range": [-3, 3]}},
        parameters={"k": {"unit": "1/s", "range": [0.5, 1.5]}, "m": {"unit": "1/s", "range": [0.5, 1.5]}},
        dynamics={"a": "-k*(a - b)", "b": "k*(a - b) - m*b"},
    ).model()  # fmt: skip
    term, other = (dependent(model, scales_of(model), name, "b", "1/s", 1.0, 2) for name in "km")
    assert changed_by(augment(model, [term], ["a", "b"]), term) == ["a", "b"]
    assert changed_by(augment(model, [other], ["a", "b"]), other) == ["b"]
