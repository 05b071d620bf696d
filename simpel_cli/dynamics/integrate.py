"""Fixed-step integration of ordinary differential equations, one point at a time."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

State = Float[Array, " ds"]
Input = Float[Array, " du"]


def rk4_step(
    derivative: Callable[[State, Input], State], x: State, u: Float[Array, "K du"], h: float, *, scanned: bool = False
) -> State:
    """Integrate `dx/dt = derivative(x, u)` over h with one classical Runge-Kutta step.

    Many steps belong into a scan: an unrolled integrator makes XLA recompute fused expressions.

    Args:
        derivative: right-hand side, state units per second.
        x: state at the start, shape (ds,).
        u: input of the system, held over the step (K = 1), or at its beginning, middle and end (K = 3).
        h: length of the step, s.
        scanned: put the four stages into a loop, so that a long right-hand side is compiled once: XLA fuses four copies of
            hundreds of operations for minutes where derivatives are asked for. A tenth slower.

    Returns:
        State after h, shape (ds,); n steps have a global error of order h^4.

    Reference: Kutta (1901).
    """
    if scanned:
        stages = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]], x.dtype) * h

        def stage(carry: tuple[State, State], now: tuple[Array, Array]) -> tuple[tuple[State, State], None]:
            (total, slope), (weights, u) = carry, now
            slope = derivative(x + weights[0] * slope, u)
            return (total + weights[1] * slope, slope), None

        return jax.lax.scan(stage, (x, jnp.zeros_like(x)), (stages, at_stages(u)))[0][0]
    begin, middle, end = u[0], u[len(u) // 2], u[-1]
    k1 = derivative(x, begin)
    k2 = derivative(x + h / 2 * k1, middle)
    k3 = derivative(x + h / 2 * k2, middle)
    k4 = derivative(x + h * k3, end)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def at_stages(u: Float[Array, "K *du"]) -> Float[Array, "4 *du"]:
    """Return the inputs of the four stages from those at beginning, middle and end of a step, or the held one."""
    return u[jnp.array([0, len(u) // 2, len(u) // 2, len(u) - 1])]
