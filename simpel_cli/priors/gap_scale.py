"""Scales of the gap GP and of the noise, chosen by the marginal likelihood of the training transitions (empirical Bayes).

    y ~ N(mean(g), cov(g) + kappa^2 rho(X, X) + w I + sigma^2 W^-1),   maximise over kappa and sigma

The function is integrated out, so that the noise is not what a network leaves that goes through every one of a few points.

Reference: MacKay (1992), Bayesian interpolation; Rasmussen and Williams (2006), section 5.4.1, eq. 5.9 (gradient).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize, minimize_scalar

BOUNDS = float(np.log(1e-3)), float(np.log(10.0))  # of log kappa and log sigma
LEVELS = 41


class Scales(NamedTuple):
    """Standard deviations of the gap and of the noise of one output, normalised."""

    gap: float
    noise: float


def marginal_likelihood_scales(
    samples: np.ndarray,
    correlation: np.ndarray,
    targets: np.ndarray,
    noise_init: float,
    white_variance: float | np.ndarray,
    gap: float | None = None,
) -> Scales:
    """Return the kappa and sigma of one output that maximise its (penalised) log marginal likelihood.

    log sigma has the learned noise's prior N(log noise_init, 1), log kappa a weak N(log 0.1, 2^2), which decides where
    few data do not.

    Args:
        samples: draws of the simulator at the training inputs, normalised, shape (N, m).
        correlation: of the gap at the training inputs, shape (m, m).
        targets: normalised targets, shape (m,).
        noise_init: initial noise, normalised.
        white_variance: white model error of the prior, of all rows or of each, shape (m,). Where samples, correlation and
            targets were multiplied by the roots of the rows' weights W, it is w W: only noise goes with the weight.
        gap: kappa, where it is known; None: it is chosen, too.
    """
    residual = targets - samples.mean(axis=0)
    covariance = np.atleast_2d(np.cov(samples, rowvar=False))
    if gap is not None:
        return Scales(gap, _noise(covariance + gap**2 * correlation, residual, noise_init, white_variance))
    identity, white = np.eye(len(targets)), np.diag(np.broadcast_to(white_variance, len(targets)))

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        kappa2, sigma2 = np.exp(2 * theta)
        factor = cho_factor(covariance + kappa2 * correlation + white + sigma2 * identity, lower=True)
        inverse = cho_solve(factor, identity)
        weights = inverse @ residual
        fit = residual @ weights / 2 + np.log(np.diag(factor[0])).sum()
        along_gap = kappa2 * (np.sum(inverse * correlation) - weights @ correlation @ weights)
        along_noise = sigma2 * (np.trace(inverse) - weights @ weights)
        off = theta - np.log([0.1, noise_init])
        return fit + off @ (off / [8, 2]), np.array([along_gap, along_noise]) + off / [4, 1]

    # a small gap and much noise, or the other way round: there may be an optimum of each kind
    starts = [np.log([kappa, noise_init]) for kappa in (0.03, 0.3)]
    found = (minimize(objective, s, bounds=[BOUNDS, BOUNDS], method="L-BFGS-B", jac=True) for s in starts)
    kappa, sigma = (float(v) for v in np.exp(min(found, key=lambda r: r.fun).x))
    return Scales(kappa, sigma)


def _noise(
    covariance: np.ndarray, residual: np.ndarray, noise_init: float, white_variance: float | np.ndarray
) -> float:
    """Return sigma where the covariance of the function is known."""
    values, vectors = np.linalg.eigh(covariance + np.diag(np.broadcast_to(white_variance, len(residual))))
    turned = vectors.T @ residual

    def of_noise(log_sigma: float) -> float:
        total = np.maximum(values, 0.0) + np.exp(2 * log_sigma)
        return float(np.sum(turned**2 / total + np.log(total))) / 2 + (log_sigma - np.log(noise_init)) ** 2 / 2

    levels = np.linspace(*BOUNDS, LEVELS)
    best = int(np.argmin([of_noise(level) for level in levels]))
    beside = float(levels[max(best - 1, 0)]), float(levels[min(best + 1, LEVELS - 1)])
    return float(np.exp(minimize_scalar(of_noise, bounds=beside, method="bounded").x))
