"""Integration steps that are fine for the simulator alone, and too coarse beside an effect that switches."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from command_line import process
from test_ranges import cart
from test_wide_ranges_of_a_run import SIM

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search import integration
from simpel_cli.discovery.search.integration import LOST, MOST, Finer, _missed, too_coarse
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simulators.effects import Expression

DRY = Expression(
    "dry", acts_on="v", term="-c*tanh(v/w)",
    parameters={"c": {"range": [0, 3], "unit": "m/s^2", "starts": [1.0]},
                "w": {"range": [0.01, 0.1], "neutral": 0.05, "unit": "m/s"}},
)  # fmt: skip
DRAG = Expression("drag", acts_on="v", term="-k*v", parameters={"k": {"range": [0, 2], "unit": "1/s", "starts": [0.5]}})
LATE = build(yaml.safe_load((conf_dir() / "effect" / "input_delay.yaml").read_text()), "effect")
DATA = "path: run.parquet\ntime: t\nepisode: episode\nsplit: {test_fraction: 0.25, by: episode}\n"
FINE = 500  # steps of the truth, a row


def measured(noise: float, *, dry: float = 0.0, drag: float = 0.0) -> Recording:
    """Carts with dry friction, or drag, in steps of 0.2 ms, which often turn round."""
    random = np.random.default_rng(5)
    episodes = []
    for e in range(4):
        u = np.repeat(random.uniform(-3, 3, 20), 3)
        x, h = np.zeros((60, 2)), 0.1 / FINE
        for i in range(59):
            s, v = x[i]
            for _ in range(FINE):
                push = 1.2 * u[i] - drag * v
                held = abs(push) <= dry and abs(v) <= dry * h
                v = 0.0 if held else v + h * (push - dry * np.tanh(v / 0.01))
                s += h * v
            x[i + 1] = s, v
        noisy = x + noise * random.normal(size=x.shape)
        episodes.append(Episode(str(e), np.arange(60) * 0.1, noisy, u[:, None], np.zeros((60, 0))))
    std = {"s": noise, "v": noise}
    return Recording(tuple(episodes[:3]), tuple(episodes[3:]), (), std, (), (Check("c", True, ""),), ())


def asked(recording: Recording, effect: Expression, steps: int = 1) -> tuple[Finer | None, Search, Assessor, Trial]:
    """Return what a model with an effect asks for that is searched for with so many steps, and what it was asked of."""
    plan = setup(cart(), recording, (), [effect], steps)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=13))
    assessor, base = Assessor(plan, 5), search.base()
    chosen = search.add(base, [0]).trials[0]
    return too_coarse(search, assessor, chosen, base), search, assessor, chosen


@pytest.fixture(scope="module")
def rubbing() -> Recording:
    return measured(1e-3, dry=1.0)


def test_a_friction_that_switches_asks_for_more_steps_than_the_simulator(rubbing: Recording) -> None:
    finer, search, assessor, chosen = asked(rubbing, DRY)
    assert finer == Finer()
    again, *_, better = asked(rubbing, DRY, finer.steps)
    assert again is None
    # what is asked for is worth it
    assert better.optimum.log_evidence > chosen.optimum.log_evidence + ACCEPT
    assert too_coarse(search, assessor, search.base(), search.base()) is None  # the simulator alone has what it needs


@pytest.mark.parametrize("steps", [2, 4])
def test_a_few_more_steps_are_not_enough(rubbing: Recording, steps: int) -> None:
    """Beside noise of the process that makes up for one step a row two look fine, and are not."""
    found, *_, chosen = asked(rubbing, DRY, steps)
    assert found == Finer()
    assert asked(rubbing, DRY, MOST)[3].optimum.log_evidence > chosen.optimum.log_evidence - 1


def test_more_steps_miss_less_and_steps_that_run_away_miss_everything(
    rubbing: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, search, assessor, chosen = asked(rubbing, DRY)
    missed = [_missed(search, assessor, chosen, n) for n in (1, 2, 4, 8)]
    assert missed == sorted(missed, reverse=True)
    assert missed[0] > 10 * missed[-1] >= 0
    moved = integration._moved

    def lost(*given: Any) -> np.ndarray:
        return moved(*given) * (np.nan if given[3].shape[1] == 1 else 1.0)  # one step a row

    monkeypatch.setattr(integration, "_moved", lost)
    rows = (search.plan.windows.ok[:, 1:] > 0).any(axis=2).sum()
    everything = rows * len(search.plan.augmented.measured) * 0.5 * np.log1p(LOST)
    assert _missed(search, assessor, chosen, 1) == pytest.approx(everything)


def test_a_row_is_as_long_as_its_clock_says(rubbing: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    _, search, assessor, chosen = asked(rubbing, DRY)
    windows, dt, lengths = search.plan.windows, search.plan.augmented.model.dt, list[np.ndarray]()
    pace = np.linspace(0.5, 2.0, windows.ok.shape[1])
    clock = np.zeros((*windows.ok.shape[:2], 3))
    clock[..., 0] = pace
    moved = integration._moved

    def recorded(*given: Any) -> np.ndarray:
        lengths.append(given[4])
        return moved(*given)

    monkeypatch.setattr(integration, "_moved", recorded)
    _missed(search, assessor, chosen, 1)
    search.plan = search.plan._replace(clocked=True, windows=windows._replace(clock=clock))
    _missed(search, assessor, chosen, 1)
    even, _, uneven, _ = lengths
    np.testing.assert_allclose(even, dt)
    np.testing.assert_allclose(uneven, dt * np.tile(pace[:-1], len(windows.episode)))


def delayed(delay: float, every: int) -> Recording:
    """Carts whose input changes every so many rows and arrives late, exactly integrated."""
    random = np.random.default_rng(2)
    episodes = []
    for e in range(4):
        u = np.repeat(random.uniform(-3, 3, 60 // every), every)
        x = np.zeros((60, 2))
        for i in range(59):
            (s, v), before, now = x[i], 1.2 * u[max(i - 1, 0)], 1.2 * u[i]
            v_there = v + before * delay
            s_there, rest = s + v * delay + before * delay**2 / 2, 0.1 - delay
            x[i + 1] = s_there + v_there * rest + now * rest**2 / 2, v_there + now * rest
        noisy = x + 1e-4 * random.normal(size=x.shape)
        episodes.append(Episode(str(e), np.arange(60) * 0.1, noisy, u[:, None], np.zeros((60, 0))))
    std = {"s": 1e-4, "v": 1e-4}
    return Recording(tuple(episodes[:3]), tuple(episodes[3:]), (), std, (), (Check("c", True, ""),), ())


def test_an_input_that_arrives_within_a_row_is_integrated_as_it_is_by_one_step() -> None:
    """Of a cart: its speed has the mean of what arrives, its position the first moment."""
    recording = delayed(0.03, every=2)
    finer, *_, coarse = asked(recording, LATE)
    assert finer is None
    assert asked(recording, LATE, MOST)[3].optimum.log_evidence == pytest.approx(coarse.optimum.log_evidence, abs=0.1)


def test_an_input_that_arrives_with_a_row_asks_for_none() -> None:
    assert asked(delayed(0.0999, every=2), LATE)[0] is None


def test_no_more_steps_are_asked_for_where_sensors_would_not_show_it() -> None:
    assert asked(measured(0.3, dry=1.0), DRY)[0] is None


def test_a_smooth_effect_asks_for_none() -> None:
    assert asked(measured(1e-3, drag=0.5), DRAG)[0] is None


@pytest.mark.parametrize(("noise", "steps"), [(1e-3, MOST), (1e-5, 4)])
def test_a_stiff_smooth_effect_asks_for_more(noise: float, steps: int) -> None:
    """A few, where what is missed falls with the fourth power; with more noise the sensors' own takes a part of it."""
    stiff = {"k": {"range": [0, 20], "unit": "1/s", "starts": [5.0]}}
    drag = Expression("drag", acts_on="v", term="-k*v", parameters=stiff)
    assert asked(measured(noise, drag=8.0), drag)[0] == Finer(steps=steps)


