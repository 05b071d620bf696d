"""A MuJoCo world that answers queries.

A query compiles the XML with its own parameter values, so that everything that follows from them (inertia, reference
poses) follows, sets the joints, gives each actuator its command and lets MuJoCo run for dt.
"""

from dataclasses import dataclass, replace
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


def commands_on_their_way(delay: int, n_steps: int) -> int:
    """Return how many past commands a delay of so many time steps keeps, with `n_steps` of them in a transition."""
    return -(-delay // n_steps)


@dataclass(frozen=True, eq=False)
class CompiledWorld:
    """A MuJoCo world that answers queries; see `World`.

    Args:
        name: as declared.
        dt: duration of one transition, s.
        states: ds of them; those of the joints, then the past commands that are still on their way to an actuator.
        inputs: du of them.
        params: dp of them.
        outputs: none.
        gap: expected error of one transition by state.
        spec: the editable XML.
        settings: what each parameter sets.
        state_columns: where each state of a joint stands in MuJoCo's state [time, positions, velocities].
        controls: which actuator each input drives.
        delays: by how many of MuJoCo's time steps each input arrives late.
        threads: threads that share the queries.
        part: time steps of a transition after which a query is answered; None: all.

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
    delays: tuple[int, ...]
    threads: int = 1
    part: int | None = None

    def shorter(self, duration: float) -> "CompiledWorld":
        """Return the world that answers after `duration` s of a transition; see `FinerWorld.shorter`.

        Raises:
            ModelError: no whole number of MuJoCo's time steps.

        """
        timestep = self.spec.option.timestep
        part = round(duration / timestep)
        if part < 1 or abs(duration - part * timestep) > 1e-9:
            raise ModelError(
                f"{self.name} is asked {duration:g} s after a row, which is no whole number of MuJoCo's time steps of "
                f"{timestep:g} s; change it, or set sim.timestep"
            )
        return replace(self, part=part)

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
        begin[:, self.state_columns] = states[:, : len(self.state_columns)]
        control = np.zeros((len(states), n_steps, models[0].nu))
        control[:, :, self.controls], waiting = self._late(states[:, len(self.state_columns) :], inputs, n_steps)
        n_run = n_steps if self.part is None else self.part
        if n_run < n_steps:  # those on their way until the next transition begins
            waiting = states[:, len(self.state_columns) :]
        path, _ = mujoco.rollout.rollout(
            [models[i] for i in which],
            [mujoco.MjData(models[0]) for _ in range(self.threads)],
            begin,
            np.ascontiguousarray(control[:, :n_run]) if models[0].nu else None,
            nstep=n_run,
        )
        end = path[:, -1]
        # after a warning MuJoCo resets the state and rollout stops: the clock tells
        complete = np.abs(end[:, :1] - n_run * timestep) < timestep / 2
        return np.where(complete, np.column_stack([end[:, self.state_columns], waiting]), np.nan)

    def _late(self, past: np.ndarray, inputs: np.ndarray, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return what reaches the actuators at each time step, (n, n_steps, du), and the past commands afterwards."""
        arriving = np.empty((len(inputs), n_steps, len(self.delays)))
        waiting = []
        for i, delay in enumerate(self.delays):
            n_past = commands_on_their_way(delay, n_steps)
            commands = np.column_stack([inputs[:, i], past[:, :n_past]])  # newest first, one per transition
            past = past[:, n_past:]
            arriving[:, :, i] = commands[:, -((np.arange(n_steps) - delay) // n_steps)]
            waiting.append(commands[:, :n_past])
        return arriving, np.column_stack([np.empty((len(inputs), 0)), *waiting])

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
