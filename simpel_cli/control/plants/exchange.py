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

from simpel_cli.control.plants.plant import PlantEpisode
from simpel_cli.control.plants.returned_episodes import POLL, ReturnedEpisodes
from simpel_cli.errors import DataError
from simpel_cli.runs.files import write_text


class Exchange:
    """A rig behind a folder.

    Args:
        folder: made if missing.
        returned: reads what comes back.
        wait: s, for an answer, until it gives up.
        run: whose exchange this is: an answer that another run asked for is none.
        accept: raises DataError of an episode, by its number, that a fit could not read.
        say: where a line for the user goes.
        check: called while it waits; may raise.
    """

    def __init__(
        self,
        folder: Path,
        returned: ReturnedEpisodes,
        wait: float,
        run: str,
        accept: Callable[[int, PlantEpisode], None],
        say: Callable[[str], None],
        check: Callable[[], None],
    ) -> None:
        self.folder, self.returned = folder, returned
        self.wait, self.run, self.accept, self.say, self.check = wait, run, accept, say, check

    def episode(self, number: int, policy: Path) -> PlantEpisode:
        """Hand out the policy and wait for the episode; see `Plant`.

        Raises:
            DataError: none came in time. Nothing is lost: resume. Or there is one that this run did not ask for.
        """
        name = f"episode_{number:03d}"
        answer, asked = self.folder / f"{name}.parquet", self.folder / name / "request.json"
        request = {"format": "simpel episode 1", "run": self.run, "answer": answer.name} | self.returned.asked
        if (found := _read_request(asked)) != request:
            if answer.exists():
                raise DataError(
                    f"{answer} is there, but this run did not ask for it. Use an empty folder, or move it away."
                )
            if found.get("run", self.run) != self.run:
                raise DataError(
                    f"{asked} is of another run, which waits for {answer.name}. Use another folder; if that run is over, "
                    f"delete {asked.parent}."
                )
            asked.unlink(missing_ok=True)  # a request of before does not stand beside half a policy
            shutil.copytree(policy, asked.parent, dirs_exist_ok=True)
            write_text(asked, json.dumps(request, indent=1))
        if not answer.exists():
            self.say(f"waiting for {answer} ({request['rows']} rows; the policy lies in {self.folder / name})")
        end = time.monotonic() + self.wait
        while True:
            if answer.exists():
                if _read_request(asked) != request:
                    raise DataError(
                        f"{asked} is no longer this run's request: another run uses the folder. Nothing was taken; give each "
                        "a folder of its own, and go on with --resume."
                    )
                try:
                    episode = self.returned.read(answer)
                    self.accept(number, episode)
                    self.returned.remark(answer, episode, policy)
                    return episode
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

    def withdraw(self, number: int) -> None:
        """Put away the answer of an episode that the user has taken back."""
        answer = self.folder / f"episode_{number:03d}.parquet"
        if answer.exists():
            self._put_away(answer, "withdrawn")

    def _put_away(self, answer: Path, why: str) -> Path:
        count = len(list(self.folder.glob(f"{answer.stem}.{why}-*.parquet"))) + 1
        return answer.rename(answer.with_name(f"{answer.stem}.{why}-{count}.parquet"))

    def _refuse(self, answer: Path, problem: str) -> None:
        kept = self._put_away(answer, "refused")
        write_text(kept.with_suffix(".txt"), f"{problem}\n")
        self.say(f"refused: {problem} It is kept as {kept.name}; waiting for another {answer.name}")


def _read_request(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
