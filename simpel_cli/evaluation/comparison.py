"""Methods compared over seeds: means with intervals, differences in pairs, what is best and whether that is certain."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

LEVEL = 0.95
# words of a run that do not make it another method: they are columns, or change no result
APART = (
    "method=", "data.n_train=", "experiment=", "data=", "run.seed=", "run.seeds=", "run.name=", "run.quiet=", "run.figures=",
    "hydra.", "hydra/",
)  # fmt: skip


class Metric(NamedTuple):
    """A metric that runs are compared by.

    Args:
        name: in `metrics.parquet`.
        label: in tables and figures.
        sign: 1 where more is better, -1 where less is, 0 where neither.
        least, most: that there can be.
    """

    name: str
    label: str
    sign: int
    least: float = -np.inf
    most: float = np.inf

    def over(self, seeds: Iterable[float]) -> "Mean":
        """Return the mean of one value per seed; its interval ends where there can be nothing."""
        found = mean(seeds)
        low, high = np.clip((found.low, found.high), self.least, self.most)
        return found._replace(low=float(low), high=float(high))


METRICS = {  # verb -> the first is the one that the best is chosen by
    "fit": (
        Metric("nll", "test NLL [nat]", -1),
        Metric("nrmse", "test RMSE, normalised", -1),
        Metric("coverage_90", "targets inside the 90 % region", 0, 0, 1),
    ),
    "rl-offline": (
        Metric("return_in_truth", "return in the truth", 1),
        Metric("success", "episodes that succeed", 1, 0, 1),
        Metric("return_in_model", "return in the model", 0),
    ),
    "rl-online": (
        Metric("return", "return, mean of all episodes", 1),
        Metric("success", "episodes that succeed", 1, 0, 1),
    ),
}
METRICS |= {"evaluate": METRICS["fit"], "discover": METRICS["fit"]}


class Point(NamedTuple):
    """One value of one seed.

    Args:
        panel: verb, experiment, data set: what may be compared with each other.
        variant: method and whatever else tells it from the others.
        size: training transitions.
        seed: of the run.
        metric: name.
        step: of the run; the episode of an online one.
        value: of the joint of all outputs.
    """

    panel: tuple[str, str, str]
    variant: str
    size: int
    seed: int
    metric: str
    step: int
    value: float


class Mean(NamedTuple):
    """A mean over seeds with its 95 % interval (NaN: one seed says nothing of it).

    Student's t: seeds are few, and independent of each other.

    Args:
        value, low, high: the mean and the ends of its interval.
        seeds: how many.
    """

    value: float
    low: float
    high: float
    seeds: int

    @property
    def certain(self) -> bool:
        """Whether the interval lies on one side of zero."""
        return bool(self.low > 0 or self.high < 0)


def variant(row: dict[str, Any], words: Iterable[str]) -> str:
    """Return the name of what a run is an example of: its method, and every word that sets it apart from other runs."""
    own = [word for word in words if "=" in word and not word.startswith(APART)]
    return " ".join([row["method"] or row["command"], *own])


def points(rows: Iterable[dict[str, Any]], words: Iterable[str]) -> list[Point]:
    """Return the test values of a run that are of all outputs together.

    Args:
        rows: of its metrics.
        words: its overrides, less those that it shares with every other run.
    """
    words = list(words)
    return [
        Point(
            (row["command"], row["experiment"] or "", row["data"] or ""),
            variant(row, words),
            row["n_train"] or 0,
            row["seed"] or 0,
            row["metric"],
            row["step"] or 0,
            row["value"],
        )
        for row in rows
        if row["split"] == "test" and row["output"] in ("joint", "", None) and row["value"] is not None
    ]


def by_seed(every: Sequence[Point], metric: str) -> dict[tuple[str, int], dict[int, float]]:
    """Return (variant, size) -> seed -> value; a seed that was run several times, or has several episodes, has their mean."""
    gathered: dict[tuple[str, int], dict[int, list[float]]] = {}
    for point in every:
        if point.metric == metric:
            gathered.setdefault((point.variant, point.size), {}).setdefault(point.seed, []).append(point.value)
    return {cell: {seed: float(np.mean(values)) for seed, values in seeds.items()} for cell, seeds in gathered.items()}


def mean(values: Iterable[float]) -> Mean:
    """Return the mean of independent values with its interval."""
    own = np.array(list(values), dtype=float)
    count = len(own)
    centre = float(own.mean()) if count else float("nan")
    if count < 2:
        return Mean(centre, float("nan"), float("nan"), count)
    half = float(scipy.stats.t.ppf((1 + LEVEL) / 2, count - 1) * own.std(ddof=1) / count**0.5)
    return Mean(centre, centre - half, centre + half, count)


def difference(own: dict[int, float], other: dict[int, float]) -> Mean:
    """Return own - other in pairs of one seed, which share their data: what both have in common cancels."""
    return mean(own[seed] - other[seed] for seed in sorted(own.keys() & other.keys()))


class Best(NamedTuple):
    """The best variant of a size.

    Args:
        size: training transitions.
        variant: its name.
        score: its mean.
        second: the next one; empty: there is none.
        lead: by how much it is better than the second, in pairs of one seed; positive is better.
    """

    size: int
    variant: str
    score: Mean
    second: str
    lead: Mean


def best(cells: dict[tuple[str, int], dict[int, float]], metric: Metric) -> list[Best]:
    """Return the best variant of every size, and its lead."""
    found = []
    for size in sorted({size for _, size in cells}):
        scores = {name: metric.over(seeds.values()) for (name, n), seeds in cells.items() if n == size}
        order = sorted(
            scores, key=lambda name: (not np.isfinite(scores[name].value), -metric.sign * scores[name].value)
        )
        second = order[1] if len(order) > 1 else ""
        lead = difference(cells[order[0], size], cells[second, size]) if second else mean([])
        if metric.sign < 0:
            lead = Mean(-lead.value, -lead.high, -lead.low, lead.seeds)
        found.append(Best(size, order[0], scores[order[0]], second, lead))
    return found
