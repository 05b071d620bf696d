"""The rounds of an online run as files: episodes, what was learned before each, and what is known of them."""

import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli.control.assignment import Assignment
from simpel_cli.control.online_settings import MEASURED, Online
from simpel_cli.control.plants.plant import PlantEpisode, write_episode
from simpel_cli.control.settings import CONTROL_GROUPS
from simpel_cli.data import Measurements, Recording, read
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.files import read_columns
from simpel_cli.runs.settings import Settings
from simpel_cli.studies.declared import Declared


class OnlineRun(NamedTuple):
    """What stays the same from episode to episode.

    Args:
        declared: the configuration.
        directory: of the run.
        asked: task and where it is done.
        online: how episodes follow each other.
        terminal: for a line per episode.
        check: raises if the user stopped the run.
    """

    declared: Declared
    directory: Path
    asked: Assignment
    online: Online
    terminal: Terminal
    check: Callable[[], None]

    @property
    def settings(self) -> Settings:
        """The group `run`."""
        return self.declared.settings

    @property
    def world(self) -> str:
        """Where the episodes take place, as declared."""
        return str(self.declared.config.get("world"))

    def episode_file(self, number: int) -> Path:
        """Return the measurements of an episode."""
        return self.directory / "episodes" / f"{number:03d}.parquet"

    def folder(self, number: int) -> Path:
        """Return the folder of what was learned before an episode."""
        return self.directory / "rounds" / f"{number:03d}"


def _record(run: OnlineRun, number: int) -> dict[str, Any]:
    """Return what is kept of a round.

    Raises:
        ConfigError: the file is damaged.
    """
    path = run.folder(number) / "round.json"
    try:
        found = json.loads(path.read_text())
        if not isinstance(found, dict) or "return_in_model" not in found:
            raise ValueError("not the record of a round")
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: damaged ({error}). Delete it and go on with --resume: it is made anew of what the round has left."
        ) from error
    return found


def own_data(config: dict[str, Any]) -> dict[str, Any]:
    """Return what of a configuration's data YAML holds for episodes of a plant, with no file yet."""
    return {"path": []} | {key: value for key, value in config["data"].items() if key in MEASURED}


def _data(run: OnlineRun, paths: Sequence[Path]) -> dict[str, Any]:
    """Return the data YAML of episodes."""
    own = own_data(run.declared.config)
    return own | {"path": [str(path) for path in paths], "time": "t", "split": {"test_fraction": 0}}


def declared_fit(run: OnlineRun, number: int) -> Declared:
    """Return the fit to all episodes before one; to none, the posterior is the prior."""
    return run.declared.without(*CONTROL_GROUPS).changed(data=_data(run, _fitted(run, number)))


def _fitted(run: OnlineRun, number: int) -> list[Path]:
    """Return the episodes before one that a fit can read."""
    rounds = [_record(run, i) for i in range(number)]
    return [run.episode_file(i) for i, facts in enumerate(rounds) if facts.get("fitted", True)]


def _measurements(run: OnlineRun, paths: Sequence[Path]) -> Measurements:
    return run.declared.changed(data=_data(run, paths)).measurements


def recorded(run: OnlineRun, paths: Sequence[Path]) -> Recording:
    """Read episodes.

    Raises:
        DataError: no transition can be made of one.
    """
    return read(_measurements(run, paths), run.asked.source, run.directory, 0)


def why_unusable(run: OnlineRun, number: int, path: Path) -> str:
    """Return why a fit can make nothing of an episode that follows those before; empty: it can."""
    before = _fitted(run, number)
    try:
        gained = len(recorded(run, [*before, path]).train) - len(recorded(run, before).train)
    except DataError as error:
        return str(error)
    stack = run.asked.encoding.stack
    return "" if gained else f"it has fewer than {stack + 2} rows, of which one transition is made"


def refuse_unusable(run: OnlineRun, number: int, episode: PlantEpisode) -> None:
    """Refuse an episode of a rig that a fit could make nothing of.

    Raises:
        DataError: says why.
    """
    for i in range(number):
        before = read_columns(run.episode_file(i))
        states = zip(run.asked.encoding.states, episode.states.T, strict=True)
        if all(np.array_equal(before[q.name], column) for q, column in states):
            raise DataError(
                f"episode_{number:03d}.parquet: row by row the same as episode {i}; send the one that was driven now."
            )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"episode_{number:03d}.parquet"
        write_episode(path, episode, run.asked.encoding, run.asked.source.dt, run.asked.goal.rest)
        if problem := why_unusable(run, number, path):
            raise DataError(f"{path.name}: {problem}")


def refuse_wrong_data(run: OnlineRun) -> None:
    """Look at the keys of the data YAML before anything is learned.

    Raises:
        ConfigError: one that does not fit the simulator.
    """
    measurements, source = _measurements(run, []), run.asked.source
    states = tuple(q.name for q in source.states)
    measurements.check_names((*states, *(q.name for q in source.inputs)), states)


def episode_facts(run: OnlineRun, number: int) -> dict[str, float]:
    """Return what is known of an episode, from the files."""
    table = read_columns(run.episode_file(number))
    good, settled = table["good"][:-1], run.asked.task.settled
    ended = bool(len(good) >= run.asked.task.horizon and good[-settled:].all())
    facts: dict[str, float] = _record(run, number)
    facts |= {"return": float(table["reward"].sum()), "steps": float(len(good))}
    return facts | ({"success": float(ended)} if run.asked.task.success else {})


def metric_rows(run: OnlineRun) -> list[dict[str, Any]]:
    """Metric rows, one per episode and quantity; step: the episode."""
    rows = []
    for number in range(run.online.episodes):
        for name, value in episode_facts(run, number).items():
            unit = "s" if name.endswith("seconds") else "nat" if name.startswith("nll") else "1"
            base = {"seed": run.settings.seed, "step": number, "split": "test", "output": ""}
            rows.append(base | {"metric": name, "unit": unit, "value": float(value)})
    return rows


def metric_constants(run: OnlineRun) -> dict[str, Any]:
    """Return the columns of the metric table that are the same in every row."""
    choices = run.declared.choices
    return {
        "experiment": run.settings.name, "method": choices.get("method", ""), "sim": choices.get("sim", ""),
        "data": run.world, "run": run.directory.name, "command": "rl-online", "n_train": None,
    }  # fmt: skip
