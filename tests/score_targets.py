"""Laws whose scores are known, with draws of them."""

from collections.abc import Callable

import numpy as np

from tests import oracles

Target = tuple[Callable[[int], np.ndarray], Callable[[np.ndarray], np.ndarray]]


def covariance_of(m: int) -> np.ndarray:
    """Smooth functions plus noise at m points."""
    t = np.linspace(0, 1, m)
    return 0.9 * oracles.squared_exponential(t, t, 0.3) + 0.1 * np.eye(m)


def target(name: str, m: int, seed: int = 0) -> Target:
    """Draws and exact score of a correlated Gaussian, of two of them apart, and of a skewed law."""
    random = np.random.default_rng(seed)
    covariance = covariance_of(m)
    root, apart = np.linalg.cholesky(covariance), 2 * np.ones(m)

    def smooth(n: int) -> np.ndarray:
        return random.normal(size=(n, m)) @ root.T

    if name == "gaussian":
        return smooth, lambda h: oracles.gaussian_score(h, np.zeros(m), covariance)
    if name == "mixture":
        return (
            lambda n: smooth(n) + random.choice([-1.0, 1.0], (n, 1)) * apart,
            lambda h: oracles.mixture_score(h, np.stack([apart, -apart]), covariance),
        )
    return (
        lambda n: np.exp(0.5 * random.normal(size=(n, m))) @ root.T,
        lambda h: oracles.lognormal_score(h, root, 0.5),
    )
