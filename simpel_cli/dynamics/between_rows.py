"""What an input does between rows, as the share of every row in it: a sum of one kernel about each row.

A held input is a sum of boxes that begin at their rows, a linear one of hats, and a smooth one of a kernel that puts a cubic
into each row, with the slopes there of polynomials through five rows. What an input is over a substep, its mean and its first
moment, are differences of the kernel's integrals, exact and continuous in a delay.

What a smooth input was before a record that begins with it is the parabola of its first rows, not the first value.

Reference: Keys (1981), Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29 (kernels of piecewise
cubics, of which this one has slopes of fourth order in the distance of rows; the parabola beyond both ends).
"""

from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from simulators.quantity import HELD, LINEAR, SMOOTH

Rows = TypeVar("Rows", Array, np.ndarray)
WAY = {HELD: 0.0, LINEAR: 0.5, SMOOTH: 1.0}  # from held over linear to smooth, where it is asked


class Kernel(NamedTuple):
    """A function of the time since a row, in rows: polynomials in pieces of one row.

    Args:
        first: where the first piece begins.
        pieces: coefficients of every piece, from the constant one on, in the time since the piece began.
    """

    first: int
    pieces: tuple[tuple[float, ...], ...]

    def integrals(self, t: Array) -> tuple[Array, Array]:
        """Return the integral of the kernel up to t, and that of the integral."""
        area, twice, whole = jnp.zeros_like(t), jnp.zeros_like(t), 0.0
        for k, piece in enumerate(self.pieces):
            s = ramp(t - (self.first + k))
            once = [c / (i + 1) for i, c in enumerate(piece)]
            area = area + _polynomial((0.0, *once), s)
            twice = twice + whole * s + _polynomial((0.0, 0.0, *(c / (i + 2) for i, c in enumerate(once))), s)
            whole += sum(once)
        return area, twice + whole * jnp.maximum(t - (self.first + len(self.pieces)), 0.0)

    def values(self, t: Array) -> Array:
        """Return the kernel at t."""
        found = jnp.zeros_like(t)
        for k, piece in enumerate(self.pieces):
            s = t - (self.first + k)
            found = found + jnp.where((s >= 0) & (s < 1), _polynomial(piece, s), 0.0)
        return found

    def shares(self, passed: Float[Array, "ends near"]) -> tuple[Array, Array]:
        """Return mean and rise, over every substep, of the kernel about every row; the rise keeps the first moment.

        Args:
            passed: rows that lie between the row and the end of every substep, and the beginning of the first.
        """
        h = 1 / (passed.shape[0] - 1)
        if self.pieces == (
            (1.0,),
        ):  # a box fills the end of a substep, or its beginning; exact where it fills all or nothing
            share = jnp.diff(ramp(passed), axis=0) / h
            return share, 6 * share * (1 - share) * jnp.where(passed[:-1] <= self.first, 1.0, -1.0)
        area, twice = self.integrals(passed)
        moment = h / 2 * (area[1:] + area[:-1]) - jnp.diff(twice, axis=0)
        return jnp.diff(area, axis=0) / h, 12 * moment / h**2


def _of_cubics(slopes: tuple[float, ...]) -> Kernel:
    """Return the kernel of cubics through the rows; slopes: share of the rows around in the slope at the middle one."""
    half, pieces = len(slopes) // 2, []
    for row in range(half + 1, -half - 1, -1):  # that many rows from the beginning of a piece
        begin, end = (slopes[k + half] if abs(k) <= half else 0.0 for k in (row, row - 1))
        value = [float(row == 0), 0.0, 3.0 * ((row == 1) - (row == 0)), 2.0 * ((row == 0) - (row == 1))]
        pieces.append((value[0], begin, value[2] - 2 * begin - end, value[3] + begin + end))
    return Kernel(-half - 1, tuple(pieces))


KERNELS = {
    HELD: Kernel(0, ((1.0,),)),
    LINEAR: Kernel(-1, ((0.0, 1.0), (1.0, -1.0))),
    SMOOTH: _of_cubics((1 / 12, -8 / 12, 0.0, 8 / 12, -1 / 12)),
}
REACH = {
    word: (kernel.first + len(kernel.pieces) - 1, -kernel.first) for word, kernel in KERNELS.items()
}  # rows before, behind


def begun_smoothly(u: Float[Array, "R nu"], lead: int, rows: int) -> Float[Array, "R nu"]:
    """Return inputs whose record begins behind so many rows that repeat its first value, with a parabola in the last of these.

    It stays within what the input was: a delay reads it, too.

    Args:
        u: inputs; the first `lead` rows are the past.
        lead: rows of the past; they are known, and stay, where one of them is another value.
        rows: of the past that a smooth input reads.
    """
    still = jnp.all(u[:lead] == u[lead][None], axis=0)
    record = u[lead:]
    low, high = jnp.min(record, axis=0), jnp.max(record, axis=0)
    for k in range(min(rows, lead)):
        before = beyond(record[::-1])
        record = jnp.concatenate([before[None], record])
        u = u.at[lead - 1 - k].set(jnp.where(still, jnp.clip(before, low, high), u[lead - 1 - k]))
    return u


def beyond(u: Rows) -> Rows:
    """Return the value (...) behind the last of (rows, ...), as a parabola through the last three has it; of fewer the last."""
    return 3 * u[-1] - 3 * u[-2] + u[-3] if len(u) > 2 else u[-1]


def ramp(passed: Array) -> Array:
    """Return how much of a sample has passed, from 0 to 1; at both ends the slope is that of a delay that begins to grow."""
    return jnp.where(passed <= 0, 0.0, jnp.where(passed > 1, 1.0, passed))


def _polynomial(coefficients: tuple[float, ...], s: Array) -> Array:
    found = jnp.zeros_like(s)
    for c in reversed(coefficients):
        found = found * s + c
    return found
