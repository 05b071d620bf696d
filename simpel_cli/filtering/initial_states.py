"""Where windows begin in the states that nothing measures.

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
    """Return windows with a better guess of the first value of every state that nothing measures.

    Args:
        filtering: of the models.
        z: unit coordinates of a model with loud noise.
        windows: whose first states are guessed.
        rows: of a window that the guess may look at; None: all of them.
    """
    augmented = filtering.plan.augmented
    states = augmented.model.states
    hidden = [i for i, q in enumerate(states) if q.name not in augmented.measured]
    if not hidden:
        return windows
    low, high = (np.array([getattr(states[i], end) for i in hidden]) for end in ("low", "high"))
    first = windows.spread[:, hidden]
    for _ in range(PASSES):
        try:
            found = smooth(filtering.track(z, windows if rows is None else windows.first(rows)))
        except np.linalg.LinAlgError:
            break
        mean = found.mean[:, 0][:, hidden]
        sd = np.sqrt(np.maximum(np.stack([found.cov[:, 0, i, i] for i in hidden], axis=1), 0.0))
        known = np.isfinite(mean) & np.isfinite(sd)
        start, spread = windows.start.copy(), windows.spread.copy()
        start[:, hidden] = np.where(known, np.clip(mean, low, high), start[:, hidden])
        spread[:, hidden] = np.where(known, np.clip(WIDE * sd, LEAST * first, MOST * first), spread[:, hidden])
        windows = windows._replace(start=start, spread=spread)
    return windows


def moved(before: Windows, after: Windows) -> bool:
    """Whether windows begin elsewhere than before."""
    return bool(np.any(np.abs(after.start - before.start) > MOVED * before.spread))
