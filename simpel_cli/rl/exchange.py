"""A rig behind a folder: a policy goes out, one Parquet file of an episode comes back. The rig needs no simpel, nor JAX.

    DIR/episode_003/policy.safetensors, policy.json, run_policy.py     what to drive with
    DIR/episode_003/request.json                                       which file is waited for; written last
    DIR/episode_003.parquet                                            the rig's answer: a row per dt, columns by name

An answer that cannot be used is renamed to `episode_003.refused-1.parquet`, what was wrong with it is written beside it, and
another one is waited for, as long as for the first.
"""

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.encoding import Encoding
from simpel_cli.errors import DataError
from simpel_cli.records import write_text
from simpel_cli.rl.plant import LEAST_ROWS, Ride, earned
from simpel_cli.rl.task import Goal

POLL = 0.2  # s
JITTER = 0.5  # of dt: how far a row's time may be from where it should be


class Exchange:
    """A rig behind a folder.

    Args:
        folder: made if missing.
        encoding: names of states and inputs.
        goal: of the task.
        horizon: steps of an episode; rows beyond them are not looked at.
        dt: s, between rows.
        wait: s, for an answer, until it gives up.
        run: whose exchange this is: an answer that another run asked for is none.
        accept: raises DataError of an episode, by its number, that a fit could not read.
        say: where a line for the user goes.
        check: called while it waits; may raise.
    """

    def __init__(
        self,
        folder: Path,
        encoding: Encoding,
        goal: Goal,
        horizon: int,
        dt: float,
        wait: float,
        run: str,
        accept: Callable[[int, Ride], None],
        say: Callable[[str], None],
        check: Callable[[], None],
    ) -> None:
        self.folder, self.encoding, self.goal, self.horizon, self.dt = folder, encoding, goal, horizon, dt
        self.wait, self.run, self.accept, self.say, self.check = wait, run, accept, say, check

    def ride(self, number: int, policy: Path) -> Ride:
        """Hand out the policy and wait for the episode; see `Plant`.

        Raises:
            DataError: none came in time. Nothing is lost: resume. Or there is one that this run did not ask for.
        """
        name = f"episode_{number:03d}"
        answer, asked = self.folder / f"{name}.parquet", self.folder / name / "request.json"
        request = {"format": "simpel episode 1", "run": self.run, "answer": answer.name, "rows": self.horizon + 1}
        if not _is(asked, request):
            if answer.exists():
                raise DataError(
                    f"{answer} is there, but this run did not ask for it. Use an empty folder, or move it away."
                )
            asked.unlink(missing_ok=True)  # a request of before does not stand beside half a policy
            shutil.copytree(policy, asked.parent, dirs_exist_ok=True)
            write_text(asked, json.dumps(request, indent=1))
        if not answer.exists():
            self.say(f"waiting for {answer} ({self.horizon + 1} rows; the policy lies in {self.folder / name})")
        end = time.monotonic() + self.wait
        while True:
            if answer.exists():
                try:
                    ride = self._read(answer)
                    self.accept(number, ride)
                    return ride
                except DataError as error:
                    self._refuse(answer, str(error))
                    end = time.monotonic() + self.wait
            self.check()
            if time.monotonic() > end:
                raise DataError(
                    f"{answer} did not come within {self.wait:g} s (online.wait). Everything is kept: put it there and "
                    "go on with --resume."
                )
            time.sleep(POLL)

    def _refuse(self, answer: Path, problem: str) -> None:
        count = len(list(self.folder.glob(f"{answer.stem}.refused-*.parquet"))) + 1
        kept = answer.with_name(f"{answer.stem}.refused-{count}.parquet")
        answer.rename(kept)
        write_text(kept.with_suffix(".txt"), f"{problem}\n")
        self.say(f"refused: {problem} It is kept as {kept.name}; waiting for another {answer.name}")

    def _read(self, path: Path) -> Ride:
        table = _table(path)
        rows = min(len(next(iter(table.values()), ())), self.horizon + 1)
        if rows < LEAST_ROWS:
            raise DataError(f"{path.name}: {rows} rows; an episode has {LEAST_ROWS} at least.")
        self._in_time(table, path, rows)
        states = np.stack([self._column(table, path, q.name, rows) for q in self.encoding.states], axis=1)
        # of the last row nobody sees what its command led to, so that a rig need not know it
        commands = np.stack([self._column(table, path, q.name, rows - 1) for q in self.encoding.inputs], axis=1)
        low, high = np.array(self.goal.low), np.array(self.goal.high)
        beyond = (commands < low - 1e-3 * (high - low)) | (commands > high + 1e-3 * (high - low))
        if beyond.any():
            row, column = np.argwhere(beyond)[0]
            q = self.encoding.inputs[column]
            raise DataError(
                f"{path.name}, row {row}: {q.name} is {commands[row, column]:g} {q.unit}; allowed are "
                f"{low[column]:g} to {high[column]:g}."
            )
        reward, good, over = earned(self.goal, self.encoding, states[1:], commands)
        last = int(np.argmax(over)) + 1 if over.any() else len(reward)
        if last < self.horizon and not over.any():
            self.say(f"{path.name} has {rows} rows of {self.horizon + 1}: taken as an episode that was cut short")
        return Ride(states[: last + 1], commands[:last], reward[:last], good[:last])

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


def _is(path: Path, request: dict[str, Any]) -> bool:
    try:
        return bool(json.loads(path.read_text()) == request)
    except (OSError, ValueError):
        return False


def _table(path: Path) -> dict[str, np.ndarray]:
    """Read a Parquet file; one that is still being written is given a moment."""
    import pyarrow.parquet as pq

    problem: Any = None
    for _ in range(25):
        try:
            table = pq.read_table(path)
            return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
        except (OSError, ValueError) as error:
            problem = error
            time.sleep(POLL)
    raise DataError(f"{path.name}: no readable Parquet file ({str(problem).splitlines()[0]}).")
