"""A MuJoCo world that answers queries.

A query compiles the XML with its own parameter values, so that everything that follows from them (inertia, reference
poses) follows, sets the joints, holds the controls and lets MuJoCo run for dt.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import mujoco.rollout
import numpy as np

from simulators.model import ModelError, Quantity

CHUNK = 1024  # queries compiled at a time: bounds the memory of models that all differ


class Setting(NamedTuple):
    """One number of the XML that a parameter sets: a field of an element, or an entry of it."""

    element: Any  # mujoco.MjsJoint, MjsBody, ..., MjOption: no common base class
    field: str
    entry: int | None

    def read(self) -> float:
        """Return the number as it stands."""
        value = getattr(self.element, self.field)
        return float(value if self.entry is None else value[self.entry])

    def write(self, value: float) -> None:
        """Set the number."""
        if self.entry is None:
            setattr(self.element, self.field, float(value))
        else:
            getattr(self.element, self.field)[self.entry] = value


@dataclass(frozen=True, eq=False)
class CompiledWorld:
    """A MuJoCo world that answers queries; see `World`.

    Args:
        name: as declared.
        dt: duration of one transition, s.
        states: ds of them.
        inputs: du of them.
        params: dp of them.
        outputs: none.
        gap: expected error of one transition by state.
        spec: the editable XML.
        settings: what each parameter sets.
        state_columns: where each state stands in MuJoCo's state [time, positions, velocities].
        controls: which actuator each input drives.
        threads: threads that share the queries.

    """

    name: str
    dt: float
    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    params: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    gap: dict[str, float]
    spec: mujoco.MjSpec
    settings: tuple[Setting, ...]
    state_columns: tuple[int, ...]
    controls: tuple[int, ...]
    threads: int = 1

    def step(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Answer n queries: states (n, ds), inputs (n, du), params (n, dp) -> states dt later (n, ds), not wrapped.

        A row is NaN where the query is not finite or where MuJoCo reports an unstable simulation.

        Raises:
            ModelError: MuJoCo refuses a parameter vector, e.g. a negative mass.

        """
        arrays = [np.asarray(array, float) for array in (states, inputs, params)]
        after = np.full(arrays[0].shape, np.nan)
        # MuJoCo would reset a state that is not finite, and go on
        finite = np.flatnonzero(np.all([np.isfinite(array).all(axis=1) for array in arrays], axis=0))
        for begin in range(0, len(finite), CHUNK):
            rows = finite[begin : begin + CHUNK]
            after[rows] = self._run(*(array[rows] for array in arrays))
        return after

    def _run(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        distinct, which = np.unique(params, axis=0, return_inverse=True)
        models = [self._compile(row) for row in distinct]
        timestep = models[0].opt.timestep
        n_steps = round(self.dt / timestep)
        begin = np.zeros((len(states), 1 + len(self.state_columns)))
        begin[:, self.state_columns] = states
        control = np.zeros((len(states), 1, models[0].nu))
        control[:, 0, self.controls] = inputs
        path, _ = mujoco.rollout.rollout(
            [models[i] for i in which],
            [mujoco.MjData(models[0]) for _ in range(self.threads)],
            begin,
            control if models[0].nu else None,
            nstep=n_steps,
        )
        end = path[:, -1]
        # after a warning MuJoCo resets the state and rollout stops: the clock tells
        complete = np.abs(end[:, :1] - self.dt) < timestep / 2
        return np.where(complete, end[:, self.state_columns], np.nan)

    def _compile(self, values: np.ndarray) -> mujoco.MjModel:
        for setting, value in zip(self.settings, values, strict=True):
            setting.write(value)
        try:
            return self.spec.compile()
        except ValueError as error:
            shown = ", ".join(f"{q.name} = {value:g}" for q, value in zip(self.params, values, strict=True))
            raise ModelError(f"sim.parameters: MuJoCo refuses {shown}: {error}; change the ranges") from error

    def check_effect(self, name: str, setting: Setting, ends: tuple[float, float] | None) -> None:
        """Make sure that a parameter changes the compiled model, and that MuJoCo accepts the ends of its range.

        A mass, say, is ignored where the XML lets the geoms decide the inertia.

        Raises:
            ModelError: the compiled model is the same at both ends.

        """
        before = setting.read()
        images = []
        for value in ends or (before, 1.01 * before + 1e-3):
            setting.write(value)
            try:
                model = self.spec.compile()
            except ValueError as error:
                raise ModelError(f"sim.parameters.{name}: MuJoCo refuses {value:g}: {error}; change it") from error
            image = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
            mujoco.mj_saveModel(model, None, image)
            images.append(image.tobytes())
        setting.write(before)
        if images[0] == images[1]:
            raise ModelError(
                f"sim.parameters.{name}: {setting.field} changes nothing in the compiled model; MuJoCo takes the value "
                "from elsewhere (e.g. the inertia from the geoms, unless the body has <inertial>)"
            )
