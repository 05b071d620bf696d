"""When errors ahead grow so surely that an effect is refused."""

import numpy as np
import pytest

from simpel_cli.discovery.gate import harmful


@pytest.mark.parametrize(
    ("factors", "refused"), [((1.5, 1.5), True), ((0.7, 0.7), False), ((1.5, 0.7), False), ((1.0, 1.0), False)]
)
def test_only_errors_that_grow_in_every_channel_are_harm(factors: tuple[float, float], refused: bool) -> None:
    random = np.random.default_rng(0)
    before = random.normal(size=(8, 50, 2))
    after = random.normal(size=(8, 50, 2)) * np.array(factors)
    before[:, :5] = after[:, :5] = np.nan  # rows that have no horizon behind them
    assert harmful(before, after, np.arange(8)) is refused


def test_a_channel_without_errors_says_nothing() -> None:
    before = np.random.default_rng(0).normal(size=(8, 50, 2))
    before[..., 1] = np.nan
    assert harmful(before, 2 * before, np.arange(8))
    assert not harmful(np.full_like(before, np.nan), np.full_like(before, np.nan), np.arange(8))
