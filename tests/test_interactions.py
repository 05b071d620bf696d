"""Functions of two arguments that a simulator lacks: seen without a program, fitted, and not taken for process noise."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_discovery_filter import DT, LOAD, model, p_of, recording

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.assess import Assessor
from simpel_cli.discovery.filter import Noise, still
from simpel_cli.discovery.fit import Fitter
from simpel_cli.discovery.interactions import Interaction, carried, interaction, names_of
from simpel_cli.discovery.selection import Search, Selection
from simpel_cli.discovery.sensitivity import shifts, waves
from simpel_cli.discovery.setup import Setup, key_of, setup
from simpel_cli.discovery.setup import test_windows as windows_of_tests
from simpel_cli.discovery.verdict import verdict_of
from simulators.effects import functions_of_two

NOISE, ROWS = 0.02, 40


@pytest.fixture(scope="module")
def plan() -> Setup:
    return setup(model(), recording(), (), [LOAD], 2)


def test_innovations_shift_as_those_of_a_filter_that_knows_the_force(plan: Setup) -> None:
    """Against differences of the filter itself, in every weight of a function that its program carries."""
    term = next(t for t in plan.augmented.terms if t.depends_on == ("v",))
    windows, p = plan.windows, p_of(plan, 0.2)
    noise = Noise(jnp.array([0.05, 0.07]), jnp.array([0.0, 0.3]))
    ok = windows.ok[1].copy()
    ok[3, 0] = ok[7] = 0.0
    u, start, spread = (jnp.asarray(a) for a in (windows.u[1], windows.start[1], windows.spread[1]))
    track = jax.jit(lambda p, noise, y: plan.rule.track(still(p), noise, y, jnp.asarray(ok), u, start, spread))
    # measurements that the model predicts: what the force does to the filter's gain, which is left out, then does nothing
    y = track(jnp.asarray(p), Noise(jnp.full(2, 1e6), jnp.zeros(2)), jnp.zeros(ok.shape)).predicted
    told = track(jnp.asarray(p), noise, y)
    batch = type(told)(*(np.asarray(a)[None] for a in told))
    inputs = windows.u[1][None, plan.lead : plan.lead + ok.shape[0]]
    after = np.roll(batch.predicted, -1, axis=1)
    force = waves(plan.augmented, term, p, [(batch.mean, inputs), (after, inputs)])
    found = shifts(batch, ok[None], *force, 1, plan.augmented.model.dt)[0]
    for n, (row, knob) in enumerate(zip(plan.augmented.rows(term), term.knobs, strict=True)):
        sd = (knob.high - knob.low) / 4
        step = np.zeros_like(p)
        step[row] = 1e-4 * sd
        ahead, back = (np.asarray(track(jnp.asarray(p + s), noise, y).innovation) for s in (step, -step))
        change = (ahead - back) / 2e-4 * ok
        # the shortest wave turns a good part of its period within a row
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
    knobs = other.augmented.rows(extra[0])
    np.testing.assert_array_equal(new[knobs], other.start[knobs])


def lane(drag: float, shaken: float, seed: int) -> Recording:
    """Episodes of dv/dt = 1.3 u - 0.7 v - drag s^2 v, with process noise of `shaken` m/s per root second."""
    random, fine, episodes = np.random.default_rng(seed), 40, []
    for k in range(7):
        s, v, states, inputs = random.uniform(-1.0, 1.0), random.normal(), [], np.zeros(ROWS)
        for i, wanted in enumerate(2 * random.normal(size=ROWS).repeat(2)[:ROWS]):
            states.append([s, v])
            inputs[i] = wanted - 1.5 * s  # or it would run away
            for _ in range(fine):
                push = 1.3 * inputs[i] - 0.7 * v - drag * s**2 * v
                s += v * DT / fine
                v += push * DT / fine + shaken * np.sqrt(DT / fine) * random.normal()
        measured = np.array(states) + NOISE * random.normal(size=(ROWS, 2))
        episodes.append(Episode(f"{k}", np.arange(ROWS) * DT, measured, inputs[:, None], np.zeros((ROWS, 0))))
    return Recording(
        tuple(episodes[:5]), tuple(episodes[5:]), (), {"s": NOISE, "v": NOISE}, (), (Check("c", True, ""),), ()
    )


def looked(data: Recording) -> tuple[Search, Assessor, Selection, Interaction | None]:
    """A search with one named effect, and the last look at what it leaves."""
    attach = partial(setup, model(), data, (), [LOAD], 2)
    plan = attach()
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, lanes=4, width=11))
    assessor, selection = Assessor(plan, 10), search.run()
    return search, assessor, selection, interaction(search, assessor, selection.chosen, attach, 4)


def test_a_friction_that_depends_on_the_position_is_noticed() -> None:
    data = lane(0.5, 0.0, 0)
    search, assessor, selection, found = looked(data)
    assert found is not None
    assert found.gate.passed
    assert found.gain > 20
    selection = selection._replace(remainder=(found.term, found.gain))
    windows = windows_of_tests(search.plan, data.test, ())
    before, learnt = (assessor(selection.chosen.optimum.z, w) for w in (windows, search.plan.windows))
    said = verdict_of(search, selection, [], before, before, learnt, windows, data.checks, 10, 0.0)
    assert said["verdict"] == "unexplained"
    assert said["remainder"]["acts_on"] == "v"
    assert said["remainder"]["depends_on"] == ["s", "v"]


@pytest.mark.parametrize("seed", [1, 2])
def test_process_noise_is_no_function_of_two(seed: int) -> None:
    search, _, selection, found = looked(lane(0.0, 0.3, seed))
    assert selection.chosen.terms == ()
    assert found is None
    coordinates = search.plan.coordinates
    q = coordinates.value(len(coordinates.low) - 2, selection.chosen.optimum.z[-2])
    assert 0.2 < q < 0.4  # and it was there to be taken for one
