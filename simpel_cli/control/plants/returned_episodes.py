"""What a rig sends back: one Parquet file per episode, read, and refused or remarked upon where it cannot be right."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.control.plants.plant import LEAST_ROWS, PlantEpisode, earned
from simpel_cli.control.plants.runner import PolicyRunner
from simpel_cli.control.task import Goal, Task
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import DataError
from simpel_cli.runs.files import read_table
from simulators.quantity import Quantity

POLL = 0.2  # s
JITTER = 0.5  # of dt: how far a row's time may be from where it should be
FAR, ODD = 10.0, 1.0  # widths of a state's range beyond it: no measurement, and worth a line
APART = 0.1  # of a command's range, on average: commands are not the policy's


class ReturnedEpisodes:
    """Reads episodes.

    Args:
        encoding: names of states and inputs.
        goal: of the task.
        task: its horizon, beyond which rows are not looked at, and where episodes begin.
        dt: s, between rows.
        say: where a line for the user goes.
    """

    def __init__(self, encoding: Encoding, goal: Goal, task: Task, dt: float, say: Callable[[str], None]) -> None:
        self.encoding, self.goal, self.task, self.dt, self.say = encoding, goal, task, dt, say
        self.horizon = task.horizon

    @property
    def asked(self) -> dict[str, Any]:
        """What a rig has to know of an episode."""
        initial = {q.name: self.task.initial.get(q.name, 0.0) for q in self.encoding.states}
        return {"rows": self.horizon + 1, "dt": self.dt, "initial": initial}

    def read(self, path: Path) -> PlantEpisode:
        """Read an episode.

        Raises:
            DataError: it cannot be used; says the row and why.
        """
        table = _table(path)
        there = len(next(iter(table.values()), ()))
        rows = min(there, self.horizon + 1)
        if there > rows:
            self.say(f"{path.name} has {there} rows: the first {rows} are taken")
        if rows < LEAST_ROWS:
            raise DataError(f"{path.name}: {rows} rows; an episode has {LEAST_ROWS} at least.")
        self._in_time(table, path, rows)
        states = np.stack([self._column(table, path, q.name, rows) for q in self.encoding.states], axis=1)
        # of the last row nobody sees what its command led to, so that a rig need not know it
        # an input that is linear between rows has reached the command of a row at the next
        linear = self.encoding.linear
        commands = np.stack(
            [
                self._column(table, path, q.name, rows)[1:]
                if i in linear
                else self._column(table, path, q.name, rows - 1)
                for i, q in enumerate(self.encoding.inputs)
            ],
            axis=1,
        )
        low, high = np.array(self.goal.low), np.array(self.goal.high)
        beyond = (commands < low - 1e-3 * (high - low)) | (commands > high + 1e-3 * (high - low))
        if beyond.any():
            row, column = np.argwhere(beyond)[0]
            q = self.encoding.inputs[column]
            raise DataError(
                f"{path.name}, row {row}: {q.name} is {commands[row, column]:g} {q.unit}; allowed are "
                f"{low[column]:g} to {high[column]:g}."
            )
        for q, column in zip(self.encoding.states, states.T, strict=True):
            self._within(path, q, column)
        reward, good, over = earned(self.goal, self.encoding, states[1:], commands)
        last = int(np.argmax(over)) + 1 if over.any() else len(reward)
        if last < self.horizon and not over.any():
            self.say(f"{path.name} has {rows} rows of {self.horizon + 1}: taken as an episode that was cut short")
        return PlantEpisode(states[: last + 1], commands[:last], reward[:last], good[:last])

    def _within(self, path: Path, quantity: Quantity, values: np.ndarray) -> None:
        """Compare a state with its declared range: a spike of a sensor would be the end of every fit to come."""
        if quantity.periodic:
            return
        beyond = np.maximum(quantity.low - values, values - quantity.high) / (quantity.high - quantity.low)
        row = int(np.argmax(beyond))
        problem = (
            f"{path.name}, row {row}: {quantity.name} is {values[row]:.4g} {quantity.unit}, far outside its range "
            f"[{quantity.low:g}, {quantity.high:g}] (sim.states.{quantity.name})"
        )
        if beyond[row] > FAR:
            raise DataError(f"{problem}. Take the spike out, or declare the range that the rig has.")
        if beyond[row] > ODD:
            self.say(f"{problem}: a spike of the sensor would spoil the model")

    def remark(self, path: Path, episode: PlantEpisode, policy: Path) -> None:
        """Say what is odd about an episode."""
        for q, value in zip(self.encoding.states, episode.states[0], strict=True):
            low, high = self.task.begins(q.name)
            if not q.periodic and not low <= value <= high:
                self.say(f"{path.name} begins at {q.name} = {value:.4g} {q.unit}; the task does in {low:g} to {high:g}")
        runner = PolicyRunner(policy)
        names = [q.name for q in self.encoding.states]
        given = []
        for state, command in zip(episode.states, episode.commands, strict=False):
            own = runner.command(dict(zip(names, state.tolist(), strict=True)))
            given.append([own[q.name] for q in self.encoding.inputs])
            runner.past = [*runner.past[1:], command] if runner.past else []
        apart = np.mean(np.abs(np.array(given) - episode.commands), axis=0) / (runner.high - runner.low)
        for q, share in zip(self.encoding.inputs, apart, strict=True):
            if share > APART:
                self.say(
                    f"{path.name}: {q.name} is {100 * share:.0f} % of its range off what the policy would have given, on "
                    "average: was it this policy that drove?"
                )

    def _in_time(self, table: dict[str, np.ndarray], path: Path, rows: int) -> None:
        """Compare the column `t`, if there is one, with the rows' distance."""
        if "t" not in table:
            return
        times = table["t"][:rows]
        if np.issubdtype(times.dtype, np.datetime64):
            times = (times - times[0]) / np.timedelta64(1, "s")
        times = self._column({"t": times}, path, "t", rows)
        late = np.flatnonzero(np.abs(times - times[0] - self.dt * np.arange(rows)) > JITTER * self.dt)
        if len(late):
            raise DataError(
                f"{path.name}, row {late[0]}: t is {times[late[0]] - times[0]:g} s after the first row, where a row every "
                f"{self.dt:g} s (sim.dt) has {self.dt * late[0]:g}. Send a row every {self.dt:g} s, or leave t out."
            )

    def _column(self, table: dict[str, np.ndarray], path: Path, name: str, rows: int) -> np.ndarray:
        if name not in table:
            raise DataError(f"{path.name}: the column {name} is missing; it has {', '.join(table)}.")
        try:
            values = np.asarray(table[name][:rows], float)
        except (TypeError, ValueError):
            raise DataError(f"{path.name}: the column {name} holds something other than numbers.") from None
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            raise DataError(f"{path.name}, row {bad[0]}: {name} is {values[bad[0]]}, not a finite number.")
        return values


def _table(path: Path) -> dict[str, np.ndarray]:
    """Read a Parquet file; one that is still being written is given a moment."""
    problem: Any = None
    for _ in range(25):
        try:
            table = read_table(path)
            return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
        except (OSError, ValueError) as error:
            problem = error
            time.sleep(POLL)
    raise DataError(f"{path.name}: no readable Parquet file ({str(problem).splitlines()[0]}).")
