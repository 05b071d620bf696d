"""How much of the residual is gone: what is claimed of an effect has to show in the errors.

Of the mean square error e^2 so many rows ahead the measurement noise r^2 is no fault of the model. Per measured quantity the
share that is gone is 1 - (e_after^2 - r^2) / (e_before^2 - r^2); a quantity that was near its noise before says nothing.
"""

from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.near import NEAR

MOST = 0.5  # of the residual: what explains less, with something left, does not explain it
SOME = 0.1  # likewise, where nothing is left that is no white noise


class Explained(NamedTuple):
    """What effects explain of the residual.

    Args:
        share: of the mean square error beyond the noise, mean over quantities; nan: none was beyond it.
        near: whether the errors after are near the noise, of every quantity.
        worst: the quantity that is farthest from its noise, its place among the measured ones.
        times: its error after, in units of its noise.
    """

    share: float
    near: bool
    worst: int
    times: float

    def enough(self, *, left: bool) -> bool:
        """Whether the residual may be called explained; left: whether an error remains that is no white noise."""
        if not np.isfinite(self.share):  # nothing was beyond the noise before
            return True
        return self.near or bool(self.share >= (MOST if left else SOME))


def shares(before: np.ndarray, after: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the share of the mean square error beyond the noise that is gone, (ny,); nan: none was, or it is not known."""
    beyond = np.isfinite(before) & np.isfinite(after) & (noise > 0) & (before > NEAR * noise)
    first, second = (np.maximum(e**2 - noise**2, 0.0) for e in (before, after))
    return np.where(beyond, 1 - second / np.where(beyond, first, 1.0), np.nan)


def explained(before: np.ndarray, after: np.ndarray, noise: np.ndarray) -> Explained:
    """Compare errors with the noise; all (ny,), nan where nothing was measured."""
    known = np.isfinite(before) & np.isfinite(after) & (noise > 0)
    if not known.any():
        return Explained(float("nan"), near=True, worst=0, times=float("nan"))
    times = np.where(known, after / noise, -np.inf)
    gone = shares(before, after, noise)
    gone = gone[np.isfinite(gone)]
    worst = int(np.argmax(times))
    return Explained(
        float(np.mean(gone)) if gone.size else float("nan"), bool(times[worst] <= NEAR), worst, float(times[worst])
    )
