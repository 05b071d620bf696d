"""Inputs as a model sees them: with its own delays and lags, over the substeps of rows."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from simpel_cli.dynamics.input_delay import as_read, delayed_inputs
from simulators.model import Model


def seconds(model: Model, times: dict[str, float | str], phi: Float[Array, " dp"]) -> Float[Array, " du"]:
    """Return the delay or the lag of every input, s; `times`: of the model, input -> a number or a parameter's name."""
    return values_of(model, times, [q.name for q in model.inputs], phi)


def values_of(
    model: Model, times: Mapping[str, float | str], names: Sequence[str], phi: Float[Array, " dp"]
) -> Float[Array, " n"]:
    """Return the time of every named signal, s, 0 where none is given; `times`: name -> a number or a parameter's name."""
    values = {**model.fixed, **{q.name: phi[i] for i, q in enumerate(model.params)}}
    each = [times.get(name, 0.0) for name in names]
    return jnp.stack([jnp.asarray(values[v] if isinstance(v, str) else v, phi.dtype) for v in each])


def arriving(
    model: Model,
    rows: Float[Array, "R du"],
    phi: Float[Array, " dp"],
    lead: int,
    ranges: Sequence[tuple[float, float]] = (),
) -> Float[Array, "T substeps K du"]:
    """Return the inputs of every substep of the rows behind the lead; ranges: as of `delayed_inputs`."""
    late = seconds(model, model.delay, phi), seconds(model, model.lag, phi)
    return delayed_inputs(
        rows, *late, dt=model.dt, substeps=model.substeps, lead=lead, linear=model.linear,
        ranges=ranges,
    )  # fmt: skip


def acting(model: Model, inputs: np.ndarray, phi: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return what acts from every row of an episode on, (T, du), where these are the inputs as given: what outputs read.

    It is the mean over the first substep of the row, as everywhere in the tool: where a held input arrives within it, a share
    of the new value is read already, and of a lag what it does in it.
    """
    if not (model.delay or model.lag):
        return inputs
    past = model.past()
    before, after = np.repeat(inputs[:1], past, axis=0), inputs[-1:] if model.linear else inputs[:0]
    rows = jnp.asarray(np.concatenate([before, inputs, after]))
    found = arriving(model, rows, jnp.asarray(phi, rows.dtype), past)
    return np.asarray(as_read(found, model.linear)[:, 0, 0])
