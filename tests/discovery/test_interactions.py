"""Functions of two arguments that a simulator lacks: seen without a program, fitted, and not taken for process noise."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from linear_plant import DT, LOAD, model, recording

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.acceptance import gated_selection, with_interactions
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.sets.selection import Selection, cut
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.smaller import carried, names_of
from simpel_cli.discovery.search.trials import Search
from simpel_cli.discovery.search.unexplained.interactions import BASES
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.verdict.remainder import remainder_of
from simpel_cli.discovery.verdict.verdict import verdict_of
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.coordinates import CUT
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.likelihood.sensitivity import shifts, waves
from simpel_cli.filtering.setup import Setup, key_of, setup
from simpel_cli.filtering.setup import whole_windows as windows_of_tests
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression, functions_of_two
from simulators.model import Declared

NOISE, ROWS = 0.02, 40
FRICTION = Expression("friction", acts_on="v", term="-c*v", parameters={"c": {"range": [0, 2], "unit": "1/s"}})


@pytest.fixture(scope="module")
def plan() -> Setup:
    return setup(model(), recording(), (), [LOAD], 2)


def test_innovations_shift_as_those_of_a_filter_that_knows_the_force(plan: Setup) -> None:
    """Against differences of the filter itself, in every weight of a function that its program carries."""
    term = next(t for t in plan.augmented.terms if t.depends_on == ("v",))
    assessor, z = Assessor(plan, 3), plan.start
    ok = plan.windows.ok.copy()
    ok[1, 3, 0] = ok[1, 7] = 0.0
    # measurements that the model predicts: what the force does to the filter's gain, which is left out, then does nothing
    y = np.asarray(assessor(z, plan.windows._replace(ok=0 * ok)).track.predicted)
    windows = plan.windows._replace(y=y, ok=ok)
    track = assessor(z, windows).track
    inputs = windows.u[:, plan.lead : plan.lead + ok.shape[1]]
    p = np.array([plan.coordinates.value(i, z[i]) for i in range(len(plan.augmented.params))])
    following = np.roll(track.predicted, -1, axis=1)
    force = waves(plan.augmented, [term], p, [(np.asarray(track.mean), inputs), (following, inputs)], [1])
    found = shifts(track, ok, force, plan.augmented.model.dt)
    for n, row in enumerate(plan.augmented.rows(term)[: max(BASES)]):
        step = np.zeros_like(z)
        step[row] = 1e-4 / (2 * CUT)  # of a standard deviation
        ahead, back = (np.asarray(assessor(z + s, windows).track.innovation) for s in (step, -step))
        change = (ahead - back) / 2e-4 * ok
        # the force is a straight line within a row, which the shorter waves are not
        assert np.linalg.norm(found[..., n] - change) < 0.06 * np.linalg.norm(change)


def test_unknowns_are_carried_by_name_into_a_program_with_other_terms_and_bounds(plan: Setup) -> None:
    extra = functions_of_two(model(), plan.scales, 2)[:1]
    other = setup(model(), recording(1, noise=0.02), (), [LOAD], 2, kept={key_of(plan.augmented.terms[0])}, extra=extra)
    assert [t.depends_on for t in other.augmented.terms] == [(), ("s", "v")]
    z = np.random.default_rng(0).uniform(0.4, 0.6, len(plan.start))
    new = carried(plan, z, other)
    values = {name: plan.coordinates.value(i, z[i]) for i, name in enumerate(names_of(plan))}
    told = 0
    for i, (name, q) in enumerate(zip(names_of(other), new, strict=False)):
        if name in values and not name.startswith("size_of"):
            np.testing.assert_allclose(other.coordinates.value(i, q), values[name], rtol=1e-9)
            told += 1
    assert told == 6  # a, b, the load, two sensors, one driven state
    parameters = other.augmented.rows(extra[0])
    np.testing.assert_array_equal(new[parameters], other.start[parameters])


def hypothesis(drag: Callable[[float], float], shaken: float, seed: int) -> Recording:
    """Episodes of dv/dt = 1.3 u - 0.7 v - drag(s) v, with process noise of `shaken` m/s per root second."""
    random, fine, episodes = np.random.default_rng(seed), 40, []
    for k in range(7):
        s, v, states, inputs = random.uniform(-1.0, 1.0), random.normal(), [], np.zeros(ROWS)
        for i, wanted in enumerate(2 * random.normal(size=ROWS).repeat(2)[:ROWS]):
            states.append([s, v])
            inputs[i] = wanted - 1.5 * s  # or it would run away
            for _ in range(fine):
                push = 1.3 * inputs[i] - 0.7 * v - drag(s) * v
                s += v * DT / fine
                v += push * DT / fine + shaken * np.sqrt(DT / fine) * random.normal()
        measured = np.array(states) + NOISE * random.normal(size=(ROWS, 2))
        episodes.append(Episode(f"{k}", np.arange(ROWS) * DT, measured, inputs[:, None], np.zeros((ROWS, 0))))
    return Recording(
        tuple(episodes[:5]), tuple(episodes[5:]), (), {"s": NOISE, "v": NOISE}, (), (Check("c", True, ""),), ()
    )


def looked(data: Recording, folder: Path) -> tuple[Search, Assessor, Selection, Selection]:
    """A search by a simulator whose only friction is 0.7 1/s, and the last look at what it leaves."""
    glider = Declared(
        "glider", dt=DT,
        states={"s": {"unit": "m", "range": [-3, 3]}, "v": {"unit": "m/s", "range": [-5, 5]}},
        inputs={"u": {"unit": "V", "range": [-9, 9]}},
        parameters={"b": {"unit": "m/s^2/V", "range": [0.8, 1.8]}},
        dynamics={"s": "v", "v": "b*u - 0.7*v"},
    ).model()  # fmt: skip
    attach = partial(setup, glider, data, (), [FRICTION], 2)
    plan = attach()
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=10))
    assessor, terminal = Assessor(plan, 10), Terminal(True, folder / "run.log")
    selection, gates, _ = gated_selection(search, assessor, select(search), terminal)
    left, gates = with_interactions(
        NoiseProfile(search, assessor, selection.chosen),
        NoiseProfile(search, assessor, selection.base),
        selection,
        gates,
        attach,
        Discovery(),
        terminal,
    )
    assert len(gates) == len(left.chosen.terms)
    return search, assessor, selection, left


def said(data: Recording, search: Search, assessor: Assessor, left: Selection) -> dict[str, Any]:
    windows = windows_of_tests(search.plan, data.test, ())
    before = assessor(left.base.optimum.z, windows)
    after, learnt = (assessor(left.chosen.optimum.z, w) for w in (windows, search.plan.windows))
    left_over = remainder_of(search, left, None, learnt)
    return verdict_of(search, left, [], before, after, left_over, windows, data.checks, 10, 0.0)


@pytest.mark.slow
def test_a_friction_that_depends_on_the_position_is_noticed(tmp_path: Path) -> None:
    data = hypothesis(lambda s: 0.3 * s, 0.0, 0)
    search, assessor, _, left = looked(data, tmp_path)
    found = said(data, search, assessor, left)
    assert found["verdict"] == "unexplained"
    assert found["effects"] == []
    assert found["remainder"]["acts_on"] == "v"
    assert found["remainder"]["depends_on"] == ["s", "v"]
    assert found["remainder"]["log_evidence_gain"] > 20


@pytest.mark.slow
def test_a_mean_friction_is_named_and_the_rest_remains(tmp_path: Path) -> None:
    data = hypothesis(lambda s: 0.5 * s**2, 0.0, 0)
    search, assessor, first, left = looked(data, tmp_path)
    assert first.chosen == left.chosen
    found = said(data, search, assessor, left)
    assert found["verdict"] == "effect"
    assert [e["name"] for e in found["effects"]] == ["friction"]
    assert found["remainder"]["parameter"] == "c of friction on v"
    assert found["remainder"]["depends_on"] == ["s"]
    assert found["remainder"]["acts_on"] == "v"
    assert found["remainder"]["log_evidence_gain"] > 100
    without = cut(search, left, ())
    assert (without.chosen.terms, without.classes, without.gains) == ((), (), ())
    assert without.base == without.chosen == without.path[-1]
    gain = left.chosen.optimum.log_evidence - without.chosen.optimum.log_evidence
    np.testing.assert_allclose(gain, left.gains[0], atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_process_noise_is_no_function_of_two(tmp_path: Path, seed: int) -> None:
    search, _, first, left = looked(hypothesis(lambda s: 0.0, 0.3, seed), tmp_path)
    assert first == left
    assert left.chosen.terms == ()
    assert left.remainder is None
    coordinates = search.plan.coordinates
    q = coordinates.value(len(coordinates.low) - 2, left.chosen.optimum.z[-2])
    assert 0.2 < q < 0.4  # and it was there to be taken for one
