"""Whoever knows the cause misses the noise alone, finds the size of what is planted, and is compared as it should be."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.exam import specialist
from tests.exam.draw import DERIVED, FULL, NONE, ONE, Set
from tests.exam.examine import places


def one(system: str, key: str, *, condition: str = FULL, noise: float = 0.01) -> Set:
    return Set(7, system, ONE, (key,), (0.5,), noise, condition, "own", 11)


@pytest.mark.parametrize(
    ("system", "key"),
    [("cart", "input_backlash@u"), ("cart", "input_lag@u"), ("cart", "sensor_delay@v"), ("tanks", "sensor_lag@h_1"),
     ("car", "traction_limit@v"), ("thermal", "sensor_scale@T_1")],
)  # fmt: skip
def test_free_runs_of_the_true_structure_miss_the_noise_alone(system: str, key: str) -> None:
    model = specialist.model_of(one(system, key))
    error = specialist.tested(model, np.zeros(len(model.unknowns))) / model.made.noise[model.columns]
    assert np.all((error > 0.8) & (error < 1.5))


def test_a_fit_finds_the_size_that_was_planted(monkeypatch: pytest.MonkeyPatch) -> None:
    """It begins at the truth; here at half of it."""
    model = specialist.model_of(one("cart", "quadratic_drag@v", noise=0.001))
    truth = model.made.knobs[0]["c"]
    wrong = model._replace(made=model.made._replace(knobs=({"c": truth / 2},)))
    at = specialist.fitted(wrong)
    assert [u.name for u in wrong.unknowns][-1] == "c"
    assert truth / 2 + at[-1] * wrong.unknowns[-1].size == pytest.approx(truth, rel=0.02)
    monkeypatch.setattr(specialist, "FITS", 1)
    assert truth / 2 + specialist.fitted(wrong)[-1] * wrong.unknowns[-1].size != pytest.approx(truth, rel=0.02)


def test_a_speed_that_was_derived_is_not_compared() -> None:
    assert specialist.model_of(one("cart", "input_lag@u", condition=DERIVED)).names == ("s",)


def test_errors_are_compared_with_those_of_the_verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = one("cart", "quadratic_drag@v")
    monkeypatch.setattr(specialist, "draw", lambda index, seed: drawn._replace(index=index))
    monkeypatch.setattr(specialist, "fitted", lambda model: np.zeros(len(model.unknowns)))
    assert specialist.compared(tmp_path, 7, 1) is None  # not run
    model = specialist.model_of(drawn)
    least = specialist.tested(model, np.zeros(len(model.unknowns)))
    error = {side: {"free_run": {n: float(k * e) for n, e in zip(("s", "v"), least, strict=True)}}
             for side, k in (("before", 3.0), ("after", 1.2))}  # fmt: skip
    folder = places(tmp_path, 7)[0] / "run"
    folder.mkdir(parents=True)
    (folder / "verdict.json").write_text(json.dumps({"error": error}))
    row = specialist.compared(tmp_path, 7, 1)
    assert row is not None
    assert (row["before"], row["after"]) == (pytest.approx(3.0), pytest.approx(1.2))
    text = specialist.report(pd.DataFrame([row]))
    assert "| cart | 1 | 3.00 | 1.200 | 1.20 | 0/1 | 1/1 |" in text
    for other in (drawn._replace(world="mujoco"), drawn._replace(kind=NONE, planted=(), strength=())):
        monkeypatch.setattr(specialist, "draw", lambda *_, other=other: other)
        assert specialist.compared(tmp_path, 7, 1) is None
