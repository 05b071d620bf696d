"""Measurement noise with heavy tails: Student's t as a scale mixture, so that a value that lies far off costs itself little.

Given the state, y = h(x) + r, r ~ N(0, R/w), w ~ Gamma(nu/2, nu/2). The smoother of a model tells what all
values say of each one; with its residual rho and the variance V of h there,

    E[r^2] = rho^2 + V,    w = (nu + 1)/(nu + E[r^2]/R),    rho/sqrt(R/w - V) = error of the value left out, standardised

and nu is the one with which these errors are most probable. A wrong model may look like heavy tails, too, since it errs now
more, now less: they are judged beside the effects that were found. Of Gaussian noise all weights are 1, and nothing changes.

Reference: Lange, Little and Taylor (1989), Robust statistical modeling using the t distribution; Rauch, Tung and Striebel
(1965).
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.latent_force import smooth
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.priors.noise_law import TAILS, profile

LEAST_GAIN = 10.0  # nats that Student's t has to be ahead by, as an effect has: a few spikes are left out one by one
LEAST_ROOM = 0.05  # of a value's variance that its smoother must leave to it
ROUNDS = 3  # of weights, at one and the same model


class Residuals(NamedTuple):
    """What all values say of each one, (W, T, ny) each; NaN where nothing counts.

    Args:
        alone: standardised error of the value left out.
        squared: expected square of its noise, in R.
    """

    alone: np.ndarray
    squared: np.ndarray


def heavy_tails(assessor: Assessor, z: np.ndarray, windows: Windows) -> np.ndarray | None:
    """Return 1/nu of every channel, (ny,), or None where Gaussian noise explains the measurements as well.

    Args:
        assessor: of the models.
        z: unit coordinates of the model that was chosen.
        windows: in which no value is weighed yet.
    """
    found = _residuals(assessor, z, windows)
    if found is None:
        return None
    columns = [a[np.isfinite(a)] for a in np.moveaxis(found.alone, 2, 0)]
    scores = np.stack([profile(a)[0] if a.size else np.zeros(len(TAILS) + 1) for a in columns])
    gains = scores[:, 1:] - scores[:, :1]
    best = np.argmax(gains, axis=1)
    heavy = gains.max(axis=1) > LEAST_GAIN
    return np.where(heavy, TAILS[best], 0.0) if heavy.any() else None


def weighed(assessor: Assessor, z: np.ndarray, windows: Windows, tail: np.ndarray) -> Windows:
    """Return windows in which every value that counts does so by its weight; tail: 1/nu of every channel, (ny,)."""
    alone = windows.ok  # how much a value counts by the scale of its noise
    for _ in range(ROUNDS):
        found = _residuals(assessor, z, windows)
        if found is None:
            break
        weight = (1 + tail) / (1 + tail * np.where(np.isfinite(found.squared), found.squared * alone, 1.0))
        windows = windows._replace(ok=np.where(alone > 0, alone * weight, 0.0))
    return windows


def _residuals(assessor: Assessor, z: np.ndarray, windows: Windows) -> Residuals | None:
    track = assessor(z, windows).track
    try:
        smoothed = smooth(track)
    except np.linalg.LinAlgError:  # a filter that is sure of everything, as of a stuck sensor
        return None
    variance = np.asarray(assessor.plan.coordinates.physical(jnp.asarray(z))[1].r) ** 2
    left = track.innovation - np.einsum("wtji,wti->wtj", track.slope, smoothed.mean - track.predicted)
    there = np.maximum(np.einsum("wtji,wtik,wtjk->wtj", track.slope, smoothed.cov, track.slope), 0.0)
    own = variance / np.where(windows.ok > 0, windows.ok, 1.0)
    counts = windows.ok > 0
    alone = left / np.sqrt(np.maximum(own - there, LEAST_ROOM * own))
    return Residuals(*(np.where(counts, a, np.nan) for a in (alone, (left**2 + there) / variance)))


def sentence_of(degrees_of_freedom: Mapping[str, float]) -> str:
    """Return what a verdict says of noise with heavy tails; nothing where all of it is Gaussian."""
    heavy = [f"{name} (Student's t with {nu:.2g} degrees of freedom)" for name, nu in degrees_of_freedom.items()]
    return f" The noise of {' and '.join(heavy)} has heavy tails; values that lie far off count less." if heavy else ""
