"""Functions of two arguments that a simulator lacks: seen without a program, fitted, and not taken for process noise."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from command_line import csv, rig, simpel
from test_discovery_filter import LOAD, model, p_of, recording

from simpel_cli.discovery.filter import Noise, still
from simpel_cli.discovery.interactions import carried, names_of
from simpel_cli.discovery.sensitivity import shifts, waves
from simpel_cli.discovery.setup import Setup, key_of, setup
from simulators.effects import functions_of_two

NOISE = 1e-3, 5e-3  # m, m/s
DT, ROWS = 0.05, 40
SEARCH = ("discover", "--config-dir", "my", "sim=cart", "data=rig", "close=false", "hydra.run.dir=run")
FEW = "effect=[viscous_friction,coulomb_friction,input_delay,leak]"


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
    data = [jnp.asarray(a) for a in (windows.y[1], ok, windows.u[1], windows.start[1], windows.spread[1])]

    def track(values: np.ndarray) -> Any:
        return plan.rule.track(still(jnp.asarray(values)), noise, *data)

    told = track(p)
    batch = type(told)(*(np.asarray(a)[None] for a in told))
    inputs = windows.u[1][None, plan.lead : plan.lead + ok.shape[0]]
    after = np.roll(batch.predicted, -1, axis=1)
    force = waves(plan.augmented, term, p, [(batch.mean, inputs), (after, inputs)])
    found = shifts(batch, ok[None], *force, 1, plan.augmented.model.dt)[0]
    for n, (row, knob) in enumerate(zip(plan.augmented.rows(term), term.knobs, strict=True)):
        sd = (knob.high - knob.low) / 4
        step = np.zeros_like(p)
        step[row] = 1e-4 * sd
        change = np.asarray(track(p + step).innovation - track(p - step).innovation) / 2e-4 * ok
        np.testing.assert_allclose(found[..., n], change, atol=0.02 * np.abs(change).max())


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


def table(drag: float, shaken: float, seed: int) -> np.ndarray:
    """Rows of a cart on a spring with a friction of `drag` s^2 v, and process noise of `shaken` m/s per root second."""
    random, rows, fine = np.random.default_rng(seed), [], 20
    for run in range(6):
        s, v = random.uniform(-0.3, 0.3), 0.0
        for k in range(ROWS):
            u = float(2 * np.sin(0.3 * k + run))
            rows.append([run, round(k * DT, 4), s + NOISE[0] * random.normal(), v + NOISE[1] * random.normal(), u])
            for _ in range(fine):
                v += ((2 * u - 20 * s) / 1.2 - drag * s**2 * v) * DT / fine
                v += shaken * np.sqrt(DT / fine) * random.normal()
                s += v * DT / fine
    return np.array(rows)


def verdict(folder: Path, rows: np.ndarray) -> tuple[dict[str, Any], str]:
    rig(folder, measurements=csv(rows.tolist()))
    result = simpel(folder, *SEARCH, FEW)
    assert result.code == 0, result.err
    return json.loads((folder / "run" / "verdict.json").read_text()), result.out


def test_a_friction_that_depends_on_the_position_is_noticed(tmp_path: Path) -> None:
    found, out = verdict(tmp_path, table(20.0, 0.0, 0))
    assert found["remainder"] is not None, found["summary"]
    print(found["verdict"], found["remainder"], out)
    assert found["verdict"] == "unexplained"
    assert found["remainder"]["acts_on"] == "v"
    assert found["remainder"]["depends_on"] == ["s", "v"]


@pytest.mark.parametrize("seed", [1, 2])
def test_process_noise_is_none(tmp_path: Path, seed: int) -> None:
    found, _ = verdict(tmp_path, table(0.0, 0.1, seed))
    assert found["verdict"] == "none"
    assert found["process_noise"]["after"] > 0.05
