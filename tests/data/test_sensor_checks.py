"""Held samples, coarse steps and irregular clocks are found; clean noisy data pass every check."""

from pathlib import Path

import numpy as np
import pytest

from simpel_cli.data import Check, Measurements, Recording, read
from simpel_cli.data.checks.sensors import held, jitter, quantisation, quantum, stale
from simpel_cli.data.estimation.derived_speeds import derived
from simpel_cli.data.estimation.kinematics import Motion, kinematics
from simulators.model import Declared

SWING = Declared(
    name="swing",
    dt=0.02,
    states={
        "a": {"unit": "rad", "range": [-3.15, 3.15], "periodic": True},
        "w": {"unit": "rad/s", "range": [-20, 20]},
    },
    inputs={"u": {"unit": "N m", "range": [-1, 1]}},
    dynamics={"a": "w", "w": "u - 9*sin(a)"},
).model()


def motion(t: np.ndarray, rate: float = 3.0, phase: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A decaying swing and its speed."""
    decay, angle = np.exp(-0.05 * t), rate * t + phase
    return 1.2 * decay * np.sin(angle), 1.2 * decay * (rate * np.cos(angle) - 0.05 * np.sin(angle))


def measured(folder: Path, a: list[np.ndarray], w: list[np.ndarray], dt: float = 0.02) -> Recording:
    lines = ["run,t,a,w,u"]
    for run, (positions, speeds) in enumerate(zip(a, w, strict=True)):
        pairs = zip(positions.tolist(), speeds.tolist(), strict=True)
        lines += [f"{run},{dt * i:.4f},{p!r},{v!r},0.{i % 7}" for i, (p, v) in enumerate(pairs)]
    (folder / "d.csv").write_text("\n".join(lines))
    return read(Measurements("d.csv", time="t", episode="run"), SWING, folder, 0)


def check(recording: Recording, name: str) -> Check:
    (found,) = [c for c in recording.checks if c.name == name]
    return found


def test_clean_noisy_data_pass_in_99_of_100_records() -> None:
    """200 records: 0.1 to 3 % noise, 15 to 300 rows per swing, 2 to 8 episodes, one in three with a jittering clock."""
    alarms = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        level = 10 ** rng.uniform(-3, np.log10(0.03))
        rate, rows, episodes = rng.uniform(1, 8), int(rng.integers(60, 400)), int(rng.integers(2, 9))
        dt = 2 * np.pi / rate / rng.uniform(15, 300)
        pieces = []
        for _ in range(episodes):
            t = dt * np.arange(rows) + (rng.uniform(-0.005, 0.005, rows) * dt if seed % 3 == 0 else 0)
            p, v = motion(t, rate, rng.uniform(0, 6))
            noise = level * np.array([1.2, 1.2 * rate])[:, None] * rng.normal(size=(2, rows)) / np.sqrt(2)
            pieces.append((t, p + noise[0], v + noise[1]))
        times, positions, speeds = (list(column) for column in zip(*pieces, strict=True))
        pair = [Motion("a", "w", "rad/s", pieces)]
        columns = {"a": positions, "w": speeds}
        checks = (jitter(times, dt, dt), stale(columns), quantisation(columns, {}), kinematics(pair), derived(pair))
        alarms += [(seed, c) for c in checks if not c.ok]
    assert len(alarms) < 2, alarms


@pytest.mark.parametrize("every", [2, 4, 10])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_held_sensor_is_found(every: int, noise: float) -> None:
    t = 0.01 * np.arange(1000)
    fresh = motion(t)[0] + np.random.default_rng(0).normal(0, noise, 1000)
    slow = fresh[np.arange(1000) // every * every]
    found = stale({"a": [fresh], "b": [slow]})
    assert not found.ok
    assert "b repeats its last value in" in found.detail
    assert "a repeats" not in found.detail
    assert held([slow]) == (pytest.approx(1 - 1 / every, rel=0.25), every)


def test_repeats_of_rest_and_of_coarse_steps_are_no_held_sensor() -> None:
    t = 0.01 * np.arange(1000)
    angle = motion(t)[0]
    still = np.concatenate([angle[:300], np.full(400, angle[299]), angle[300:]])
    coarse = np.round(angle / 0.02) * 0.02  # stands still for several rows at every turn
    assert np.mean(np.diff(coarse) == 0) > 0.2
    assert stale({"still": [still], "coarse": [coarse]}).ok


def test_held_rows_show_in_a_fit_of_the_file(tmp_path: Path) -> None:
    a, w = motion(0.02 * np.arange(300))
    half = np.arange(300) // 2 * 2
    recording = measured(tmp_path, [a, a], [w[half], w[half]])
    assert (
        "w repeats its last value in 43% of the rows while the quantity changes, 2 rows at a time"
        in check(recording, "stale").detail
    )
    assert check(measured(tmp_path, [a, a], [w, w]), "stale").ok


@pytest.mark.parametrize("step", [0.002, 0.01, 0.05])
def test_quantum_of_a_rounded_signal(step: float) -> None:
    t = 0.01 * np.arange(2000)
    signal = motion(t)[0]
    rounded = np.round(signal / step) * step
    assert quantum([rounded]) == pytest.approx(step, rel=1e-6)
    assert np.isnan(quantum([signal]))
    assert np.isnan(quantum([0.1 * t]))  # a ramp: equal changes, no steps
    turning = 2 * t + 3 * np.sin(t)
    wrapped = np.unwrap(np.round(((turning + np.pi) % (2 * np.pi) - np.pi) / step) * step)
    assert quantum([wrapped]) == pytest.approx(step, rel=1e-6)


def test_quantisation_is_reported_where_it_exceeds_the_noise() -> None:
    t = 0.002 * np.arange(4000)
    rng = np.random.default_rng(0)

    def rounded(noise: float, step: float) -> np.ndarray:
        return np.round((motion(t)[0] + rng.normal(0, noise, len(t))) / step) * step

    found = quantisation({"a": [rounded(0.0, 0.02)]}, {"a": "rad"})
    assert not found.ok
    assert "a is quantised in steps of 0.02 rad" in found.detail
    assert quantisation({"a": [rounded(0.02, 0.02)]}, {}).ok  # noise spreads it over the steps
    assert quantisation({"a": [rounded(0.0, 1e-5)]}, {}).ok  # too fine to matter
    assert quantisation({"a": [motion(t)[0]]}, {}).ok


def test_jitter() -> None:
    rng = np.random.default_rng(0)
    even = 0.1 * np.arange(200)
    assert jitter([even, even + 5], 0.1, 0.1) == Check("jitter", True, "all time steps equal dt")
    assert jitter([even + rng.uniform(-5e-4, 5e-4, 200)], 0.1, 0.1).ok
    uneven = np.cumsum(rng.uniform(0.05, 0.14, 200))
    found = jitter([uneven], 0.095, 0.1)
    assert not found.ok
    assert "% of the steps differ from dt by more than 2 %" in found.detail
    assert "data.resample: 0.1 makes them equal" in found.detail
    assert jitter([uneven], 0.095, None).ok
