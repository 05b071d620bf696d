"""The one-step map of a simulator in the coordinates of the learning problem, for one point.

(x, phi) -> y = [enc(F(s, u; phi)) - enc(s), g(s, u; phi)],   F = RK4 of the model over dt

g reads the inputs that act from the row on: a late one as it arrives. Where sensors are late, s is what they show
(`late_readings`).
"""

from collections.abc import Callable
from typing import NamedTuple

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from simpel_cli.dynamics.arriving import arriving
from simpel_cli.dynamics.casadi_jax import checked
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.input_delay import as_read, prompt_inputs
from simpel_cli.dynamics.integrate import State, rk4_step
from simpel_cli.dynamics.late_readings import late_of
from simpel_cli.errors import ConfigError
from simulators.groups import slots_of
from simulators.model import Model, Quantity
from simulators.overshoot import reach
from simulators.worlds.world import World

LONG = 200  # scalar instructions of a right-hand side that is compiled once and not once per stage

OneStep = Callable[[Float[Array, " dx"], Float[Array, " dp"]], Float[Array, " dy"]]


class Transition(NamedTuple):
    """A simulator as a function of a network input and uncertain parameters.

    Args:
        encoding: coordinates.
        params: of the simulator.
        gap: expected model error.
        step: one-step map.
        width: numbers that the integration of one transition carries.
    """

    encoding: Encoding
    params: tuple[Quantity, ...]
    gap: dict[str, float]
    step: OneStep
    width: int


def encoding_of(model: Model | World, outputs: tuple[str, ...] = (), stack: int = 0) -> Encoding:
    """Return the coordinates of a model whose named outputs are measured."""
    measured = tuple(q for q in model.outputs if q.name in outputs)
    linear = model.linear if isinstance(model, Model) else ()
    one_of = slots_of(model) if isinstance(model, Model) else ()
    return Encoding(model.states, model.inputs, measured, stack, linear, one_of)


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
    # outputs are read off the whole function; a transition is integrated in the model's own coordinates
    shows = bool(encoding.outputs or not model.states or model.sensor_delay or model.sensor_lag)
    measure = checked(model.function(), ranges) if shows else None
    integrated = _integrated(model, ranges) if model.states else None
    rows = [[q.name for q in model.outputs].index(q.name) for q in encoding.outputs]

    echoes = model.echoes()
    needed = model.past() + echoes
    if needed > encoding.stack:
        acts = f"inputs of {model.name} act up to {model.memory():.3g} s later"
        shown = f"late sensors of {model.name} show what inputs did before"
        raise ConfigError(
            f"data.stack_actions: {encoding.stack}, but {acts if not echoes else shown}: a transition needs the {needed} "
            f"inputs before its own. Use data.stack_actions={needed}."
        )
    late_inputs = bool(model.delay or model.lag)
    kept = reach(model) if late_inputs else ()
    late = late_of(model, measure) if measure is not None else None
    before = max(echoes, int(late is not None))

    def acting_of(u: Float[Array, "R du"], phi: Float[Array, " dp"]) -> Float[Array, "T substeps K du"]:
        """Return the inputs of the substeps of the row in question and, where sensors are late, of those before."""
        if late_inputs:
            return arriving(model, u, phi, encoding.stack - before, kept)
        first = [max(encoding.stack - k, 0) for k in range(before, -1, -1)]  # without inputs no past is needed
        return jnp.stack([prompt_inputs(u[k : k + 2], model.substeps, model.linear) for k in first])

    def step(x: Float[Array, " dx"], phi: Float[Array, " dp"]) -> Float[Array, " dy"]:
        read, stacked = encoding.split_x(x)
        u = encoding.input_rows(stacked)
        acting = acting_of(u, phi) if late_inputs or late is not None else None
        shown = None if acting is None else as_read(acting, model.linear)
        now = encoding.inputs_now(stacked) if shown is None else shown[-1, 0, 0]
        state = read if late is None or shown is None else late.meant(read, shown[:-1], phi)
        outputs = measure(state, now, phi)[1] if measure is not None and rows else state[:0]
        if late is not None and shown is not None and rows:
            outputs = outputs + late.behind(state, shown[:-1], phi, now)[len(read) :]
        outputs = outputs[jnp.array(rows, int)] if rows else outputs
        if integrated is None:
            return encoding.to_y(read, read, outputs)
        own = prompt_inputs(u[encoding.stack :], model.substeps, model.linear) if acting is None else acting[-1]
        after = integrated(state, own, phi)
        if late is not None and shown is not None:
            after = after + late.behind(after, shown[1:], phi)[: len(read)]
        return encoding.to_y(read, after, outputs)

    width = model.coordinates.size if model.coordinates is not None else len(model.states)
    return Transition(encoding, model.params, model.gap, step, width)


def _integrated(
    model: Model, ranges: list[list[tuple[float, float]]]
) -> Callable[[State, Float[Array, "substeps K du"], Float[Array, " dp"]], State]:
    """Return the map (state, inputs of the substeps, phi) -> state dt later, checked against CasADi."""
    flow, h = model.flow(), model.dt / model.substeps
    states, inputs, params = ranges
    enter, leave, where = None, None, states
    if flow.enter is not None and flow.leave is not None:
        where = _reached(flow.enter, states, params)
        enter, leave = checked(flow.enter, [states, params]), checked(flow.leave, [where, params])
    rhs = checked(flow.rhs, [where, inputs, params])
    long = flow.rhs.class_name() == "SXFunction" and flow.rhs.n_instructions() > LONG

    def integrated(state: State, u: Float[Array, "substeps K du"], phi: Float[Array, " dp"]) -> State:
        low, high = (jnp.array(ends, state.dtype) for ends in (flow.low, flow.high))

        def one(z: State, u: Float[Array, "K du"]) -> tuple[State, None]:
            after = rk4_step(lambda z, u: rhs(z, u, phi)[0], z, u, h, scanned=long)
            return jnp.clip(after, low, high) if flow.limited else after, None

        z = enter(state, phi)[0] if enter is not None else state
        z = jax.lax.scan(one, z, u)[0]
        return leave(z, phi)[0] if leave is not None else z

    return integrated


def _reached(
    enter: casadi.Function, states: list[tuple[float, float]], params: list[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Return the box of a model's own coordinates that its declared ranges reach."""
    random = np.random.default_rng(0)
    boxes = [np.array(box, float).reshape(-1, 2) for box in (states, params)]
    points = [casadi.DM(random.uniform(box[:, 0], box[:, 1], (64, len(box))).T) for box in boxes]
    values = np.asarray(enter.map(64)(*points))
    return list(zip(values.min(axis=1).tolist(), values.max(axis=1).tolist(), strict=True))
