"""Scales of the gap GP and of the noise, chosen by the marginal likelihood of the training transitions (empirical Bayes).

    y ~ N(mean(g), cov(g) + kappa^2 rho(X, X) + (w + sigma^2) I),   maximise over kappa and sigma

The function is integrated out, so that the noise is not what a network leaves that goes through every one of a few points.

Reference: MacKay (1992), Bayesian interpolation; Rasmussen and Williams (2006), section 5.4.1.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize


class Scales(NamedTuple):
    """Standard deviations of the gap and of the noise of one output, normalised."""

    gap: float
    noise: float


def marginal_likelihood_scales(
    samples: np.ndarray,
    correlation: np.ndarray,
    targets: np.ndarray,
    noise_init: float,
    white_variance: float,
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
        white_variance: white model error of the prior.
        gap: kappa, where it is known; None: it is chosen, too.
    """
    residual = targets - samples.mean(axis=0)
    covariance = np.atleast_2d(np.cov(samples, rowvar=False))
    identity = np.eye(len(targets))

    def objective(theta: np.ndarray) -> float:
        log_kappa, log_sigma = theta
        kappa = np.exp(log_kappa) if gap is None else gap
        total = covariance + kappa**2 * correlation + (white_variance + np.exp(2 * log_sigma)) * identity
        factor = cho_factor(total, lower=True)
        fit = residual @ cho_solve(factor, residual) / 2 + np.log(np.diag(factor[0])).sum()
        return fit + (log_kappa - np.log(0.1)) ** 2 / 8 + (log_sigma - np.log(noise_init)) ** 2 / 2

    starts = [np.log([kappa, noise_init]) for kappa in (0.03, 0.3)]
    bounds = [(np.log(1e-3), np.log(10.0)), (np.log(1e-3), np.log(10.0))]
    best = min((minimize(objective, s, bounds=bounds, method="L-BFGS-B") for s in starts), key=lambda r: r.fun)
    kappa, sigma = (float(v) for v in np.exp(best.x))
    return Scales(kappa if gap is None else gap, sigma)
