"""The plant that `world` names."""

import secrets
from pathlib import Path

import numpy as np

from simpel_cli.control.plants.environments import GymnasiumEnvironment, WorldEnvironment
from simpel_cli.control.plants.exchange import Exchange
from simpel_cli.control.plants.plant import Plant, Simulated, Stepped
from simpel_cli.control.plants.returned_episodes import ReturnedEpisodes
from simpel_cli.control.rounds import OnlineRun, refuse_unusable
from simpel_cli.errors import ConfigError, did_you_mean
from simpel_cli.runs.directory import make_directory
from simpel_cli.runs.files import write_text
from simpel_cli.runs.settings import stream
from simulators.model import Model

WORLDS = "sim, mujoco, gymnasium:ID and folder:DIR"


def open_plant(run: OnlineRun) -> Plant:
    """Return the plant that `world` names.

    Raises:
        ConfigError: no such world, or what it needs is missing.
    """
    settings, asked, world = run.settings, run.asked, run.world
    kind, _, rest = world.partition(":")
    encoding, goal, horizon, key = asked.encoding, asked.goal, asked.task.horizon, stream(settings.seed, "plant")
    if kind == "sim" and not rest:
        if asked.truth is None:
            raise ConfigError(
                "world: sim needs a true simulator, e.g. sim@truth=parking_car; for a rig use world=folder:DIR."
            )
        actor = asked.policy.bind(asked.truth, horizon, len(encoding.inputs)).actor
        return Simulated(asked.truth, encoding, goal, actor.act, horizon, key)
    if kind == "mujoco" and not rest:
        source = run.declared.groups.get("mujoco")
        if source is None:
            raise ConfigError("world: mujoco needs a MuJoCo world, e.g. sim@mujoco=rc_car_world.")
        if isinstance(source, Model):
            raise ConfigError(
                f"mujoco: {source.name} is a simulator with equations; use it as sim@truth with world=sim."
            )
        noise = np.array([asked.task.noise_std.get(q.name, 0.0) for q in encoding.states])
        return Stepped(WorldEnvironment(source, encoding, goal, asked.source.dt, noise, key), encoding, goal, horizon)
    if kind == "gymnasium" and rest:
        return Stepped(GymnasiumEnvironment(rest, encoding, settings.seed), encoding, goal, horizon)
    if kind == "folder" and rest:
        return Exchange(
            make_directory(Path(rest), "world", "world=folder:DIR"),
            ReturnedEpisodes(encoding, goal, asked.task, asked.source.dt, lambda text: run.terminal.line(text, "rig")),
            run.online.wait, _identity(run.directory), lambda number, episode: refuse_unusable(run, number, episode),
            lambda text: run.terminal.line(text, "rig"), run.check,
        )  # fmt: skip
    kinds = ["sim", "mujoco", "gymnasium", "folder"]
    hint = "" if kind in kinds else did_you_mean(kind, kinds)
    raise ConfigError(f"world: got {world!r}; allowed are {WORLDS}.{hint}")


def _identity(directory: Path) -> str:
    """Return what tells this run's requests to a rig from those of others, wherever its directory is moved."""
    path = directory / "exchange_id.txt"
    if not path.exists():
        write_text(path, secrets.token_hex(16))
    return path.read_text()
