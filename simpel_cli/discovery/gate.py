"""The held-out gate: an effect must help on episodes that had no part in the choice of its parameters.

On a real rig, evidence alone named a friction with +79 nats while the held-out fit got worse: the gate is mandatory.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.assess import Assessor, gain_interval, reduction_interval
from simpel_cli.discovery.fit import Lane
from simpel_cli.discovery.search import Search, Trial

MOST_FOLDS = 5


class Gate(NamedTuple):
    """Gain in held-out log-likelihood of one model over another.

    Args:
        gain: nats, summed over all held-out parts.
        low, high: 95 % interval, by resampling episodes (or windows, where there are few episodes).
        unit: what was held out at a time.
        harm: whether the errors some rows ahead grow, of every channel and certainly: a model that predicts the next row
            better and all others worse has learnt to follow.
        passed: whether the lower end is positive and there is no harm.
    """

    gain: float
    low: float
    high: float
    unit: str
    harm: bool
    passed: bool


def gates(search: Search, assessor: Assessor, whole: Trial, parts: Sequence[Trial]) -> list[Gate]:
    """Return what a model gains over others that lack a part of it, on episodes that they were not fitted to.

    All are refitted on all but a fold of the training episodes and score that fold, for every fold.
    A model that is nearly right and very sure of it loses hundreds of nats on one odd episode. So the levels of the
    noise, which all models have, are fitted to the fold itself; parameters and effects are not.
    """
    windows = search.plan.windows
    episodes = np.unique(windows.episode)
    unit = "episode" if len(episodes) >= 3 else "window"
    groups = windows.episode if unit == "episode" else np.arange(len(windows.episode))
    names = np.unique(groups)
    order = np.random.default_rng(0).permutation(names)
    folds = [set(part.tolist()) for part in np.array_split(order, min(MOST_FOLDS, len(names)))]
    kept = [np.array([float(g not in fold) for g in groups]) for fold in folds]
    lanes = [Lane(trial.optimum.z, search.free(trial.terms), weight) for trial in (whole, *parts) for weight in kept]
    found = search.fitter(lanes)
    # how loud the noise is says nothing about the effect: all models fit it anew on what was held out
    found = search.fitter([Lane(o.z, search.noise, 1 - lane.weight) for o, lane in zip(found, lanes, strict=True)])
    likelihood = np.zeros((1 + len(parts), len(windows.episode)))
    ahead = np.zeros((1 + len(parts), *windows.y.shape))
    for i, (optimum, lane) in enumerate(zip(found, lanes, strict=True)):
        trial, out = i // len(folds), lane.weight == 0
        assessed = assessor(optimum.z, windows)
        likelihood[trial, out] = assessed.log_likelihood[out]
        ahead[trial, out] = assessed.ahead[out]
    judged = []
    for part in range(1, 1 + len(parts)):
        gains = likelihood[0] - likelihood[part]
        low, high = gain_interval(np.array([gains[groups == name].sum() for name in names]), np.random.default_rng(1))
        harm = harmful(ahead[part], ahead[0], groups)
        judged.append(Gate(float(gains.sum()), low, high, unit, harm, bool(low > 0) and not harm))
    return judged


def harmful(before: np.ndarray, after: np.ndarray, groups: np.ndarray) -> bool:
    """Whether the errors grow in every channel, with 97.5 % certainty; before, after: (W, T, ny), groups: (W,)."""
    best = reduction_interval(before, after, groups, np.random.default_rng(1))[1]
    return bool(np.isfinite(best).any() and np.all(best[np.isfinite(best)] < 1))
