"""How good a posterior is one step ahead on held-out episodes.

Every metric is a function of means of per-point quantities, so that one resampling of blocks serves them all.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammaincinv  # scipy.stats takes seconds to import

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.evaluation.bootstrap import Blocks, bootstrap, interval_rows
from simpel_cli.evaluation.posterior import CHUNK, Posterior
from simpel_cli.inference.predictive import Predictive
from simpel_cli.inference.sensor_ends import share

LEVELS = np.arange(0.05, 0.951, 0.05)
COVERAGE = 0.9


class OneStep(NamedTuple):
    """Per-point quantities of one-step prediction at n test transitions; outputs (dy) then the joint, in data units."""

    nll: np.ndarray  # (n, dy + 1)
    squared: np.ndarray  # (n, dy + 1), joint = sum over outputs
    absolute: np.ndarray  # (n, dy + 1)
    crps: np.ndarray  # (n, dy + 1)
    inside: np.ndarray  # (n, dy + 1), 1 within the central 90 % region; the share that is, of a reading at an end
    below: np.ndarray  # (n, dy + 1, levels), the same of regions of other levels
    mean: np.ndarray  # (n, dy)
    std: np.ndarray  # (n, dy)
    epistemic_std: np.ndarray  # (n, dy)


def one_step(posterior: Posterior, x: np.ndarray, y: np.ndarray, precision: np.ndarray | None = None) -> OneStep:
    """Compare one-step predictions with targets.

    The joint columns: NLL of the joint mixture; squared, absolute error and CRPS summed over outputs; coverage and
    calibration of the Mahalanobis distance against chi-squared with dy degrees of freedom. A value at an end of its sensor has
    the NLL and CRPS of the reading, and is covered by the share of the mass there or beyond that is.

    Args:
        posterior: the fitted posterior.
        x: test inputs, shape (n, dx).
        y: targets, shape (n, dy).
        precision: of every target over that of one between measured values, shape (n, dy): the noise of one that begins at an
            estimated state has its variance, too; None: 1.
    """
    counts = np.ones_like(y) if precision is None else precision
    parts = [_one_chunk(posterior, *(a[i : i + CHUNK] for a in (x, y, counts))) for i in range(0, len(x), CHUNK)]
    return OneStep(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@jax.jit
def _measure(p: Predictive, y: jax.Array, levels: jax.Array) -> tuple[jax.Array, ...]:
    low, high = p.pit(y)
    inner = jnp.abs(low + high - 1)  # share of the mass that lies nearer to the median
    # heavy tails have no chi-squared law: theirs is what a Gaussian of the same share would have
    r = (
        ((y - p.mean) / p.std) ** 2
        if p.tail is None
        else jax.scipy.special.ndtri((1 + jnp.minimum(inner, 1 - 1e-12)) / 2) ** 2
    )
    columns = (
        -p.log_prob_per_output(y), -p.log_prob(y), p.crps(y), low, high, r, p.within(y, levels), p.mean, p.reading(p.mean),
        p.std, p.epistemic_std,
    )  # fmt: skip
    return columns


def _one_chunk(posterior: Posterior, x: np.ndarray, y: np.ndarray, precision: np.ndarray) -> OneStep:
    n, dy = y.shape
    pad = [(0, CHUNK - n), (0, 0)]
    p = posterior.predict(np.pad(x, pad, mode="edge"))
    p = jax.tree.map(lambda a: a.astype(jnp.float64), p)
    if (precision != 1).any():
        p = p.counting(jnp.asarray(np.pad(precision, pad, mode="edge")))
    levels = np.append(LEVELS, COVERAGE)
    measured = _measure(p, jnp.asarray(np.pad(y, pad, mode="edge")), jnp.asarray(levels))
    columns = [np.asarray(a)[:n] for a in measured]
    nll, joint, crps, low, high, r, within, mean, read, std, epistemic = columns
    error = y - read  # of a sensor that saturates: of what it would read of the mean
    below, inside = np.empty((n, dy + 1, len(LEVELS))), np.empty((n, dy + 1))
    below[:, dy], inside[:, dy] = within[:, :-1], within[:, -1]
    for i in range(dy):
        shares = share(low[:, i], high[:, i], ((1 - levels) / 2, (1 + levels) / 2))
        inside[:, i] = shares[:, -1]
        at_end = (high > low)[:, i, None]
        below[:, i] = np.where(at_end, shares[:, :-1], r[:, i, None] <= chi_squared_quantile(LEVELS, 1)[None])
    return OneStep(
        nll=np.column_stack([nll, joint]),
        squared=_with_sum(error**2),
        absolute=_with_sum(np.abs(error)),
        crps=_with_sum(crps),
        inside=inside,
        below=below,
        mean=mean,
        std=std,
        epistemic_std=epistemic,
    )


def chi_squared_quantile(level: np.ndarray | float, degrees: int) -> np.ndarray:
    """Quantile of the chi-squared distribution."""
    return np.asarray(2 * gammaincinv(degrees / 2, level))


def _with_sum(a: np.ndarray) -> np.ndarray:
    return np.column_stack([a, a.sum(axis=1)])


STATISTICS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "nll": ("nll", lambda m: m),
    "rmse": ("squared", np.sqrt),
    "mae": ("absolute", lambda m: m),
    "crps": ("crps", lambda m: m),
    "coverage_90": ("inside", lambda m: m),
    "calibration_error": ("below", lambda m: np.abs(m - LEVELS).mean(axis=-1)),
}
IN_DATA_UNITS = ("rmse", "mae", "crps")
MIXED = "mixed"  # the unit of a sum over outputs of different units


def one_step_table(
    result: OneStep, blocks: Blocks, encoding: Encoding, target_std: np.ndarray
) -> list[dict[str, object]]:
    """Return metric rows (metric, output, unit, value) with their interval ends as `<metric>_low`, `<metric>_high`.

    Joint errors in data units are well-defined only where all outputs share a unit; else theirs is `mixed`, and
    `nrmse`, in units of the simulator's own spread, is the one to read:

        nrmse_i = rmse_i / s_i,     nrmse_joint = sqrt(1/dy sum_i nrmse_i^2)

    Args:
        result: of `one_step`.
        blocks: of the bootstrap.
        encoding: names and units.
        target_std: s, standard deviation of the targets over the simulator's ranges, in data units, shape (dy,).
    """
    names, units = [*encoding.y_names, "joint"], [*encoding.y_units, joint_unit(encoding)]
    rows: list[dict[str, object]] = []
    for metric, (field, statistic) in STATISTICS.items():
        points = getattr(result, field)
        for i, (name, unit) in enumerate(zip(names, units, strict=True)):
            shown = unit if metric in IN_DATA_UNITS else "nat" if metric == "nll" else "1"
            rows += interval_rows(metric, name, shown, bootstrap(points[:, i], blocks, statistic))
    relative = result.squared[:, :-1] / target_std**2
    for i, name in enumerate(names):
        points = relative[:, i] if name != "joint" else relative.mean(axis=1)
        rows += interval_rows("nrmse", name, "1", bootstrap(points, blocks, np.sqrt))
    return rows


def joint_unit(encoding: Encoding) -> str:
    """Return the unit that all outputs share, else `mixed`."""
    units = set(encoding.y_units)
    return units.pop() if len(units) == 1 else MIXED
