"""The latent force: what a model leaves unexplained in every row, with its uncertainty, given all measurements.

    x_s[k] = m[k] + G[k] (x_s[k+1] - m[k+1|k]),    G[k] = P[k] F[k]' P[k+1|k]^-1
    P_s[k] = P[k] + G[k] (P_s[k+1] - P[k+1|k]) G[k]',    cov(x[k+1], x[k]) = P_s[k+1] G[k]'
    force[k] = (x_s[k+1] - flow(x_s[k]))/dt

A finite difference of the measurements divides their noise by dt; here the noise is weighed against the process noise that
the data ask for, over the whole record.

Reference: Rauch, Tung and Striebel (1965); Sarkka (2013), Bayesian filtering and smoothing, theorem 8.2.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from simpel_cli.filtering.likelihood.coordinates import Coordinates
from simpel_cli.filtering.likelihood.filter import MOST_KEPT
from simpel_cli.filtering.likelihood.track import Filter, Track
from simpel_cli.filtering.measurements.windows import Windows

CHUNK = 512  # rows of one call of the compiled flow
JITTER = 1e-12  # of a covariance scaled to a unit diagonal


class Smoothed(NamedTuple):
    """States given all measurements of their window, and what moved them beside the model; NaN where a filter diverged.

    Args:
        mean: (W, T, nx).
        cov: (W, T, nx, nx).
        moved: (W, T - 1, nx) the state of the next row minus what the model's linearised flow says.
        moved_cov: (W, T - 1, nx, nx).
    """

    mean: np.ndarray
    cov: np.ndarray
    moved: np.ndarray
    moved_cov: np.ndarray


def smooth(track: Track) -> Smoothed:
    """Run the Rauch-Tung-Striebel smoother backwards over the filter's track, (W, T, ...) each."""
    given = (track.predicted, track.predicted_cov, track.mean, track.cov, track.jacobian)
    fields = [np.asarray(a, float) for a in given]
    finite = np.all([np.isfinite(a).reshape(len(a), -1).all(axis=1) for a in fields], axis=0)
    eye = np.eye(fields[0].shape[-1])
    predicted, predicted_cov, mean, cov, jacobian = (
        np.where(finite.reshape(-1, *[1] * (a.ndim - 1)), a, eye if a.ndim == 4 else 0.0) for a in fields
    )
    x, p = mean.copy(), cov.copy()
    moved, moved_cov = np.zeros_like(mean[:, 1:]), np.zeros_like(cov[:, 1:])
    gains = _right_divide(cov[:, :-1] @ _t(jacobian[:, :-1]), predicted_cov[:, 1:])
    for k in range(mean.shape[1] - 2, -1, -1):
        f, gain = jacobian[:, k], gains[:, k]
        x[:, k] += _apply(gain, x[:, k + 1] - predicted[:, k + 1])
        p[:, k] += gain @ (p[:, k + 1] - predicted_cov[:, k + 1]) @ _t(gain)
        p[:, k] = (p[:, k] + _t(p[:, k])) / 2
        cross = f @ gain @ p[:, k + 1]  # cov(flow of x[k], x[k+1])
        moved[:, k] = x[:, k + 1] - predicted[:, k + 1] - _apply(f, x[:, k] - mean[:, k])
        moved_cov[:, k] = p[:, k + 1] + f @ p[:, k] @ _t(f) - cross - _t(cross)
    lost = ~finite
    for array in (x, p, moved, moved_cov):
        array[lost] = np.nan
    return Smoothed(x, p, moved, moved_cov)


def _t(a: np.ndarray) -> np.ndarray:
    return np.swapaxes(a, -1, -2)


def _apply(a: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("wij,wj->wi", a, x)


def _right_divide(a: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return a p^-1 of covariances p, scaled so that units do not matter."""
    scale = np.sqrt(np.maximum(np.diagonal(p, axis1=-2, axis2=-1), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(p / (scale[..., :, None] * scale[..., None, :]))
    # of a filter that is nearly sure, rounding can leave a variance below zero
    inverse = (vectors / (np.maximum(values, JITTER) + JITTER)[..., None, :]) @ _t(vectors)
    return (a / scale[..., None, :]) @ inverse / scale[..., None, :]


class Force(NamedTuple):
    """Latent force of a model on windows.

    Args:
        state: (W, T, nx) smoothed.
        force: (W, T - 1, nx) per second.
        std: (W, T - 1, nx).
    """

    state: np.ndarray
    force: np.ndarray
    std: np.ndarray


class Forces:
    """Latent forces of one setup's models; the flow is compiled once for all of them."""

    def __init__(self, rule: Filter, coordinates: Coordinates, dt: float) -> None:
        self.coordinates, self.dt = coordinates, dt
        self._flow, self._arriving = _programs(rule)

    def __call__(self, z: np.ndarray, track: Track, windows: Windows) -> Force:
        """Return the latent force of the model at unit coordinates z, from its filter's track."""
        smoothed = smooth(track)
        pace = windows.clock[:, :-1, :1]
        step = self.dt * pace if pace.shape[2] else self.dt
        force = (smoothed.mean[:, 1:] - self.following(z, smoothed.mean, windows)[:, :-1]) / step
        variance = np.maximum(np.diagonal(smoothed.moved_cov, axis1=-2, axis2=-1), 0.0)
        return Force(smoothed.mean, force, np.sqrt(variance) / step)

    def inputs(self, z: np.ndarray, windows: Windows) -> np.ndarray:
        """Return the inputs as they arrive, (W, T, nu), the mean of every row."""
        p, _ = self.coordinates.physical(jnp.asarray(z))
        return np.asarray(self._arriving(p, jnp.asarray(windows.u))).mean(axis=(2, 3))

    def following(self, z: np.ndarray, state: np.ndarray, windows: Windows) -> np.ndarray:
        """Return where the model takes every state, (W, T, nx), in one row."""
        p, _ = self.coordinates.physical(jnp.asarray(z))
        u = np.asarray(self._arriving(p, windows.arrays[2]))
        rows_in_all = state.shape[0] * state.shape[1]
        x, u = state.reshape(rows_in_all, -1), u.reshape(rows_in_all, *u.shape[2:])
        parts = []
        for begin in range(0, len(x), CHUNK):
            rows = np.minimum(np.arange(begin, begin + CHUNK), len(x) - 1)
            parts.append(np.asarray(self._flow(p, x[rows], u[rows])))
        return np.concatenate(parts)[: len(x)].reshape(state.shape)


@lru_cache(maxsize=MOST_KEPT)
def _programs(rule: Filter) -> tuple[Any, Any]:
    return (
        jax.jit(jax.vmap(rule.flow, in_axes=(None, 0, 0))),
        jax.jit(jax.vmap(rule.delayed_inputs, in_axes=(None, 0))),
    )
