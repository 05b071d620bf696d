"""Fixed-step integration of ordinary differential equations, one point at a time."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

State = Float[Array, " ds"]


def rk4_step(derivative: Callable[[State], State], x: State, h: float, *, scanned: bool = False) -> State:
    """Integrate `dx/dt = derivative(x)` over h with one classical Runge-Kutta step.

    The input of the system is held over a step (zero-order hold), so `derivative` takes the state alone. Many steps belong
    into a scan: an unrolled integrator makes XLA recompute fused expressions.

    Args:
        derivative: right-hand side, state units per second.
        x: state at the start, shape (ds,).
        h: length of the step, s.
        scanned: put the four stages into a loop, so that a long right-hand side is compiled once: XLA fuses four copies of
            hundreds of operations for minutes where derivatives are asked for. A tenth slower.

    Returns:
        State after h, shape (ds,); n steps have a global error of order h^4.

    Reference: Kutta (1901).
    """
    if scanned:
        stages = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]], x.dtype) * h

        def stage(carry: tuple[State, State], weights: Array) -> tuple[tuple[State, State], None]:
            total, slope = carry
            slope = derivative(x + weights[0] * slope)
            return (total + weights[1] * slope, slope), None

        return jax.lax.scan(stage, (x, jnp.zeros_like(x)), stages)[0][0]
    k1 = derivative(x)
    k2 = derivative(x + h / 2 * k1)
    k3 = derivative(x + h / 2 * k2)
    k4 = derivative(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
