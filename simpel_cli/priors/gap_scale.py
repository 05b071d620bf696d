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


class Loss(NamedTuple):
    """Minus the logarithm of the penalised marginal likelihood of one output, up to a constant.

    Args:
        value: of the loss.
        slope: along log kappa and log sigma, (2,).
        against: kappa^2 [A^-1 - A^-1 e e' A^-1], (m, m): the loss changes by half of its sum with a change of the correlation.
    """

    value: float
    slope: np.ndarray
    against: np.ndarray


def penalised(
    theta: np.ndarray,
    known: np.ndarray,
    correlation: np.ndarray,
    variance: np.ndarray,
    residual: np.ndarray,
    noise_init: float,
) -> Loss:
    """Return the loss for y ~ N(mean, A), A = known + kappa^2 correlation + sigma^2 diag(variance).

    Args:
        theta: log kappa and log sigma, whose priors are N(log 0.1, 2^2) and N(log noise_init, 1).
        known: covariance of all else, (m, m).
        correlation: of the gap, (m, m).
        variance: of the noise of every row, for sigma = 1, (m,).
        residual: y less its mean, e, (m,).
        noise_init: typical noise.
    """
    kappa2, sigma2 = np.exp(2 * theta)
    factor = cho_factor(known + kappa2 * correlation + np.diag(sigma2 * variance), lower=True)
    inverse = cho_solve(factor, np.eye(len(residual)))
    pull = inverse @ residual
    fit = residual @ pull / 2 + np.log(np.diag(factor[0])).sum()
    against = inverse - np.outer(pull, pull)
    slope = np.array([kappa2 * np.sum(against * correlation), sigma2 * np.sum(np.diag(against) * variance)])
    off = theta - np.log([0.1, noise_init])
    return Loss(float(fit + off @ (off / [8, 2])), slope + off / [4, 1], kappa2 * against)


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
    known = covariance + np.diag(np.broadcast_to(white_variance, len(targets)))

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        return penalised(theta, known, correlation, np.ones(len(targets)), residual, noise_init)[:2]

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
