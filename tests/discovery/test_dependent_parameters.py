"""Parameters that depend on a state or an input: what they add, which are asked, what they promise, what is said of them."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import casadi
import numpy as np
import pytest
from linear_plant import DT, LOAD, recording

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.acceptance import gated_selection, with_interactions
from simpel_cli.discovery.search.gate.held_out import gates as gates_of
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.discovery.search.unexplained import interactions
from simpel_cli.discovery.search.unexplained.dependent_parameters import dependent_parameters, label_of, slopes_of
from simpel_cli.discovery.search.unexplained.function_screening import Promise, changed_by
from simpel_cli.discovery.search.unexplained.interactions import _settled
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.verdict import remainder
from simpel_cli.discovery.verdict.remainder import left_in_words, remainder_of
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.augmented import augment
from simpel_cli.filtering.likelihood.coordinates import CUT, Coordinates
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.likelihood.sensitivity import shifts, waves
from simpel_cli.filtering.setup import setup
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression, Scales, Term, dependent
from simulators.groups import MEMBER, SPREAD
from simulators.model import Declared, Model
from simulators.quantity import Quantity

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
    loss = dependent(model, scales_of(model), ("d", "d"), "v", "1/s", 0.5, 3)
    size = dependent(model, scales_of(model), (friction.parameters[0].name, "c"), "angle", "1/s", 0.5, 4)
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
    hinged = Expression("hinge", acts_on="v", term="-k*max(v - e, 0)", parameters={
        "k": {"range": [0, 2], "unit": "1/s"}, "e": {"range": [0, 2], "unit": "rad/s", "neutral": 1.0},
    })  # fmt: skip
    (hinge,) = hinged.attach(model, scales_of(model), ["angle", "v"])
    linear = slopes_of(augment(model, [hinge], ["angle", "v"])).linear
    assert [k.label for k in hinge.parameters if k.name in linear] == ["k"]


@pytest.mark.parametrize("symbol", [casadi.SX, casadi.MX])
def test_a_mass_that_cancels_out_of_a_weight_is_no_function_of_the_angle(symbol: type) -> None:
    """And its slope is one of the input alone: as a function of the input it is a force of one argument."""
    names = {"phi": (-3.2, 3.2), "omega": (-9, 9)}
    model = Model(
        name="pendulum", dt=DT, substeps=1, outputs=(), gap={}, output=lambda x, u, p: symbol(0, 1), symbol=symbol,
        states=tuple(Quantity(n, u, *r) for (n, r), u in zip(names.items(), ("rad", "rad/s"), strict=True)),
        inputs=(Quantity("u", "V", -3, 3),), params=(Quantity("m", "kg", 0.6, 1.4), Quantity("g", "m/s^2", 9, 10)),
        rhs=lambda x, u, p: casadi.vertcat(x[1], (p[0] * p[1] * casadi.sin(x[0]) + u[0]) / p[0]),
    )  # fmt: skip
    slopes = slopes_of(augment(model, [], ["phi", "omega"]))
    assert slopes.arguments == {"m": {"omega": {"u"}}, "g": {"omega": {"phi"}}}
    assert slopes.linear == {"g"}


def nodes(parameter: str, first: str, second: str) -> Model:
    """Two nodes that warm each other, with a coefficient of that name and the loss `a` of the second one."""
    both = {"unit": "degC", "range": [-3, 5]}
    return Declared(
        "nodes", dt=DT, states={"first": both, "second": both}, inputs={"u": {"unit": "1", "range": [-3, 3]}},
        parameters={name: {"unit": "1/s", "range": [0.2, 1.5]} for name in (parameter, "a")},
        dynamics={"first": first, "second": second},
    ).model()  # fmt: skip


two_nodes = partial(nodes, "h", "h*u - 0.5*first", "0.8*first - a*second")
exchange = partial(nodes, "k", "u - k*(first - second)", "k*(first - second) - a*second")  # k acts on both rates


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
    asked = {(t.acts_on, *t.depends_on) for t in dependent_parameters(search, base, [2])}
    # b u of u, g sin(angle) of the angle, and whatever c depends on, are forces of one argument
    assert asked == {("b", "angle"), ("b", "v"), ("g", "v"), ("g", "u"), ("d", "angle"), ("d", "v"), ("d", "u")}
    chosen = search.best((0,), search.fitter(search.hypotheses((0,), 0, base.optimum.z)))
    size, shape = (k.name for k in search.terms[0].parameters)
    more = {(t.acts_on, *t.depends_on) for t in dependent_parameters(search, chosen, [2])} - asked
    assert more == {(size, "angle"), (size, "u"), (shape, "angle"), (shape, "u")}


def recording_of_swing() -> Recording:
    """Of another plant with the same columns: only magnitudes are read off it."""
    return recording()


@pytest.mark.parametrize(("share", "seed"), [(0.25, 0), (0.25, 1), (0.0, 0)])
def test_a_loss_that_depends_on_another_node_is_said_to_be_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float, seed: int
) -> None:
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
    # where held-out errors grow with it in place of the overflow, that stays
    refused = lambda *given: [g._replace(harm=i > 0) for i, g in enumerate(gates_of(*given))]  # noqa: E731
    monkeypatch.setattr(interactions, "gates", refused)
    beside = interactions.interaction(chosen, alone, attach, 4)
    assert beside is None or beside.kept == (0,)
    # in the place of effects a function has to earn what any function has to, beside them what one of so many has to
    going, least = interactions._screened(chosen, alone, 0.0)
    assert least > ACCEPT + np.log(3)
    monkeypatch.setattr(interactions, "gates", gates_of)
    monkeypatch.setattr(interactions, "_screened", lambda *_: (going, 1e6))
    assert interactions.interaction(chosen, alone, attach, 4).kept == ()
    assert interactions.interaction(chosen, alone, attach, 4, known=1e6) is None


def test_a_parameter_that_acts_on_two_rates_changes_both() -> None:
    model = exchange()
    term, other = (dependent(model, scales_of(model), (name, name), "second", "1/s", 1.0, 2) for name in "ka")
    assert [*changed_by(augment(model, [term], ["first", "second"]), term)] == ["first", "second"]
    assert [*changed_by(augment(model, [other], ["first", "second"]), other)] == ["second"]


def test_what_a_parameter_of_two_rates_does_to_the_innovations() -> None:
    """Against differences of a filter whose program carries the function, on measurements that the model predicts."""
    data = warmed(0.0, 0)
    first = setup(exchange(), data, (), [], 2)
    term = dependent(exchange(), first.scales, ("k", "k"), "second", "1/s", 1.0, 2)
    plan = setup(exchange(), data, (), [], 2, extra=[term])
    assessor, z, names = Assessor(plan, 3), plan.start, [q.name for q in plan.augmented.params]
    y = np.asarray(assessor(z, plan.windows._replace(ok=0 * plan.windows.ok)).track.predicted)
    windows = plan.windows._replace(y=y)
    track = assessor(z, windows).track
    inputs = windows.u[:, plan.lead : plan.lead + y.shape[1]]
    p = np.array([plan.coordinates.value(i, z[i]) for i in range(len(names))])
    following = np.roll(track.predicted, -1, axis=1)
    rows = [["first", "second"].index(state) for state in changed_by(plan.augmented, term)]
    forces = waves(plan.augmented, [term], p, [(np.asarray(track.mean), inputs), (following, inputs)], rows)
    found = shifts(track, windows.ok > 0, forces, DT)
    one_alone = shifts(track, windows.ok > 0, {0: forces[0]}, DT)
    for n, row in enumerate(plan.augmented.rows(term)):
        step = np.zeros_like(z)
        step[row] = 1e-4 / (2 * CUT)  # of a standard deviation
        ahead, back = (np.asarray(assessor(z + s, windows).track.innovation) for s in (step, -step))
        change = (ahead - back) / 2e-4 * (windows.ok > 0)
        assert np.linalg.norm(found[..., n] - change) < 0.06 * np.linalg.norm(change)
        assert np.linalg.norm(one_alone[..., n] - change) > 0.5 * np.linalg.norm(change)


def test_a_parameter_of_two_rates_is_asked_as_a_function_of_any_one_argument() -> None:
    """No force on one rate can stand for it; the loss `a` as a function of `second` is one. What is not free is not asked."""
    plan = setup(nodes("k", "u - k*first", "k*first - a*second"), warmed(0.0, 0), (), [], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=8))
    base = search.base()
    asked = {(t.acts_on, *t.depends_on) for t in dependent_parameters(search, base, [2])}
    assert asked == {("k", "first"), ("k", "second"), ("k", "u"), ("a", "first"), ("a", "u")}
    of_both = next(t for t in dependent_parameters(search, base, [2]) if t.acts_on == "k")
    said = remainder._dependent(search, base, of_both, 5.0)  # its slopes are equal: it acts where rates are small
    assert said["acts_on"] == min(("first", "second"), key=plan.scales.rate.__getitem__)
    still = base._replace(optimum=base.optimum._replace(free=base.optimum.free[1:]))
    assert {t.acts_on for t in dependent_parameters(search, still, [2])} == {"a"}


class _Pruning(Search):
    """A search of which it is known what stays: places of terms."""

    def __init__(self, terms: list[Term], *stays: int) -> None:
        self.terms, self.stays = terms, stays

    def prune(self, whole: Trial) -> tuple[Trial, tuple[float, ...], list[Trial]]:
        return whole._replace(terms=self.stays), (), []


def test_effects_beside_a_function_go_where_they_earn_nothing_but_not_the_one_that_it_is_a_part_of() -> None:
    model = swing()
    (friction,) = FRICTION.attach(model, scales_of(model), ["angle", "v"])
    (load,) = LOAD.attach(model, scales_of(model), ["angle", "v"])
    name = friction.parameters[0].name
    function = dependent(model, scales_of(model), (name, "c of friction on v"), "angle", "1/s", 0.5, 2)
    of_model = dependent(model, scales_of(model), ("d", "d"), "angle", "1/s", 0.5, 2)
    whole = Trial((0, 1, 2), None)
    assert [t.terms for t in _settled(_Pruning([friction, load, function], 0, 2), whole)] == [(0, 2), (0, 1, 2)]
    assert [t.terms for t in _settled(_Pruning([friction, load, function], 1, 2), whole)] == [(0, 1, 2)]
    assert [t.terms for t in _settled(_Pruning([friction, load, of_model], 2), whole)] == [(2,), (0, 1, 2)]
    assert [t.terms for t in _settled(_Pruning([friction, load, of_model], 0, 1), whole)] == [(0, 1, 2)]
    assert function.meaning == "c of friction on v depends on angle"
    assert label_of(name, [load, friction]) == "c of friction on v"
    assert label_of("d", [load, friction]) == "d"


def test_of_an_effect_its_coefficients_are_asked_and_of_groups_neither_spread_nor_members() -> None:
    """The edge of an overflow is no coefficient."""
    plan = setup(two_nodes(), warmed(0.0, 0), (), [OVERFLOW], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=8))
    base = search.base()
    free = base.optimum.free + tuple(search.all_rows(0))
    chosen = Trial((0,), base.optimum._replace(free=free))
    asked = {t.acts_on for t in dependent_parameters(search, chosen, [2])}
    of_effect = [k for k in search.terms[0].parameters if k.name in asked]
    assert [k.label for k in of_effect] == ["c"]
    model = plan.augmented.model
    for role in (SPREAD, MEMBER):
        params = tuple(q._replace(role=role) if q.name == "a" else q for q in model.params)
        search.plan = plan._replace(augmented=plan.augmented._replace(model=replace(model, params=params)))
        assert {t.acts_on for t in dependent_parameters(search, base, [2])} == {"h"}


def test_what_stands_for_effects_is_sought_in_the_simulator_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the effects nothing promises anything; without them what promises half of what they explain is worth a fit."""
    plan = setup(two_nodes(), warmed(0.0, 0), (), [OVERFLOW], 2)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=8))
    base = search.base()
    better = base.optimum._replace(log_evidence=base.optimum.log_evidence + 100.0)
    chosen, assessor = Trial((0,), better), Assessor(plan, 3)
    levels, alone = NoiseProfile(search, assessor, chosen), NoiseProfile(search, assessor, base)

    def promised(asked: NoiseProfile, terms: list[Term]) -> list[Promise]:
        worth = {("a", "first"): 60.0, ("h", "second"): 40.0}
        return [Promise(worth.get((t.acts_on, *t.depends_on), 0.0) if asked is alone else 0.0, 1.0) for t in terms]

    monkeypatch.setattr(interactions, "promised", promised)
    going, _ = interactions._screened(levels, alone, 0.0)
    assert [(t.acts_on, *t.depends_on) for t in going] == [("a", "first")]


def test_of_a_logarithm_a_function_may_be_as_large_as_the_value() -> None:
    coordinates = Coordinates(
        np.array([np.log(0.01), -1.0]), np.array([np.log(10.0), 3.0]), np.array([True, False]), np.array([False, False]),
        (2, 0, 0), (), 1,
    )  # fmt: skip
    np.testing.assert_allclose([coordinates.span(0, 0.5), coordinates.span(1, 0.5)], [np.sqrt(0.1), 4.0])
