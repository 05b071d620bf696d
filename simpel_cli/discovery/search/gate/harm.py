"""Whether an effect does harm where both models, with and without it, are calibrated for what they will be used for.

The gate judges models as the innovations calibrated them. One that is still wrong somewhere has parameters then that predict
the next row best, and an effect that is right may make errors further ahead grow beside them. Where a use is named, the last
calibration is for that: so an effect that certainly earns its place on held-out parts, but makes an error grow, is judged once
more with both models calibrated for the use, on parts that had no part in that.
"""

from functools import partial

import numpy as np

from simpel_cli.discovery.search.gate.held_out import AMPLE, Errors, errors_of, growing
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.uses import calibrated_for
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.measurements.windows import LEAST_EPISODES, Windows

FOLDS = 2


def growing_for(
    search: Search, assessor: Assessor, whole: Trial, part: Trial, use: str | float
) -> tuple[str, ...] | None:
    """Return which errors certainly grow from one model to another, both calibrated for a use; None: too few parts to tell.

    Args:
        search: that they come from.
        assessor: of its program.
        whole: with an effect.
        part: without it.
        use: FREE_RUN, or how far ahead, s.
    """
    windows, spare = search.plan.windows, search.plan.spare
    if spare is not None and (spare.ok > 0).sum() >= AMPLE * (windows.ok > 0).sum():
        size = len(windows.episode)
        whole_batches = range(0, len(spare.episode) - size + 1, size)  # as many at a time: they share a program
        splits = [(windows, _some(spare, np.arange(begin, begin + size))) for begin in whole_batches]
        groups = [size * k + np.arange(size) for k in range(len(splits))]
    else:
        names = np.unique(windows.episode)
        if len(names) < LEAST_EPISODES:
            return None
        folds = np.array_split(np.random.default_rng(0).permutation(names), FOLDS)
        outs = [np.isin(windows.episode, fold) for fold in folds]
        splits = [(_some(windows, np.flatnonzero(~out)), _some(windows, np.flatnonzero(out))) for out in outs]
        groups = [windows.episode[out] for out in outs]
    if not splits:
        return None
    both: list[Errors] = []
    for trial in (part, whole):
        found: list[Errors] = []
        for seen, held in splits:
            # the model with all effects is compared with many that lack one
            asked = (
                "calibrated for",
                use,
                trial.terms,
                trial.optimum.z.tobytes(),
                seen.episode.tobytes(),
                seen.begin.tobytes(),
            )
            fitted = search.once(asked, partial(calibrated_for, search, assessor, trial, seen, use))
            found.append(errors_of(assessor(fitted.optimum.z, held)))
        both.append({words: np.concatenate([errors[words] for errors in found]) for words in found[0]})
    before, after = both
    return growing(before, after, search.plan.augmented.measured, np.concatenate(groups))


def _some(windows: Windows, which: np.ndarray) -> Windows:
    return Windows(*(a[which] for a in windows))
