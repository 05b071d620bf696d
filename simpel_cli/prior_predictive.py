"""Prior-predictive check: whether this simulator, with these ranges, can explain the training targets at all.

Of every target, whether the measured value lies among draws of the simulator at its own input; and jointly

    d^2 = (y - mean)' (cov(g) + kappa^2 rho + (w + sigma^2) I)^-1 (y - mean)

for the measured targets and for data drawn from the prior itself: a simulator can hold every target in its range and still
not all of them with one set of parameters. The draws of the prior say how large d^2 may be, so nothing needs to be normal.

Reference: Box (1980), Sampling and Bayes' inference in scientific modelling and robustness; Gelman, Meng and Stern (1996),
Posterior predictive assessment of model fitness.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from simpel_cli.inference import Bank, Normaliser, Setting
from simpel_cli.problem import System

DRAWS = 2048  # half of them for the moments, half to compare with
MOST_ROWS = 128
WIDER = 3.0  # standard deviations of the noise by which the range of the draws is widened
SURPRISING = 5e-3  # share of the prior's own data as far off, below which it is said not to explain those measured
BAND = (0.05, 0.95)
JITTER = 1e-9  # of a covariance


class OutputCheck(NamedTuple):
    """What the prior says of one target.

    Args:
        name, unit: of the target.
        outside: rows that lie outside every draw of the simulator, widened by the noise.
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
        return (self.p if self.p_with_gap is None else self.p_with_gap) >= SURPRISING

    @property
    def by_simulator(self) -> bool:
        """Whether the simulator alone is."""
        return self.p >= SURPRISING and not self.outside


class PriorCheck(NamedTuple):
    """Checks of all targets, and the table of `prior_predictive.parquet`."""

    outputs: tuple[OutputCheck, ...]
    table: dict[str, list[float] | list[str]]


def check_prior(
    system: System,
    setting: Setting,
    normaliser: Normaliser,
    x: np.ndarray,
    y: np.ndarray,
    noise: np.ndarray,
    gap_scale: np.ndarray | None,
    key: PRNGKeyArray,
    bank: Bank | None = None,
) -> PriorCheck:
    """Compare the training targets with draws of the prior.

    Args:
        system: simulator and coordinates.
        setting: with the bound prior.
        normaliser: of the system.
        x: (m, dx) training inputs, data units.
        y: (m, dy) targets, data units.
        noise: (dy,) standard deviation of the targets' noise, normalised.
        gap_scale: (dy,) kappa, normalised; None: no gap.
        key: of the draws.
        bank: draws at the training inputs, where the simulator can only be queried.
    """
    rows = np.unique(np.linspace(0, len(x) - 1, min(len(x), MOST_ROWS)).round().astype(int))
    x, y = x[rows], y[rows]
    y_mean, y_std = np.asarray(normaliser.y_mean, float), np.asarray(normaliser.y_std, float)
    if bank is None:
        drawn = system.simulate(key, x, DRAWS)
    else:
        drawn = np.moveaxis(np.asarray(bank.samples, float)[rows], -1, 0)
    samples = (drawn - y_mean) / y_std  # (N, m, dy)
    targets = (y - y_mean) / y_std
    at = jnp.asarray((x - normaliser.x_mean) / normaliser.x_std)
    scale = np.zeros(y.shape[1]) if gap_scale is None else gap_scale
    known = np.asarray(setting.prior.covariance(at, jnp.asarray(scale)), float)  # with the white model error
    checks, table = [], dict[str, list]()
    for i, (name, unit) in enumerate(zip(system.encoding.y_names, system.encoding.y_units, strict=True)):
        own, measured = samples[:, :, i], targets[:, i]
        low, high = own.min(axis=0) - WIDER * noise[i], own.max(axis=0) + WIDER * noise[i]
        white = np.diag(np.full(len(x), known[i, 0, 0] - scale[i] ** 2 + noise[i] ** 2))
        distance, p = _surprise(own, measured, white)
        with_gap = (
            (None, None) if gap_scale is None else _surprise(own, measured, known[i] + noise[i] ** 2 * np.eye(len(x)))
        )
        outside = (measured < low) | (measured > high)
        checks.append(OutputCheck(name, unit, int(outside.sum()), len(x), distance, p, *with_gap))
        quantiles = np.quantile(own, [0, BAND[0], 0.5, BAND[1], 1], axis=0)
        for column, values in {
            "row": rows,
            "output": [name] * len(x),
            "unit": [unit] * len(x),
            "measured": y[:, i],
            **{
                column: q * y_std[i] + y_mean[i]
                for column, q in zip(("lowest", "low", "median", "high", "highest"), quantiles, strict=True)
            },
            "outside": outside,
        }.items():
            table.setdefault(column, []).extend(np.asarray(values).tolist())
    return PriorCheck(tuple(checks), table)


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
