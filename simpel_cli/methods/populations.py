"""Groups among the parameters of an identification: their spread is learned, a group never seen is drawn from the population.

A search in unit coordinates holds the spreads. Where it came to rest, each goes on with the spread that this asks for
(`simpel_cli.priors.spreads`), the groups where they are: c, s delta_g and with them everything simulated stay the same. Starts
that ended with different spreads are compared by the Laplace approximation to the evidence, not by the posterior density.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from simpel_cli.priors.spreads import LEAST, factor_of, sd_of_log
from simulators.groups import spreads_of
from simulators.model import Quantity

SETTLED = 0.01  # of a spread: it moves no more
ROUNDING = 8.0  # times the resolution of numbers, of every diagonal entry of an information matrix


class Told(NamedTuple):
    """What the data tell of groups where a search is.

    Args:
        gamma: number of groups that they know, per parameter that differs, (K,).
        paid: half the log determinant of the information of all coordinates but the spreads: loss and it together are minus
            the log evidence.
    """

    gamma: Float[Array, "*S K"]
    paid: Float[Array, "*S"]


class Moved(NamedTuple):
    """Coordinates with other spreads in which the groups are where they were.

    Args:
        u: the coordinates.
        stretch: derivatives by them over the derivatives before.
        loss: what their prior adds to the loss.
        settled: whether the spreads are what they should be.
    """

    u: Float[Array, " dp"]
    stretch: Float[Array, " dp"]
    loss: Float[Array, ""]
    settled: Bool[Array, ""]


class Populations:
    """Every parameter that differs from group to group.

    Args:
        params: of the simulator, with spreads and what the groups are (`simulators.groups`).
    """

    def __init__(self, params: Sequence[Quantity]) -> None:
        found = spreads_of(params)
        self.spreads, self.members = tuple(found), tuple(np.array(rows) for rows in found.values())
        self.others = tuple(rows[-1] + 1 for rows in found.values())  # groups that were never seen
        self.ranges = tuple((float(params[i].low), float(params[i].high)) for i in found)
        self.held = np.isin(np.arange(len(params)), self.spreads)  # (dp,)

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.spreads)

    def told(self, information: Float[Array, "dp dp"], held: Bool[Array, " dp"]) -> Told:
        """Return what data tell.

        Args:
            information: of the unit coordinates under data and prior.
            held: coordinates that do not move, at a bound.
        """
        dtype, n = information.dtype, len(self.held)
        held = held | self.held
        h = jnp.where(held[:, None] | held[None], jnp.eye(n, dtype=dtype), information).astype(jnp.float64)
        h = h + ROUNDING * float(jnp.finfo(dtype).eps) * jnp.diag(jnp.diag(h))
        factor = jnp.linalg.cholesky(h)
        variance = jnp.sum(jax.scipy.linalg.solve_triangular(factor, jnp.eye(n), lower=True) ** 2, axis=0)
        gamma = jnp.stack([jnp.sum(1 - jnp.minimum(variance[rows], 1.0)) for rows in self.members])
        paid = jnp.sum(jnp.log(jnp.diag(factor)))
        gamma = jnp.where(jnp.isfinite(gamma), gamma, 0.0)  # no information that could be inverted: they know none
        return Told(gamma.astype(dtype), jnp.where(jnp.isfinite(paid), paid, jnp.inf).astype(dtype))

    def moved(self, u: Float[Array, " dp"], told: Told, far: float) -> Moved:
        """Return coordinates with the spreads that they ask for.

        Args:
            u: unit coordinates at which a search with the spreads among them came to rest.
            told: by the data there.
            far: standard deviations that a group may be away from the population.
        """
        stretch, settled, loss = jnp.ones_like(u), jnp.ones((), bool), jnp.zeros((), u.dtype)
        new = u
        for k, (spread, rows) in enumerate(zip(self.spreads, self.members, strict=True)):
            squares, most = jnp.sum(u[rows] ** 2), jnp.max(jnp.abs(u[rows]))
            before = self._value(k, u[spread])
            factor = jnp.maximum(factor_of(squares, told.gamma[k], len(rows)), most / far)
            after = self._within(k, before * factor)
            after = jnp.where(jnp.isfinite(after), after, before)
            ratio = after / before
            new = new.at[rows].set(u[rows] / ratio).at[spread].set(self._unit(k, after))
            stretch = stretch.at[rows].set(ratio)
            loss = loss + 0.5 * squares * (ratio**-2 - 1)
            settled = settled & (jnp.abs(jnp.log(ratio)) < SETTLED)
        return Moved(new, stretch, loss, settled)

    def drawn(
        self, u: Float[Array, "L dp"], gamma: Float[Array, " K"], white: Float[Array, "L dp"]
    ) -> Float[Array, "L dp"]:
        """Return draws in which spreads are drawn, too, and groups that were never seen from the population with them.

        Args:
            u: draws with the learned spreads; their groups stay where they are.
            gamma: number of groups that the data know, (K,): log s has the standard deviation 1/sqrt(2 gamma).
            white: standard normal numbers.
        """
        for k, (spread, rows, other) in enumerate(zip(self.spreads, self.members, self.others, strict=True)):
            before = self._value(k, u[:, spread])
            after = self._within(k, before * jnp.exp(sd_of_log(gamma[k]) * white[:, spread]))
            known = u[:, rows] * (before / after)[:, None]
            u = u.at[:, rows].set(known).at[:, spread].set(self._unit(k, after)).at[:, other].set(white[:, other])
        return u

    def _value(self, k: int, u: Float[Array, "*L"]) -> Float[Array, "*L"]:
        low, high = self.ranges[k]
        return low + (high - low) * jnp.maximum(u, LEAST)

    def _unit(self, k: int, value: Float[Array, "*L"]) -> Float[Array, "*L"]:
        low, high = self.ranges[k]
        return (value - low) / (high - low)

    def _within(self, k: int, value: Float[Array, "*L"]) -> Float[Array, "*L"]:
        low, high = self.ranges[k]
        return jnp.clip(value, low + LEAST * (high - low), high)
