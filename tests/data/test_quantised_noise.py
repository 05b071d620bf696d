"""The noise of a column that was rounded: no less than the error of rounding."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from simpel_cli.data import Measurements, Recording, read
from simpel_cli.data.checks.noise import third_difference_std
from simpel_cli.filtering.setup import setup
from simulators.model import Declared, Model

STEP, NOISE = 0.3, 0.02


def sensor() -> Model:
    return Declared(
        "sensor", dt=0.01, inputs={"u": {"unit": "V", "range": [-2, 2], "between_rows": "held"}},
        outputs={"y": {"unit": "m", "expression": "a*u"}},
        parameters={"a": {"unit": "m/V", "range": [1, 3]}},
    ).model()  # fmt: skip


def recorded(folder: Path, step: float, noise: float = NOISE, **keys: object) -> tuple[Recording, np.ndarray]:
    t = 0.01 * np.arange(400)
    u = 1.5 * np.sin(1.3 * t)
    y = 2 * u + noise * np.random.default_rng(0).normal(size=len(t))
    if step:
        y = step * np.round(y / step)
    path = folder / "rows.parquet"
    pd.DataFrame({"t": t, "u": u, "y": y}).to_parquet(path)
    config = Measurements(path=str(path), time="t", split={"test_fraction": 0.0, "by": "time"}, **keys)  # type: ignore[arg-type]
    return read(config, sensor(), folder, 0), y


def said(recording: Recording) -> str:
    return next(check.detail for check in recording.checks if check.name == "noise")


def test_rounding_is_noise_where_values_repeat(tmp_path: Path) -> None:
    recording, y = recorded(tmp_path, STEP)
    assert third_difference_std([y]) < 0.9 * STEP / 12**0.5  # what the values say themselves
    assert recording.noise_std["y"] == pytest.approx(STEP / 12**0.5)
    assert "y 0.0866 m (rounding to steps of 0.3)" in said(recording)


@pytest.mark.parametrize("step", [0.0, 0.002, 0.02])
def test_fine_steps_change_nothing(tmp_path: Path, step: float) -> None:
    recording, y = recorded(tmp_path, step)
    assert recording.noise_std["y"] == third_difference_std([y])
    assert "rounding" not in said(recording)


@pytest.mark.parametrize("step", [0.02, 0.05, STEP])
def test_no_estimate_is_below_the_error_of_rounding(tmp_path: Path, step: float) -> None:
    recording, _ = recorded(tmp_path, step, noise=0.05)
    assert recording.least_noise == {"y": pytest.approx(step / 12**0.5, rel=0.01)}
    plan = setup(sensor(), recording, (), [])
    row = plan.coordinates.sizes[0]  # of the noise of y
    assert plan.coordinates.value(row, 0.0) >= 0.99 * step / 12**0.5
    assert recorded(tmp_path, step, noise_std={"y": NOISE})[0].least_noise == {}


def test_a_declared_noise_stays(tmp_path: Path) -> None:
    recording, _ = recorded(tmp_path, STEP, noise_std={"y": NOISE})
    assert recording.noise_std["y"] == NOISE
    assert "y 0.02 m (declared)" in said(recording)
