"""A plant: the system itself, which a policy drives for one episode at a time."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.control.agents.policy import Policy
from simpel_cli.control.agents.rollout import Episodes, episodes, reflex
from simpel_cli.control.plants.policy_files import load_policy
from simpel_cli.control.plants.runner import PolicyRunner
from simpel_cli.control.task import Goal
from simpel_cli.control.world import World
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import DataError
from simpel_cli.runs.files import write_table

LEAST_ROWS = 2  # of an episode: one transition


class PlantEpisode(NamedTuple):
    """One episode as it was measured, physical units.

    Args:
        states: (R, ds), the first before any command.
        commands: (R - 1, du).
        reward: (R - 1,), of the step that a command led to.
        good: (R - 1,), whether the state was then where it should be.
    """

    states: np.ndarray
    commands: np.ndarray
    reward: np.ndarray
    good: np.ndarray


@runtime_checkable
class Plant(Protocol):
    """Whatever a policy drives."""

    def episode(self, number: int, policy: Path) -> PlantEpisode:
        """Drive one episode.

        Args:
            number: of the episode, from 0.
            policy: folder with the policy and its contract.

        Raises:
            DataError: no episode came of it.
        """
        ...


@runtime_checkable
class Environment(Protocol):
    """A plant that is stepped, physical units."""

    def reset(self, number: int) -> np.ndarray:
        """Begin an episode; return the measured states (ds,)."""
        ...

    def step(self, command: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """Apply a command (du,) for one transition; return the measured states, the true ones or the same, and the end."""
        ...


def earned(
    goal: Goal, encoding: Encoding, after: np.ndarray, commands: np.ndarray, before: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return reward, success and end of successive steps.

    Args:
        goal: of the task.
        encoding: of the states; angles are judged in [-pi, pi), however often the plant has turned.
        after: states after every step, (T, ds).
        commands: of every step, (T, du).
        before: command of the step before the first, (du,); None: nobody had given one.

    Raises:
        DataError: a reward is not finite.
    """
    earlier = np.concatenate([np.array([goal.rest if before is None else before]), commands[:-1]])
    wrapped = encoding.decode(encoding.encode(after))
    judged = goal.judge(jnp.asarray(wrapped), jnp.asarray(commands), jnp.asarray(earlier))
    bad = np.flatnonzero(~np.isfinite(np.asarray(judged.reward)))
    if len(bad):
        where = ", ".join(f"{q.name} = {v:.4g}" for q, v in zip(encoding.states, after[bad[0]], strict=True))
        raise DataError(
            f"the reward is {np.asarray(judged.reward)[bad[0]]} after step {bad[0]}, at {where}; see reward.reward."
        )
    return np.asarray(judged.reward), np.asarray(judged.good), np.asarray(judged.over)


class Simulated:
    """A simulator with equations as the plant.

    Args:
        world: of it.
        encoding: of its states.
        goal: of the task.
        act: (policy, observations) -> actions.
        horizon: steps of an episode.
        key: of the initial states and of the sensors' noise.
    """

    def __init__(
        self,
        world: World,
        encoding: Encoding,
        goal: Goal,
        act: Callable[[Policy, Float[Array, "B do"]], Float[Array, "B du"]],
        horizon: int,
        key: PRNGKeyArray,
    ) -> None:
        self.encoding, self.goal, self.key = encoding, goal, key

        def one(policy: Policy, key: PRNGKeyArray) -> Episodes:
            # a step more than counts: its observation is that of the last state
            return episodes(world, reflex(lambda seen: act(policy, seen)), key, 1, horizon + 1)

        self._run = jax.jit(one)

    def episode(self, number: int, policy: Path) -> PlantEpisode:
        """Drive one episode; see `Plant`. It ends where the simulator could not go on."""
        found = self._run(load_policy(policy)[0], jax.random.fold_in(self.key, number))
        found = jax.tree.map(lambda a: np.asarray(a)[:, 0] if a.ndim > 1 else np.asarray(a), found)
        # of the step that the simulator could not take no state is known
        steps = min(int(found.lived.sum()) - int(found.broken.any()), len(found.lived) - 1)
        if steps < 1:
            raise DataError(f"episode {number}: no step was possible; the simulator gave no finite state at once.")
        states = np.asarray(self.encoding.decode(jnp.asarray(found.seen[:, : self.encoding.dim_state])))
        commands = np.asarray(self.goal.command(jnp.asarray(found.action)))
        return PlantEpisode(states[: steps + 1], commands[:steps], found.reward[:steps], found.good[:steps])


class Stepped:
    """An environment that is stepped, driven by the runner that needs numpy only.

    Args:
        environment: what is stepped.
        encoding: names of states.
        goal: of the task.
        horizon: steps of an episode.
    """

    def __init__(self, environment: Environment, encoding: Encoding, goal: Goal, horizon: int) -> None:
        self.environment, self.encoding, self.goal, self.horizon = environment, encoding, goal, horizon

    def episode(self, number: int, policy: Path) -> PlantEpisode:
        """Drive one episode; see `Plant`. It ends where a state is not finite."""
        runner, names = PolicyRunner(policy), [q.name for q in self.encoding.states]
        measured, true, commands = [np.asarray(self.environment.reset(number), float)], [], []
        for _ in range(self.horizon):
            if not np.isfinite(measured[-1]).all():
                break
            given = runner.command(dict(zip(names, measured[-1].tolist(), strict=True)))
            command = np.array([given[q.name] for q in self.encoding.inputs])
            seen, state, ended = self.environment.step(command)
            if not (np.isfinite(seen).all() and np.isfinite(state).all()):
                break
            commands.append(command)
            measured.append(np.asarray(seen, float))
            true.append(np.asarray(state, float))
            before = commands[-2] if len(commands) > 1 else None
            if ended or earned(self.goal, self.encoding, np.array(true[-1:]), np.array(commands[-1:]), before)[2][0]:
                break
        if not commands:
            raise DataError(f"episode {number}: no step was possible; a state was not finite at once: {measured[0]}.")
        reward, good, _ = earned(self.goal, self.encoding, np.array(true), np.array(commands))
        return PlantEpisode(np.array(measured), np.array(commands), reward, good)


def write_episode(path: Path, episode: PlantEpisode, encoding: Encoding, dt: float, rest: Sequence[float]) -> None:
    """Write an episode as measurements: of every row the states and the inputs there.

    A held input is the command that is given there, and of the last row, whose command nobody saw, the one before. An input
    that is linear between rows has reached the command of the row before, and begins at rest.

    Args:
        path: of the Parquet file.
        episode: the episode.
        encoding: names and units.
        dt: s, between rows.
        rest: commands that nobody gave, (du,).
    """
    inputs = np.concatenate([episode.commands, episode.commands[-1:]])
    inputs[1:, list(encoding.linear)] = episode.commands[:, list(encoding.linear)]
    inputs[0, list(encoding.linear)] = np.array(rest)[list(encoding.linear)]
    columns: dict[str, Any] = {"t": np.arange(len(episode.states)) * dt}
    columns |= {q.name: episode.states[:, i].astype(float) for i, q in enumerate(encoding.states)}
    columns |= {q.name: inputs[:, i].astype(float) for i, q in enumerate(encoding.inputs)}
    columns |= {
        "reward": np.append(episode.reward, 0.0).astype(float),
        "good": np.append(episode.good, episode.good[-1]),
    }
    write_table(path, columns, {"t": "s"} | {q.name: q.unit for q in (*encoding.states, *encoding.inputs)})
