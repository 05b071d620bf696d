"""Coordinates in which a model is integrated, and what an integrator needs of it."""

import math
from collections.abc import Callable
from typing import NamedTuple

import casadi

from simulators.expression import Symbol

UNLIMITED = (-math.inf, math.inf)


class Coordinates(NamedTuple):
    """Coordinates z in which a transition is integrated, where these are not the states themselves.

    Args:
        size: rows of z.
        enter: (x, p) -> z.
        rhs: (z, u, p) -> dz/dt.
        leave: (z, p) -> x.
        limits: lowest and highest value of every row of z, or those of each row, to which it is clipped after each
            Runge-Kutta step.

    """

    size: int
    enter: Callable[[Symbol, Symbol], Symbol]
    rhs: Callable[[Symbol, Symbol, Symbol], Symbol]
    leave: Callable[[Symbol, Symbol], Symbol]
    limits: tuple[float, float] | tuple[tuple[float, ...], tuple[float, ...]] = UNLIMITED

    @property
    def ends(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lowest and highest values, row by row."""
        low, high = (end if isinstance(end, tuple) else (end,) * self.size for end in self.limits)
        return low, high


class Flow(NamedTuple):
    """What an integrator of a model needs.

    Args:
        enter: CasADi function (x, p) -> z; None: z = x.
        rhs: CasADi function (z, u, p) -> dz/dt.
        leave: CasADi function (z, p) -> x; None: x = z.
        low, high: per row of z, to which it is clipped after each Runge-Kutta step; infinite where nothing limits it.

    """

    enter: casadi.Function | None
    rhs: casadi.Function
    leave: casadi.Function | None
    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def limited(self) -> bool:
        """Whether anything is clipped."""
        return any(math.isfinite(end) for end in (*self.low, *self.high))
