"""Parts of a test for intervals: none of a simulation that lost its way, blocks of one that forgets, episodes of several."""

import numpy as np
import pytest

from simpel_cli.filtering.errors_ahead import reduction_interval
from simpel_cli.filtering.independent_parts import BLOCKS, NO_PART, correlation_time, independent_parts

ROWS = 1000
RUNS = 200


def autoregression(random: np.random.Generator, memory: float, shape: tuple[int, ...]) -> np.ndarray:
    """Errors (..., T) of which each is `memory` times the one before, plus noise."""
    e = random.normal(size=shape)
    for k in range(1, shape[-1]):
        e[..., k] += memory * e[..., k - 1]
    return e


def intervals(errors: np.ndarray) -> np.ndarray:
    """Intervals (RUNS, 2) of the ratio of two errors of one episode each, (RUNS, 2, T)."""
    found = []
    for before, after in errors[..., None]:
        cut = independent_parts(before[None], after[None], np.zeros(1, int))
        found.append(reduction_interval(cut.before, cut.after, cut.parts, np.random.default_rng(0))[:, 0])
    return np.array(found)


def test_two_simulations_that_lost_their_way_are_not_told_apart() -> None:
    """Random walks of one size: by ten blocks each, more than half of the intervals leave 1 out."""
    random = np.random.default_rng(0)
    walks = autoregression(random, 1.0, (RUNS, 2, ROWS))
    found = intervals(walks)
    wrong = (found[:, 0] > 1) | (found[:, 1] < 1)
    by_blocks = []
    for before, after in walks[..., None]:
        blocks = [e.reshape(BLOCKS, -1, 1) for e in (before, after)]
        by_blocks.append(reduction_interval(*blocks, np.arange(BLOCKS), np.random.default_rng(0))[:, 0])
    told = np.array(by_blocks)
    assert ((told[:, 0] > 1) | (told[:, 1] < 1)).mean() > 0.5
    assert wrong.mean() < 0.025
    assert np.isnan(found[:, 0]).mean() > 0.95


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_errors_that_are_forgotten_have_an_interval_that_covers(memory: float) -> None:
    random = np.random.default_rng(1)
    errors = autoregression(random, memory, (RUNS, 2, ROWS))
    errors[:, 1] /= 1.5
    found = intervals(errors)
    assert np.isfinite(found).all()
    assert 0.8 < ((found[:, 0] < 1.5) & (found[:, 1] > 1.5)).mean() <= 0.99
    assert (found[:, 0] > 1).mean() > 0.9


def test_one_channel_that_is_lost_takes_no_interval_from_another() -> None:
    random = np.random.default_rng(2)
    lost, fine = np.arange(ROWS) // 300 + 1.0, random.normal(size=ROWS)
    errors = np.stack([lost, fine], axis=1)[None]
    cut = independent_parts(errors, 0.5 * errors, np.zeros(1, int))
    assert (cut.parts[:, 0] == NO_PART).all()
    assert len(np.unique(cut.parts[:, 1])) == BLOCKS
    interval = reduction_interval(cut.before, cut.after, cut.parts, random)
    assert np.isnan(interval[:, 0]).all()
    np.testing.assert_allclose(interval[:, 1], 2.0)


def test_blocks_of_few_episodes_lose_no_error() -> None:
    errors = np.random.default_rng(0).normal(size=(2, 37, 3))
    cut = independent_parts(errors, 2 * errors, np.array([0, 1]))
    assert cut.before.shape[0] == len(cut.parts) == 2 * BLOCKS
    np.testing.assert_allclose(np.nansum(cut.before**2, axis=(0, 1)), np.sum(errors**2, axis=(0, 1)))
    several = independent_parts(np.repeat(errors, 2, axis=0), np.repeat(errors, 2, axis=0), np.array([5, 7, 5, 9]))
    assert several.before.shape == (4, 37, 3)
    assert several.parts[:, 1].tolist() == [0, 1, 0, 2]


def test_correlation_time_of_an_autoregression() -> None:
    random = np.random.default_rng(0)
    e = autoregression(random, 0.8, (40, 500))
    assert correlation_time(e) == pytest.approx((1 + 0.8) / (1 - 0.8), rel=0.15)
    assert correlation_time(random.normal(size=(40, 500))) == pytest.approx(1.0, abs=0.05)
    assert correlation_time(np.full((2, 5), np.nan)) == 1.0


def test_a_swing_that_began_wrong_is_one_error() -> None:
    """Two episodes of three swings each, whose sizes are chance: the squares come and go, and say nothing new each time."""
    random = np.random.default_rng(3)
    swings = np.sin(2 * np.pi * 3 * np.arange(60) / 60 + random.uniform(0, 6, (RUNS, 2, 2, 1)))
    sizes = random.lognormal(sigma=0.5, size=(RUNS, 2, 2, 1))
    wrong = []
    for before, after in swings * sizes:
        cut = independent_parts(before[..., None], after[..., None], np.arange(2))
        low, high = reduction_interval(cut.before, cut.after, cut.parts, random)[:, 0]
        wrong.append(low > 1 or high < 1)
    assert np.mean(wrong) < 0.05


def test_a_channel_of_one_episode_in_many_has_no_interval() -> None:
    """Every resample of episodes would have the same ratio: a point, however few values there are."""
    random = np.random.default_rng(0)
    before, after = random.normal(size=(2, 10, 40, 2))
    before[1:, :, 1], after[1:, :, 1] = np.nan, np.nan
    cut = independent_parts(before, after, np.arange(10))
    interval = reduction_interval(cut.before, cut.after, cut.parts, np.random.default_rng(1))
    assert np.isfinite(interval[:, 0]).all()
    assert np.isnan(interval[:, 1]).all()
