"""Closed forms in plain numpy and scipy, which the package is held to; nothing here imports it."""

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm


def squared_exponential(a: np.ndarray, b: np.ndarray, lengthscale: float) -> np.ndarray:
    """Correlation of scalar inputs, Rasmussen and Williams (2006), eq. 4.9."""
    return np.exp(-0.5 * (a[:, None] - b[None]) ** 2 / lengthscale**2)


def gp_posterior(
    prior_train: np.ndarray, cross: np.ndarray, prior_test: np.ndarray, y: np.ndarray, noise_std: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance by conditioning the joint Gaussian, Rasmussen and Williams (2006), eqs. 2.23-2.24."""
    observed = prior_train + noise_std**2 * np.eye(len(y))
    return cross @ np.linalg.solve(observed, y), prior_test - cross @ np.linalg.solve(observed, cross.T)


def gaussian_score(h: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Gradient of the log density of N(mean, covariance) at the rows of h."""
    return -np.linalg.solve(covariance, (h - mean).T).T


def mixture_log_density(y: float, centres: np.ndarray, std: float) -> float:
    """Log density of an equal-weight mixture of Gaussians at y."""
    return float(np.log(np.mean(norm.pdf(y, centres, std))))


def mixture_crps(y: float, centres: np.ndarray, std: float) -> float:
    """CRPS by its definition, the integral of (F(z) - 1[z >= y])^2; Gneiting and Raftery (2007), eq. 20."""
    low, high = min(y, centres.min()) - 10 * std, max(y, centres.max()) + 10 * std

    def below(z: float) -> float:
        return float(np.mean(norm.cdf(z, centres, std))) ** 2

    def above(z: float) -> float:
        return float(np.mean(norm.sf(z, centres, std))) ** 2

    knots = sorted(centres)
    left = quad(below, low, y, points=[k for k in knots if low < k < y] or None, limit=200)[0]
    right = quad(above, y, high, points=[k for k in knots if y < k < high] or None, limit=200)[0]
    return float(left + right)


def ledoit_wolf_weight(samples: np.ndarray) -> float:
    """Shrinkage weight b^2 / d^2 of Ledoit and Wolf (2004), lemma 3.3-3.4, one outer product at a time.

    Their norm is |A|^2 = tr(A A') / M, which cancels in the ratio; S here is with 1/(N-1).
    """
    n, m = samples.shape
    centred = samples - samples.mean(axis=0)
    s = np.cov(samples, rowvar=False)
    d2 = np.linalg.norm(s - np.trace(s) / m * np.eye(m)) ** 2
    b2 = sum(np.linalg.norm(np.outer(row, row) - s) ** 2 for row in centred) / n**2
    return float(min(b2, d2) / d2)


def mixture_score(h: np.ndarray, centres: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Gradient of the log density of an equal-weight mixture of Gaussians with one covariance at the rows of h."""
    apart = h[:, None] - centres[None]
    pulls = -np.linalg.solve(covariance, apart.reshape(-1, h.shape[1]).T).T.reshape(apart.shape)
    log_density = 0.5 * np.sum(pulls * apart, axis=-1)
    weight = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    weight = weight / weight.sum(axis=1, keepdims=True)
    return np.asarray(np.sum(weight[..., None] * pulls, axis=1))


def lognormal_score(h: np.ndarray, root: np.ndarray, sigma: float) -> np.ndarray:
    """Gradient of the log density of root v at the rows of h, log v_i ~ N(0, sigma^2) independent."""
    v = np.linalg.solve(root, h.T).T
    return np.linalg.solve(root.T, (-(np.log(v) / sigma**2 + 1) / v).T).T