def test_steps_are_not_asked_for_without_end(rubbing: Recording) -> None:
    assert asked(rubbing, DRY, MOST)[0] is None


def test_a_run_searches_once_more_and_is_right(rubbing: Recording, tmp_path: Path) -> None:
    """From the command line: with the simulator's own steps the friction is too weak by more than its interval."""
    for name, text in (("sim", SIM), ("data", DATA)):
        (tmp_path / "my" / name).mkdir(parents=True)
        (tmp_path / "my" / name / "rig.yaml").write_text(text)
    episodes = (*rubbing.train, *rubbing.test)
    tables = [
        pd.DataFrame({"episode": e.name, "t": e.time, "s": e.states[:, 0], "v": e.states[:, 1], "u": e.inputs[:, 0]})
        for e in episodes
    ]
    pd.concat(tables).to_parquet(tmp_path / "my" / "data" / "run.parquet")
    result = process(
        tmp_path, "discover", "--config-dir", "my", "sim=rig", "data=rig", "effect=[coulomb_friction,viscous_friction]",
        "close=false", "report=false", "hydra.run.dir=run",
    )  # fmt: skip
    assert result.code == 0, result.err
    assert "integration steps a row: searching once more" in result.out
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text())
    (effect,) = verdict["effects"]
    assert effect["name"] == "coulomb_friction"
    size = effect["parameters"]["tau_c"]
    assert size["low"] < 1.0 < size["high"]
