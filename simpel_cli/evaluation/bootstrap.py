"""Intervals: what is resampled, and the spread of a statistic over resampled data."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

MIN_EPISODES = 10  # fewer say too little of the spread between episodes


class Blocks(NamedTuple):
    """Resampling units: whole episodes where there are enough, else contiguous pieces of them."""

    of_point: np.ndarray  # (n,) block of every point
    kind: str

    def take(self, rows: np.ndarray) -> "Blocks":
        """Return the blocks of some of the points."""
        return Blocks(np.unique(self.of_point[rows], return_inverse=True)[1].reshape(-1), self.kind)

    def __str__(self) -> str:
        count = len(np.unique(self.of_point))
        return f"{count} {self.kind}" if count > 1 else f"nothing: one of the {self.kind} holds all points"


def blocks_of(episode: np.ndarray, at: np.ndarray, length: float | int, unit: str) -> Blocks:
    """Assign points to blocks for the bootstrap.

    Segments of an episode are not independent of each other: what counts is the episode that they were cut from.

    Args:
        episode: the user's episode of every point, shape (n,).
        at: where in the episode, in `unit`, shape (n,).
        length: of a block in `unit`, where there are fewer than `MIN_EPISODES` episodes.
        unit: `s` or `rows`.

    Reference: Kuensch (1989), The jackknife and the bootstrap for general stationary observations.
    """
    names, code = np.unique(episode, return_inverse=True)
    if len(names) >= MIN_EPISODES:
        return Blocks(code, "episodes")
    first = np.full(len(names), np.inf)
    np.minimum.at(first, code, at)
    # a time that falls on an edge must not come to lie on either side of it by rounding
    window = np.floor((at - first[code]) / length + 1e-6).astype(int)
    pairs = np.stack([code, window], axis=1)
    blocks = np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1)
    return Blocks(blocks, f"windows of {length:g} {unit}")


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
