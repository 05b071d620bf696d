"""Coordinates of the learning problem: angles as (sin, cos), past actions stacked, differences as targets.

    x = [enc(state), past actions (oldest first), action, next actions of the inputs that are linear between rows]
    y = [enc(next state) - enc(state), measured outputs]

Everything here is numpy-like and works on numpy and on JAX arrays, single points or batches (last axis = features).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from simulators.model import Quantity


@dataclass(frozen=True)
class Encoding:
    """How physical states, inputs and outputs become the inputs x and targets y of a network.

    Args:
        states: the states of the model, in order; periodic ones are angles in rad.
        inputs: the inputs of the model.
        outputs: measured quantities that are not states.
        stack: number of past actions in x.
        linear: inputs that go straight from a row to the next; a transition depends on their next values, too.
        one_of: inputs of which one is 1 and the others are 0: the group that a row is of (`simulators.groups`).
    """

    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...] = ()
    stack: int = 0
    linear: tuple[int, ...] = ()
    one_of: tuple[tuple[int, ...], ...] = ()

    @property
    def dim_state(self) -> int:
        """Number of encoded state coordinates."""
        return sum(2 if q.periodic else 1 for q in self.states)

    @property
    def dim_x(self) -> int:
        """Number of network inputs, dx."""
        return self.dim_state + self.dim_inputs

    @property
    def dim_inputs(self) -> int:
        """Number of stacked inputs."""
        return (self.stack + 1) * len(self.inputs) + len(self.linear)

    @property
    def dim_y(self) -> int:
        """Number of network outputs, dy."""
        return self.dim_state + len(self.outputs)

    @property
    def y_names(self) -> tuple[str, ...]:
        """Name of every target coordinate, e.g. `sin(phi)`, `cos(phi)`, `omega`."""
        return (*self._state_labels(), *(q.name for q in self.outputs))

    @property
    def y_units(self) -> tuple[str, ...]:
        """Unit of every target coordinate; sine and cosine have none."""
        units = [u for q in self.states for u in (["1", "1"] if q.periodic else [q.unit])]
        return (*units, *(q.unit for q in self.outputs))

    @property
    def y_kinds(self) -> tuple[str, ...]:
        """What every target coordinate is: the `change` of a state in one step, or the `value` of an output."""
        return ("change",) * self.dim_state + ("value",) * len(self.outputs)

    def _state_labels(self) -> list[str]:
        return [n for q in self.states for n in ([f"sin({q.name})", f"cos({q.name})"] if q.periodic else [q.name])]

    def per_target(self, values: Mapping[str, float], default: float) -> np.ndarray:
        """Spread a value per state or output (in its unit) over the target coordinates, shape (dy,)."""
        spread = [values.get(q.name, default) for q in self.states for _ in range(2 if q.periodic else 1)]
        return np.array([*spread, *(values.get(q.name, default) for q in self.outputs)], dtype=float)

    @property
    def quantity_of_target(self) -> np.ndarray:
        """Index of the state, or behind them the output, that every target coordinate is of, (dy,)."""
        of_states = [i for i, q in enumerate(self.states) for _ in range(2 if q.periodic else 1)]
        return np.array([*of_states, *range(len(self.states), len(self.states) + len(self.outputs))], dtype=int)

    def encode(self, states: Any) -> Any:
        """Map physical states (..., ds) to encoded ones (..., dim_state)."""
        xp = np if isinstance(states, np.ndarray) else jnp
        parts = []
        for i, q in enumerate(self.states):
            s = states[..., i : i + 1]
            parts.extend([xp.sin(s), xp.cos(s)] if q.periodic else [s])
        return xp.concatenate(parts, axis=-1) if parts else states

    def decode(self, encoded: Any) -> Any:
        """Map encoded states (..., dim_state) back; atan2 accepts (sin, cos) pairs off the unit circle."""
        xp = np if isinstance(encoded, np.ndarray) else jnp
        parts, i = [], 0
        for q in self.states:
            if q.periodic:
                parts.append(xp.arctan2(encoded[..., i], encoded[..., i + 1]))
                i += 2
            else:
                parts.append(encoded[..., i])
                i += 1
        return xp.stack(parts, axis=-1) if parts else encoded

    def to_x(self, states: Any, inputs: Any) -> Any:
        """Network input (..., dx) from physical states (..., ds) and stacked inputs (..., dim_inputs)."""
        xp = np if isinstance(states, np.ndarray) else jnp
        return xp.concatenate([self.encode(states), inputs], axis=-1)

    def split_x(self, x: Any) -> tuple[Any, Any]:
        """Physical states (..., ds) and stacked inputs (..., dim_inputs) of network inputs (..., dx)."""
        return self.decode(x[..., : self.dim_state]), x[..., self.dim_state :]

    def inputs_now(self, stacked: Any) -> Any:
        """Inputs (..., du) of the row in question, of stacked ones (..., dim_inputs)."""
        du = len(self.inputs)
        return stacked[..., self.stack * du : (self.stack + 1) * du]

    def input_rows(self, stacked: Any) -> Any:
        """Stacked inputs (..., dim_inputs) row by row, oldest first, (..., R, du).

        R = stack + 1; one more where an input is linear, with the next values of the linear ones (the others repeat theirs).
        """
        xp = np if isinstance(stacked, np.ndarray) else jnp
        du, rows = len(self.inputs), self.stack + 1
        own = stacked[..., : rows * du].reshape(*stacked.shape[:-1], rows, du)
        if not self.linear:
            return own
        last = [
            stacked[..., rows * du + self.linear.index(i)] if i in self.linear else own[..., -1, i] for i in range(du)
        ]
        return xp.concatenate([own, xp.stack(last, axis=-1)[..., None, :]], axis=-2)

    def stacked(self, rows: Any) -> Any:
        """Stack inputs (..., dim_inputs) of so many rows that `input_rows` has, (..., R, du)."""
        xp = np if isinstance(rows, np.ndarray) else jnp
        own = rows[..., : self.stack + 1, :]
        flat = own.reshape(*own.shape[:-2], -1)
        return xp.concatenate([flat, rows[..., -1, list(self.linear)]], axis=-1) if self.linear else flat

    @property
    def memory(self) -> int:
        """Past commands that a transition depends on.

        A command is what a held input takes at once and keeps, and what a linear one reaches at the next row: where one is
        linear, its value at the row in question is the command of the row before.
        """
        return self.stack + bool(self.linear)

    def driven(self, commands: Any) -> Any:
        """Stack inputs (..., dim_inputs) of commands (..., memory + 1, du), oldest first, the last one given now."""
        if not self.linear:
            return self.stacked(commands)
        xp = np if isinstance(commands, np.ndarray) else jnp
        held, linear = commands[..., 1:, :], commands[..., :-1, :]
        now = xp.where(self._is_linear(held.ndim), linear, held)
        return self.stacked(xp.concatenate([now, commands[..., -1:, :]], axis=-2))

    def commands(self, stacked: Any) -> Any:
        """Commands (..., memory, du) before the row in question, of stacked inputs; of what is not known the oldest."""
        xp = np if isinstance(stacked, np.ndarray) else jnp
        rows = self.input_rows(stacked)[..., : self.stack + 1, :]
        if not self.linear:
            return rows[..., :-1, :]
        held = xp.concatenate([rows[..., :1, :], rows[..., :-1, :]], axis=-2)
        return xp.where(self._is_linear(held.ndim), rows, held)

    def _is_linear(self, axes: int) -> np.ndarray:
        """Mask of the linear inputs along the last of so many axes."""
        return np.isin(np.arange(len(self.inputs)), self.linear).reshape((1,) * (axes - 1) + (-1,))

    def to_y(self, states: Any, next_states: Any, outputs: Any) -> Any:
        """Target (..., dy): difference of the encoded states, then the measured outputs."""
        xp = np if isinstance(states, np.ndarray) else jnp
        return xp.concatenate([self.encode(next_states) - self.encode(states), outputs], axis=-1)

    def advance(self, encoded: Any, y: Any) -> Any:
        """Encoded state after one step; (sin, cos) pairs are put back on the unit circle."""
        return self.encode(self.decode(encoded + y[..., : self.dim_state]))
