"""A fitted posterior as evaluation sees it, and measured transitions as it reads them."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from simpel_cli.data.recording import Transitions
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.inference.predictive import Predictive

CHUNK = 512  # test inputs per call: one compiled program serves every test set


class Posterior(NamedTuple):
    """A fitted posterior of one seed, as functions of arrays in data units.

    Args:
        predict: inputs (n, dx) to their predictive.
        members: inputs of every particle (L, n, dx) to its targets (L, n, dy).
        particles: L.
        typical: as `predict`, with the noise of a typical row; None: the noise is the same in every row.
        relative: inputs (n, dx) and targets (n, dy) to the noise of each over that of a typical row, (n, dy); None: 1.
    """

    predict: Callable[[np.ndarray], Predictive]
    members: Callable[[np.ndarray], jax.Array]
    particles: int
    typical: Callable[[np.ndarray], Predictive] | None = None
    relative: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None


def noise_of(posterior: Posterior, encoding: Encoding) -> np.ndarray:
    """Return the learned standard deviation of the noise per target, data units, shape (dy,); of a typical row."""
    predict = posterior.typical or posterior.predict
    return np.asarray(predict(np.zeros((CHUNK, encoding.dim_x))).noise_std, dtype=float)


def test_arrays(transitions: Transitions, encoding: Encoding) -> tuple[np.ndarray, np.ndarray]:
    """Return network inputs (n, dx) and targets (n, dy) of measured transitions, data units."""
    x = encoding.to_x(transitions.states, transitions.inputs)
    return x, encoding.to_y(transitions.states, transitions.next_states, transitions.outputs)
