"""Lengthscales of the gap, one per input and output, by the marginal likelihood of the training transitions.

    y ~ N(mean(g), cov(g) + kappa^2 rho(q) + w I + sigma^2 I),    q_jk = sum_d r_d^2 (x_jd - x_kd)^2

with inputs x normalised and relevances r_d = 1/l_d. How fast what the simulator lacks varies with a speed or a command
differs from plant to plant by a factor of ten, and one length for all inputs makes it vary as fast with those that play no
part. Their logarithms have the prior N(log r0, 1 + 2^2 1 1'): all of them may well be longer or shorter, one of them a little.
Where they gain little they stay as they are declared: a gap that is white noise explains noise as well as the noise does.

Reference: Rasmussen and Williams (2006), eqs. 5.1, 5.8 and 5.9 (automatic relevance determination; gradient).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from simpel_cli.priors.gap_scale import BOUNDS, penalised
from simpel_cli.priors.gaussian_process import Kernel

MOST_ROWS = 192  # that are looked at: time grows as their third power
TOGETHER, APART = 2.0, 1.0  # standard deviations of a logarithm: of all of them, and of each
FURTHEST = 4.0  # from where it is declared: a factor of 55
STARTS = (0.0, 0.1), (0.7, 0.5), (1.4, 0.03)  # logarithm of the relevances over the declared ones, and kappa
ROUNDS = 60  # of L-BFGS, from each
LEAST_GAIN = 3.0, 0.25  # nats that they have to be ahead of the declared ones by: in any case, and per input


def most_likely(
    kernel: Kernel,
    x: np.ndarray,
    samples: np.ndarray,
    targets: np.ndarray,
    white: np.ndarray,
    declared: np.ndarray,
    noise_init: float,
    gap: float | None = None,
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """Return the relevances r of one output, (dx,).

    Args:
        kernel: of the gap.
        x: normalised inputs, (m, dx).
        samples: draws of the simulator there, (N, m).
        targets: (m,).
        white: variance of the white model error, (m,).
        declared: r0, (dx,).
        noise_init: typical noise, which log sigma has a standard deviation of 1 about.
        gap: kappa, where it is known.
        weights: how much each row counts, its noise has the variance sigma^2/weight, (m,); None: all alike.
    """
    rows = np.unique(np.linspace(0, len(x) - 1, min(len(x), MOST_ROWS)).round().astype(int))
    x, samples, targets, white = x[rows], samples[:, rows], targets[rows], white[rows]
    variance = np.ones(len(rows)) if weights is None else 1 / weights[rows]
    residual, covariance = targets - samples.mean(axis=0), np.atleast_2d(np.cov(samples, rowvar=False))
    known, size = covariance + np.diag(white), x.shape[1]
    spread = np.linalg.inv(APART**2 * np.eye(size) + TOGETHER**2 * np.ones((size, size)))

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        scaled = x * declared * np.exp(theta[2:])
        correlation, slope = (np.asarray(a) for a in _correlation(kernel, scaled))
        loss = penalised(theta[:2], known, correlation, variance, residual, noise_init)
        # d rho(q_jk)/d log r_d = 2 rho'(q_jk) r_d^2 (x_jd - x_kd)^2, and both halves of the sum are alike
        weight = loss.against * slope
        along = 2 * (weight.sum(axis=1) @ scaled**2 - np.sum(scaled * (weight @ scaled), axis=0))
        away = spread @ theta[2:]
        return loss.value + theta[2:] @ away / 2, np.concatenate([loss.slope, along + away])

    def best_within(furthest: float) -> tuple[float, np.ndarray]:
        """The least loss, and where, with logarithms no further than that from the declared ones."""
        fixed = BOUNDS if gap is None else (np.log(gap), np.log(gap))
        bounds = [fixed, BOUNDS, *[(-furthest, furthest)] * size]
        found = []
        for shorter, kappa in STARTS:
            scales = np.log([kappa if gap is None else gap, noise_init])
            start = np.concatenate([scales, np.full(size, min(shorter, furthest))])
            found.append(
                minimize(objective, start, bounds=bounds, method="L-BFGS-B", jac=True, options={"maxiter": ROUNDS})
            )
        least = min(found, key=lambda r: float(r.fun))
        return float(least.fun), least.x

    before, _ = best_within(0.0)
    after, best = best_within(FURTHEST)
    return declared * np.exp(best[2:]) if before - after > LEAST_GAIN[0] + LEAST_GAIN[1] * size else declared


@partial(jax.jit, static_argnums=0)
def _correlation(kernel: Kernel, x: Float[Array, "m dx"]) -> tuple[Float[Array, "m m"], Float[Array, "m m"]]:
    """Return the correlation, and its derivative by the squared distance."""
    size = jnp.sum(x**2, axis=1)
    apart = jnp.maximum(size[:, None] + size[None] - 2 * x @ x.T, 0.0)
    apart = jnp.where(jnp.eye(len(x), dtype=bool), 0.0, apart)
    return kernel.correlation(apart), jax.grad(lambda q: jnp.sum(kernel.correlation(q)))(apart)
