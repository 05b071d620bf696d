"""The one-step map of a simulator in the coordinates of the learning problem, for one point.

(x, phi) -> y = [enc(F(s, u; phi)) - enc(s), g(s, u; phi)],   F = RK4 of the model over dt
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.casadi_jax import checked
from simpel_cli.encoding import Encoding
from simpel_cli.errors import ConfigError
from simpel_cli.integrate import State, rk4
from simpel_cli.signals import arriving
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

    needed = -(-model.memory() // model.dt)
    if needed > encoding.stack:
        raise ConfigError(
            f"data.stack_actions: {encoding.stack}, but inputs of {model.name} act up to {model.memory():.3g} s later: a "
            f"transition needs the {needed:.0f} inputs before its own. Use data.stack_actions={needed:.0f}."
        )
    params, h = [q.name for q in model.params], model.dt / model.substeps

    def seconds(times: dict[str, float | str], phi: Float[Array, " dp"]) -> Float[Array, " du"]:
        values = {**model.fixed, **{name: phi[i] for i, name in enumerate(params)}}
        each = [times.get(q.name, 0.0) for q in model.inputs]
        return jnp.stack([jnp.asarray(values[v] if isinstance(v, str) else v, phi.dtype) for v in each])

    def follow(state: State, stacked: Float[Array, " su"], phi: Float[Array, " dp"]) -> State:
        u = stacked[stacked.shape[0] - n_inputs :]
        if not (model.delay or model.lag):
            return rk4(lambda s: right_hand_side(s, u, phi)[0], state, model.dt, model.substeps)
        late = arriving(
            stacked.reshape(encoding.stack + 1, n_inputs), seconds(model.delay, phi), seconds(model.lag, phi),
            dt=model.dt, substeps=model.substeps, lead=encoding.stack,
        )  # fmt: skip

        def one(state: State, u: Float[Array, " du"]) -> tuple[State, None]:
            return rk4(lambda s: right_hand_side(s, u, phi)[0], state, h, 1), None

        return jax.lax.scan(one, state, late[0])[0]

    def step(x: Float[Array, " dx"], phi: Float[Array, " dp"]) -> Float[Array, " dy"]:
        state, stacked = encoding.split_x(x)
        u = stacked[stacked.shape[0] - n_inputs :]
        outputs = right_hand_side(state, u, phi)[1][jnp.array(rows, int)] if rows else state[:0]
        after = follow(state, stacked, phi) if model.states else state
        return encoding.to_y(state, after, outputs)

    return Transition(encoding, model.params, model.gap, step)
