"""Intervals: what is resampled, and the spread of a statistic over resampled data."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Blocks(NamedTuple):
    """Resampling units: whole episodes where there are enough, else contiguous pieces of them."""

    of_point: np.ndarray  # (n,) block of every point
    kind: str


def blocks_of(episode: np.ndarray, row: np.ndarray, length: int) -> Blocks:
    """Assign points to blocks for the bootstrap.

    Args:
        episode: episode index per point, shape (n,).
        row: row in the episode per point, shape (n,).
        length: rows per block where there are fewer than 10 episodes.

    Reference: Kuensch (1989), The jackknife and the bootstrap for general stationary observations.
    """
    if len(np.unique(episode)) >= 10:
        return Blocks(np.unique(episode, return_inverse=True)[1], "episodes")
    pairs = np.stack([episode, row // max(length, 1)], axis=1)
    return Blocks(np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1), f"blocks of {length} rows")


class Estimate(NamedTuple):
    """A metric with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


def bootstrap(
    points: np.ndarray, blocks: Blocks, statistic: Callable[[np.ndarray], np.ndarray], resamples: int = 1000
) -> Estimate:
    """Estimate statistic(mean over points) with a percentile interval over resampled blocks.

    Args:
        points: per-point quantities, shape (n, ...).
        blocks: block of every point.
        statistic: maps means (..., k) over the trailing axes to a number, vectorised over the leading axis.
        resamples: number of bootstrap samples.

    Reference: Efron and Tibshirani (1993), section 13.3.
    """
    n_blocks = int(blocks.of_point.max()) + 1
    flat = points.reshape(len(points), -1)
    sums = np.zeros((n_blocks, flat.shape[1]))
    np.add.at(sums, blocks.of_point, flat)
    sizes = np.bincount(blocks.of_point, minlength=n_blocks).astype(float)
    rng = np.random.default_rng(0)  # resampling noise is no part of an experiment's seed
    counts = rng.multinomial(n_blocks, np.full(n_blocks, 1 / n_blocks), size=resamples).astype(float)
    means = (counts @ sums) / (counts @ sizes)[:, None]
    shape = (-1, *points.shape[1:])
    value = float(statistic(flat.mean(axis=0).reshape(1, *points.shape[1:]))[0])
    if n_blocks == 1:
        return Estimate(value, np.nan, np.nan)  # one block says nothing of the spread between blocks
    low, high = np.quantile(statistic(means.reshape(shape)), [0.025, 0.975])
    return Estimate(value, float(low), float(high))


def interval_rows(metric: str, output: str, unit: str, estimate: Estimate) -> list[dict[str, object]]:
    """Return the three metric rows of an estimate."""
    values = {metric: estimate.value, f"{metric}_low": estimate.low, f"{metric}_high": estimate.high}
    return [{"metric": m, "output": output, "unit": unit, "value": v} for m, v in values.items()]
