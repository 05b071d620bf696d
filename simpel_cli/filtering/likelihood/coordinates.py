"""The unknowns of a fit, each mapped onto the unit interval between its bounds.

theta = (parameters p of model and effects, log r, log q). In these coordinates a uniform prior has density 1, bounds are 0
and 1, and every unknown has the same scale, so that damping and floors need no units.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.track import Noise

CUT = 4.0  # standard deviations at which a normal prior is bounded


class Coordinates(NamedTuple):
    """Bounds and priors of all unknowns; one more entry at the end is a place for padding.

    Args:
        low, high: (n,) bounds, of the logarithm where `log`.
        log: (n,) whether the logarithm is what is uniform or normal.
        normal: (n,) whether the prior is normal about the middle, with +-2 sd inside the declared range.
        sizes: numbers of (p, r, q) entries.
        driven: rows of the state that process noise acts on.
        nx: number of states.
    """

    low: np.ndarray
    high: np.ndarray
    log: np.ndarray
    normal: np.ndarray
    sizes: tuple[int, int, int]
    driven: tuple[int, ...]
    nx: int

    @property
    def layout(self) -> tuple[tuple[int, int, int], tuple[int, ...], int]:
        """What programs are compiled for; the bounds are arguments."""
        return self.sizes, self.driven, self.nx

    @staticmethod
    def of(bounds: tuple[Any, ...], layout: tuple[Any, ...]) -> "Coordinates":
        """Put together what `bounds` and `layout` took apart."""
        return Coordinates(*bounds, *layout)

    @property
    def bounds(self) -> tuple[np.ndarray, ...]:
        """What depends on the measurements: an argument of compiled programs, so that other data share them."""
        return self.low, self.high, self.log, self.normal

    def physical(self, z: Float[Array, " n"]) -> tuple[Array, Noise]:
        """Return p and the noise at unit coordinates z."""
        value = self.low + z * (self.high - self.low)
        value = jnp.where(self.log, jnp.exp(jnp.where(self.log, value, 0.0)), value)
        n_p, n_r, n_q = self.sizes
        q = jnp.zeros(self.nx, value.dtype).at[jnp.array(self.driven, int)].set(value[n_p + n_r : n_p + n_r + n_q])
        return value[:n_p], Noise(value[n_p : n_p + n_r], q)

    def unit(self, index: Any, value: Any) -> Any:
        """Return the unit coordinate of a physical value, kept inside the bounds."""
        value = np.asarray(value, float)
        v = np.where(self.log[index], np.log(np.maximum(value, 1e-300)), value)
        span = self.high[index] - self.low[index]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(span > 0, np.clip((v - self.low[index]) / span, 0.0, 1.0), 0.5)

    def value(self, index: int, z: float) -> float:
        """Return the physical value of one unit coordinate."""
        v = self.low[index] + z * (self.high[index] - self.low[index])
        return float(np.exp(v)) if self.log[index] else float(v)

    def span(self, index: int, z: float) -> float:
        """Return by how much a value may move, in its unit: its range, or itself where the logarithm has one."""
        return self.value(index, z) if self.log[index] else float(self.high[index] - self.low[index])

    def sd_of_prior(self) -> Float[Array, " n"]:
        """Standard deviation of the normal priors in unit coordinates, inf where uniform."""
        return jnp.where(jnp.asarray(self.normal), 1 / (2 * CUT), jnp.inf)


DECLARED_SD = 0.1  # of the logarithm of a measurement noise that the user declared
ESTIMATED_SPAN = (1 / 30, 3.0)  # factors within which a noise that was estimated from differences may lie
LOG_UNIFORM = "loguniform"  # prior of an effect's parameter: a time constant may be of any magnitude
MODEL_ERROR = 0.01  # of a channel's magnitude, which its noise may reach however clean its differences are


def coordinates_of(
    augmented: Augmented,
    r: np.ndarray,
    declared: np.ndarray,
    size: np.ndarray,
    q_low: np.ndarray,
    q_high: np.ndarray,
    least: np.ndarray | None = None,
) -> Coordinates:
    """Return the coordinates of all unknowns.

    Args:
        augmented: model with candidates.
        r: (ny,) measurement noise. Third differences take what the model does for noise where the data are clean, so an
            estimate may be far too large. It is too small where a filter or a slow sensor error made the record smooth.
        declared: (ny,) whether the user declared it.
        size: (ny,) magnitude of the channel.
        q_low: (n_driven,) lower bounds of the process noise.
        q_high: (n_driven,) upper bounds.
        least: (ny,) error of rounding, which a noise that was estimated cannot be below; None: unknown.
    """
    least = np.zeros(len(r)) if least is None else least
    rows: list[tuple[float, float, bool, bool]] = []  # low, high, log, normal
    base = len(augmented.model.params)
    for i, q in enumerate(augmented.params):
        prior = q.prior if i < base or q.prior == "normal" else "uniform"
        low, high = (np.log(q.low), np.log(q.high)) if prior == "lognormal" else (q.low, q.high)
        if i >= base and q.prior == LOG_UNIFORM:
            rows.append((np.log(q.low), np.log(q.high), True, False))
        elif prior == "uniform":
            rows.append((low, high, False, False))
        else:
            middle, sd = (low + high) / 2, (high - low) / 4
            rows.append((middle - CUT * sd, middle + CUT * sd, prior == "lognormal", True))
    for value, known, most, rounded in zip(r, declared, MODEL_ERROR * size, least, strict=True):
        low, high = value * (np.exp(np.array([-CUT, CUT]) * DECLARED_SD) if known else np.array(ESTIMATED_SPAN))
        low, high = (low, high) if known else (max(low, rounded), max(high, most, 2 * rounded))
        rows.append((np.log(low), np.log(high), True, bool(known)))
    rows += [(np.log(low), np.log(high), True, False) for low, high in zip(q_low, q_high, strict=True)]
    rows.append((0.0, 1.0, False, False))  # padding
    driven = augmented.driven
    low, high, log, normal = (np.array(column) for column in zip(*rows, strict=True))
    return Coordinates(
        low, high, log, normal, (len(augmented.params), len(r), len(driven)), driven, len(augmented.model.states)
    )
