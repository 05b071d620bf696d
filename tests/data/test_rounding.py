"""The step to which values were rounded, where their noise hides it."""

import numpy as np
import pytest

from simpel_cli.data.checks.rounding import rounding


def warming(seed: int, rows: int = 400, noise: float = 0.05) -> np.ndarray:
    t = np.arange(rows)
    return 20 + 30 * (1 - np.exp(-t / 150)) + noise * np.random.default_rng(seed).standard_normal(rows)


@pytest.mark.parametrize("seed", range(5))
def test_the_step_of_a_converter_behind_two_decimals(seed: int) -> None:
    step = 3.3 / 1023 * 10  # 10 bits of 3.3 V, 10 mV per kelvin, the mean of ten readings
    values = np.round(np.round(warming(seed) / step) * step, 2)
    assert rounding([values[:150], values[150:]]) == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_decimals_alone_are_no_converter(seed: int) -> None:
    assert rounding([np.round(warming(seed), 2)]) == pytest.approx(0.01)
    assert rounding([np.round(warming(seed, rows=60), 3)]) == pytest.approx(0.001)
    assert np.isnan(rounding([warming(seed)]))


def test_whole_multiples_and_large_numbers() -> None:
    assert rounding([0.25 * np.round(warming(0) / 0.25)]) == pytest.approx(0.25)
    assert rounding([np.round(1e4 * warming(0), -2)]) == pytest.approx(100)
    assert np.isnan(rounding([]))
    assert np.isnan(rounding([np.full(50, np.nan)]))
    assert np.isnan(rounding([np.zeros(3)]))


@pytest.mark.parametrize("seed", range(5))
def test_what_only_looks_like_steps(seed: int) -> None:
    """Large values with little spread, a constant, and motion at even speeds, whose changes are alike."""
    random = np.random.default_rng(seed)
    for level, spread in ((300, 0.005), (1000, 0.05), (1e6, 3.0)):
        assert np.isnan(rounding([level + spread * random.standard_normal(400)]))
    assert np.isnan(rounding([np.full(100, 300.0)]))
    t = np.arange(60)
    ramps = [x + 0.05 * k * t for x, k in zip(random.normal(size=8), [1, -1, 2, -2, 3, -3, 4, -4], strict=True)]
    for pieces in (ramps[:1], ramps[:2], ramps):
        found = rounding([np.round(r + 0.002 * random.standard_normal(60), 3) for r in pieces])
        assert found == pytest.approx(0.001)
