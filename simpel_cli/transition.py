"""The one-step map of a simulator in the coordinates of the learning problem, for one point.

(x, phi) -> y = [enc(F(s, u; phi)) - enc(s), g(s, u; phi)],   F = RK4 of the model over dt
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.casadi_jax import checked
from simpel_cli.encoding import Encoding
from simpel_cli.integrate import rk4
from simulators.model import Model, Quantity
from simulators.worlds.world import World

OneStep = Callable[[Float[Array, " dx"], Float[Array, " dp"]], Float[Array, " dy"]]


class Transition(NamedTuple):
    """A simulator as a function of a network input and uncertain parameters."""

    encoding: Encoding
    params: tuple[Quantity, ...]
    gap: dict[str, float]
    step: OneStep


def encoding_of(model: Model | World, outputs: tuple[str, ...] = (), stack: int = 0) -> Encoding:
    """Return the coordinates of a model whose named outputs are measured."""
    measured = tuple(q for q in model.outputs if q.name in outputs)
    return Encoding(states=model.states, inputs=model.inputs, outputs=measured, stack=stack)


def transition(model: Model, encoding: Encoding) -> Transition:
    """Turn a model into its one-step map.

    The CasADi function is converted to JAX and compared with CasADi at random points of the declared ranges.

    Args:
        model: symbolic right-hand side with named quantities.
        encoding: coordinates; its outputs are a subset of the model's.

    Raises:
        ConversionError: an operation is not supported, or JAX and CasADi disagree.
    """
    ranges = [[(q.low, q.high) for q in group] for group in (model.states, model.inputs, model.params)]
    right_hand_side = checked(model.function(), ranges)
    n_inputs = len(model.inputs)
    rows = [[q.name for q in model.outputs].index(q.name) for q in encoding.outputs]

    def step(x: Float[Array, " dx"], phi: Float[Array, " dp"]) -> Float[Array, " dy"]:
        state, stacked = encoding.split_x(x)
        u = stacked[stacked.shape[0] - n_inputs :]
        outputs = right_hand_side(state, u, phi)[1][jnp.array(rows, int)] if rows else state[:0]
        after = rk4(lambda s: right_hand_side(s, u, phi)[0], state, model.dt, model.substeps) if model.states else state
        return encoding.to_y(state, after, outputs)

    return Transition(encoding, model.params, model.gap, step)
