"""Where windows begin in the states that nothing measures, or of which the first value is missing.

The middle of the range, with all of the range as spread, is too much for a filter that linearises: a level enters under a
root. So a smoother looks back at the first row, and the filter begins anew from there, some times over. The spread stays
wide: the data say again where the state is, and the parameters are not known yet.

Reference: Bell (1994), The iterated Kalman smoother as a Gauss-Newton method.
"""

import numpy as np

from simpel_cli.filtering.likelihood.latent_force import smooth
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.tracks import Tracking

PASSES = 4
WIDE = 3.0  # standard deviations of the smoother
MOVED = 0.1  # of the spread
LEAST, MOST = 0.15, 1.0  # of the spread that it began with


def begun(filtering: Tracking, z: np.ndarray, windows: Windows, rows: int | None = None) -> Windows:
    """Return windows with a better guess of every first state that nothing measured.

    Args:
        filtering: of the models.
        z: unit coordinates of a model with loud noise.
        windows: whose first states are guessed.
        rows: of a window that the guess may look at; None: all of them.
    """
    unseen = _unseen(filtering, windows)
    if not unseen.any():
        return windows
    states = filtering.plan.augmented.model.states
    measured = np.isin([q.name for q in states], filtering.plan.augmented.measured)  # its range is what was expected
    low = np.where(measured, -np.inf, [q.low for q in states])
    high = np.where(measured, np.inf, [q.high for q in states])
    wide = windows.spread
    for _ in range(PASSES):
        try:
            found = smooth(filtering.track(z, windows if rows is None else windows.first(rows)))
        except np.linalg.LinAlgError:
            break
        mean = found.mean[:, 0]
        sd = np.sqrt(np.maximum(np.diagonal(found.cov[:, 0], axis1=1, axis2=2), 0.0))
        known = unseen & np.isfinite(mean) & np.isfinite(sd)
        windows = windows._replace(
            start=np.where(known, np.clip(mean, low, high), windows.start),
            spread=np.where(known, np.clip(WIDE * sd, LEAST * wide, MOST * wide), windows.spread),
        )
    return windows


def _unseen(filtering: Tracking, windows: Windows) -> np.ndarray:
    """Return which states no sensor shows in the first row of a window, (W, nx)."""
    augmented = filtering.plan.augmented
    there = windows.ok[:, 0] > 0
    columns = {name: there[:, j] for j, name in enumerate(augmented.measured)}
    nowhere = np.zeros(len(there), bool)
    return np.stack([~columns.get(q.name, nowhere) for q in augmented.model.states], axis=1)


def moved(before: Windows, after: Windows) -> bool:
    """Whether windows begin elsewhere than before."""
    return bool(np.any(np.abs(after.start - before.start) > MOVED * before.spread))
