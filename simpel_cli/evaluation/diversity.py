"""How many different functions a posterior holds: L particles that move in step are one.

    N = exp(-sum_k lambda_k log lambda_k),    lambda: eigenvalues of K/L,    K_ij = exp(-|h_i - h_j|^2 / (2 n dy sigma^2))

with function values at n test inputs, each output in units of the learned noise: what lies far closer than that is the same
function to the data. N is 1 where all particles agree and L where all are apart; two that are one noise apart count 1.6.

Reference: Friedman and Dieng (2023), The Vendi score: a diversity evaluation metric for machine learning, eq. 2.
"""

import numpy as np

from simpel_cli.evaluation.posterior import CHUNK, Posterior


def distinct_particles(posterior: Posterior, x: np.ndarray) -> float:
    """Return the effective number of distinct particles at inputs x (n, dx), of which CHUNK at most are looked at."""
    rows = np.linspace(0, len(x) - 1, CHUNK).round().astype(int)  # of one size: one compiled program
    found = posterior.predict(x[rows])
    particles, scale = (np.asarray(a, float) for a in (found.particles, found.noise_std))
    return effective_number(particles / scale)


def effective_number(h: np.ndarray) -> float:
    """Return the effective number of distinct members of h, (L, n, dy) in units of the noise; NaN: one is not finite."""
    flat = h.reshape(len(h), -1) - h.reshape(len(h), -1).mean(axis=0)
    if not np.isfinite(flat).all():
        return float("nan")
    norm = np.sum(flat**2, axis=1)
    squared = np.maximum(norm[:, None] + norm[None] - 2 * flat @ flat.T, 0.0) / flat.shape[1]
    values = np.linalg.eigvalsh(np.exp(-squared / 2) / len(h))
    values = values[values > 0]
    return float(np.exp(-np.sum(values * np.log(values))))
