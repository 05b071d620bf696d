"""Prior-predictive check: whether this simulator, with these ranges, can explain the training targets at all.

Of every target, whether the measured value lies among draws of the simulator at its own input; and jointly

    d^2 = (y - mean)' (cov(g) + kappa^2 rho + (w + sigma^2) I)^-1 (y - mean)

for the measured targets and for data drawn from the prior itself: a simulator can hold every target in its range and still
not all of them with one set of parameters. The draws of the prior say how large d^2 may be, so nothing needs to be normal.

Reference: Box (1980), Sampling and Bayes' inference in scientific modelling and robustness; Gelman, Meng and Stern (1996),
Posterior predictive assessment of model fitness.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.special import ndtri

from simpel_cli.inference.protocols import Bank, Normaliser, Setting
from simpel_cli.inference.system import System

DRAWS = 2048  # half of them for the moments, half to compare with
MOST_ROWS = 128
NOISE_DRAWS = 64  # of which the mean response to an error of a state is taken
SURPRISING = 5e-3  # share of the prior's own data as far off, below which it is said not to explain those measured
BAND = (0.05, 0.95)
JITTER = 1e-9  # of a covariance


class OutputCheck(NamedTuple):
    """What the prior says of one target.

    Args:
        name, unit: of the target.
        outside: rows that lie outside every draw of the simulator by more than noise can.
        rows: that were looked at.
        distance: d of the simulator alone, over the median of its own draws; about 1 where it explains the data.
        p: share of its own draws that are as far off.
        distance_with_gap, p_with_gap: the same with the gap; None: there is none.
    """

    name: str
    unit: str
    outside: int
    rows: int
    distance: float
    p: float
    distance_with_gap: float | None
    p_with_gap: float | None

    @property
    def explained(self) -> bool:
        """Whether the prior as a whole is compatible with the data."""
        return self.by_simulator if self.p_with_gap is None else self.p_with_gap >= SURPRISING

    @property
    def by_simulator(self) -> bool:
        """Whether the simulator alone is."""
        return self.p >= SURPRISING and not self.outside


class PriorCheck(NamedTuple):
    """Checks of all targets, and the table of `prior_predictive.parquet`.

    Args:
        outputs: check of every target.
        table: of the draws and the measured targets.
        lost: of how many draws the integration ran away.
        draws: that were made.
    """

    outputs: tuple[OutputCheck, ...]
    table: dict[str, list[float] | list[str]]
    lost: int = 0
    draws: int = 0


def check_prior(
    system: System,
    setting: Setting,
    normaliser: Normaliser,
    x: np.ndarray,
    y: np.ndarray,
    noise_std: Mapping[str, float],
    gap_scale: np.ndarray | None,
    key: PRNGKeyArray,
    bank: Bank | None = None,
    relative: np.ndarray | None = None,
    gap_relevance: np.ndarray | None = None,
) -> PriorCheck | None:
    """Compare the training targets with draws of the prior; None: there are too few draws to tell.

    A gap whose scale was chosen on the same targets explains them more often than a prior would.

    Args:
        system: simulator and coordinates.
        setting: with the bound prior.
        normaliser: of the system.
        x: (m, dx) training inputs, data units.
        y: (m, dy) targets, data units.
        noise_std: of the measurements, per state and output, in its unit.
        gap_scale: (dy,) kappa, normalised; None: no gap.
        key: of the draws.
        bank: draws at the training inputs, where the simulator can only be queried.
        relative: (m, dy) noise of every target over the typical one; None: 1.
        gap_relevance: (dy, dx) one over the gap's lengthscales; None: those of the prior.
    """
    rows = np.unique(np.linspace(0, len(x) - 1, min(len(x), MOST_ROWS)).round().astype(int))
    x, y = x[rows], y[rows]
    y_mean, y_std = np.asarray(normaliser.y_mean, float), np.asarray(normaliser.y_std, float)
    drawn, lost = (
        system.simulate_and_count(key, x, DRAWS)
        if bank is None
        else (np.moveaxis(np.asarray(bank.samples)[rows], -1, 0), 0)
    )
    if 1 / (1 + len(drawn) // 2) > SURPRISING:
        return None
    samples, targets = (drawn - y_mean) / y_std, (y - y_mean) / y_std  # (N, m, dy), (m, dy)
    noise = measurement_noise(system, x, noise_std, key, None if relative is None else relative[rows]) / y_std
    at = jnp.asarray((x - normaliser.x_mean) / normaliser.x_std, jnp.float64)
    scale = np.zeros(y.shape[1]) if gap_scale is None else np.asarray(gap_scale, float)
    # with the white model error
    known = np.asarray(setting.prior.covariance(at, jnp.asarray(scale), gap_relevance), float)
    white = known[:, 0, 0] - scale**2
    # one row among all of them lies further out with probability SURPRISING
    wider = ndtri(1 - SURPRISING / (2 * targets.size))
    checks, table = [], dict[str, list]()
    for i, (name, unit) in enumerate(zip(system.encoding.y_names, system.encoding.y_units, strict=True)):
        own, measured, variance = samples[:, :, i], targets[:, i], noise[:, i] ** 2
        margin = wider * np.sqrt(variance + white[i])
        outside = (measured < own.min(axis=0) - margin) | (measured > own.max(axis=0) + margin)
        distance, p = _surprise(own, measured, np.diag(variance + white[i]))
        with_gap = (None, None) if gap_scale is None else _surprise(own, measured, known[i] + np.diag(variance))
        checks.append(OutputCheck(name, unit, int(outside.sum()), len(x), distance, p, *with_gap))
        quantiles = np.quantile(own, [0, BAND[0], 0.5, BAND[1], 1], axis=0) * y_std[i] + y_mean[i]
        for column, values in {
            "row": rows,
            "output": [name] * len(x),
            "unit": [unit] * len(x),
            "measured": y[:, i],
            **dict(zip(("lowest", "low", "median", "high", "highest"), quantiles, strict=True)),
            "noise_std": noise[:, i] * y_std[i],
            "outside": outside,
        }.items():
            table.setdefault(column, []).extend(np.asarray(values).tolist())
    return PriorCheck(tuple(checks), table, lost, len(drawn))


def measurement_noise(
    system: System, x: np.ndarray, noise_std: Mapping[str, float], key: PRNGKeyArray, relative: np.ndarray | None = None
) -> np.ndarray:
    """Return the standard deviation of measured targets about those of a right simulator at the measured inputs, (m, dy).

    The simulator starts from a measured state, so that state's noise counts, too, by what the simulator makes of it:
    sigma_i^2 + sum_s (d next_i / d s)^2 sigma_s^2. Where it can only be queried, d next / d s is taken for 1.
    `relative` (m, dy) is what the noise of a target is of the typical one; None: 1.
    """
    encoding = system.encoding
    uneven = np.ones((len(x), encoding.dim_y)) if relative is None else relative
    own = encoding.per_target(noise_std, 0.0) * uneven
    changes = np.arange(encoding.dim_y) < encoding.dim_state
    noisy = [(j, noise_std[q.name]) for j, q in enumerate(encoding.states) if noise_std.get(q.name)]
    if not noisy:
        return own
    if system.transition is None:
        return np.where(changes, 2**0.5, 1.0) * own
    states, inputs = encoding.split_x(x)
    moved = np.tile(states, (len(noisy), 1, 1))
    for k, (j, sigma) in enumerate(noisy):
        moved[k, :, j] += sigma * uneven[:, list(encoding.quantity_of_target).index(j)]
    every = np.stack([x, *(encoding.to_x(each, inputs) for each in moved)])
    # all in one call: the same draws of the parameters, and one program
    means = system.simulate(key, every.reshape(-1, encoding.dim_x), NOISE_DRAWS).mean(axis=0)
    response = (means.reshape(len(every), len(x), -1) - means[: len(x)])[1:]
    response[:, :, changes] += (every[1:] - x)[:, :, : encoding.dim_state]  # of the next state, not of the change
    variance = own**2 + np.sum(response**2, axis=0)
    return np.sqrt(variance)


def _surprise(drawn: np.ndarray, measured: np.ndarray, rest: np.ndarray) -> tuple[float, float]:
    """Return d over its median under the prior, and the share of the prior's own data that are as far off.

    Args:
        drawn: (N, m) draws of the simulator.
        measured: (m,).
        rest: (m, m) covariance of what is normal and independent of them.
    """
    half = len(drawn) // 2
    first, second = drawn[:half], drawn[half:]
    mean = first.mean(axis=0)
    total = np.atleast_2d(np.cov(first, rowvar=False)) + rest
    jitter = JITTER * np.trace(total) / len(total) * np.eye(len(total))
    factor = np.linalg.cholesky(total + jitter)
    normal = np.random.default_rng(0).normal(size=second.shape) @ np.linalg.cholesky(rest + jitter).T
    white = np.linalg.solve(factor, np.concatenate([measured[None], second + normal]).T - mean[:, None])
    d2 = np.sum(white**2, axis=0)
    own = d2[1:]
    return float(np.sqrt(d2[0] / np.median(own))), float((1 + np.sum(own >= d2[0])) / (1 + len(own)))
