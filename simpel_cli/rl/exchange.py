"""A rig behind a folder: a policy goes out, one Parquet file of an episode comes back. The rig needs no simpel, nor JAX.

    DIR/episode_003/policy.safetensors, policy.json, run_policy.py     what to drive with
    DIR/episode_003/request.json                                       which file is waited for; written last
    DIR/episode_003.parquet                                            the rig's answer: a row per dt, columns by name

An answer that cannot be used is renamed to `episode_003.refused-1.parquet`, what was wrong with it is written beside it, and
the next one is waited for.
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


class Exchange:
    """A rig behind a folder.

    Args:
        folder: made if missing.
        encoding: names of states and inputs.
        goal: of the task.
        horizon: steps of an episode; rows beyond them are not looked at.
        wait: s, until it gives up.
        run: whose exchange this is: an answer that another run asked for is none.
        say: where a line for the user goes.
    """

    def __init__(
        self,
        folder: Path,
        encoding: Encoding,
        goal: Goal,
        horizon: int,
        wait: float,
        run: str,
        say: Callable[[str], None],
    ) -> None:
        self.folder, self.encoding, self.goal, self.horizon = folder, encoding, goal, horizon
        self.wait, self.run, self.say = wait, run, say

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
            shutil.copytree(policy, asked.parent, dirs_exist_ok=True)
            write_text(asked, json.dumps(request, indent=1))
        if not answer.exists():
            self.say(f"waiting for {answer} ({self.horizon + 1} rows; the policy lies in {self.folder / name})")
        end = time.monotonic() + self.wait
        while True:
            if answer.exists():
                try:
                    return self._read(answer)
                except DataError as error:
                    self._refuse(answer, str(error))
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
        states, commands = (
            np.stack([self._column(table, path, q.name) for q in group], axis=1)
            for group in (self.encoding.states, self.encoding.inputs)
        )
        if len(states) < LEAST_ROWS:
            raise DataError(f"{path.name}: {len(states)} rows; an episode has {LEAST_ROWS} at least.")
        states, commands = states[: self.horizon + 1], commands[: self.horizon + 1]
        low, high = np.array(self.goal.low), np.array(self.goal.high)
        beyond = (commands[:-1] < low - 1e-3 * (high - low)) | (commands[:-1] > high + 1e-3 * (high - low))
        if beyond.any():
            row, column = np.argwhere(beyond)[0]
            q = self.encoding.inputs[column]
            raise DataError(
                f"{path.name}, row {row}: {q.name} is {commands[row, column]:g} {q.unit}; allowed are "
                f"{low[column]:g} to {high[column]:g}."
            )
        reward, good, over = earned(self.goal, states[1:], commands[:-1])
        last = int(np.argmax(over)) + 1 if over.any() else len(reward)
        return Ride(states[: last + 1], commands[:last], reward[:last], good[:last])

    def _column(self, table: dict[str, np.ndarray], path: Path, name: str) -> np.ndarray:
        if name not in table:
            raise DataError(f"{path.name}: the column {name} is missing; it has {', '.join(table)}.")
        try:
            values = np.asarray(table[name], float)
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
