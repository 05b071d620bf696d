"""Environments that are stepped: a MuJoCo world, and anything that gymnasium makes."""

import importlib
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from simpel_cli.control.compatibility import check_compatible
from simpel_cli.control.task import Goal
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError
from simulators.worlds.world import World


class WorldEnvironment:
    """A world with query access, with noisy sensors. States that the simulator does not have begin at 0.

    Args:
        world: to step; its parameters take the middle of their ranges.
        encoding: of the simulator, whose states the world has by name, perhaps among others.
        goal: of the task.
        dt: s, of the simulator.
        noise_std: of the sensors, per state of the simulator.
        key: of the initial states and of the noise.

    Raises:
        ConfigError: what the world has, it has in another way than the simulator.
    """

    def __init__(
        self, world: World, encoding: Encoding, goal: Goal, dt: float, noise_std: np.ndarray, key: PRNGKeyArray
    ) -> None:
        check_compatible("mujoco", world, encoding, goal, dt, by_name=True)
        self.world, self.goal, self.noise_std, self.key = world, goal, noise_std, key
        self.columns = [[q.name for q in world.states].index(q.name) for q in encoding.states]
        self.order = [[q.name for q in encoding.inputs].index(q.name) for q in world.inputs]
        self.phi = np.array([[q.middle for q in world.params]])
        self.state, self.rng = np.zeros(len(world.states)), np.random.default_rng()

    def reset(self, number: int) -> np.ndarray:
        """Begin an episode; see `Environment`."""
        key = jax.random.fold_in(self.key, number)
        self.rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        self.state = np.zeros(len(self.world.states))
        self.state[self.columns] = np.asarray(self.goal.start(key, 1))[0]
        return self._measured()

    def step(self, command: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """Apply a command; see `Environment`."""
        self.state = self.world.step(self.state[None], command[self.order][None], self.phi)[0]
        return self._measured(), self.state[self.columns].copy(), False

    def _measured(self) -> np.ndarray:
        return self.state[self.columns] + self.noise_std * self.rng.standard_normal(len(self.columns))


class GymnasiumEnvironment:
    """An environment of gymnasium's protocol. What it observes are the states: a mapping by name, or an array in their order.

    Its own reward is not looked at: the task has one.

    Args:
        name: as gymnasium knows it, or MODULE:NAME.
        encoding: names of the states.
        seed: of the first reset.

    Raises:
        ConfigError: gymnasium is not installed, or it knows no such environment.
    """

    def __init__(self, name: str, encoding: Encoding, seed: int) -> None:
        self.name, self.encoding, self.seed = name, encoding, seed
        try:
            gymnasium = importlib.import_module("gymnasium")
        except ImportError:
            raise ConfigError(
                "world: gymnasium is not installed; `pip install gymnasium`, or use world=folder:DIR."
            ) from None
        try:
            self.environment: Any = gymnasium.make(name)
        except Exception as error:  # its own errors, of which there are many
            raise ConfigError(f"world: gymnasium cannot make {name!r}: {error}") from error

    def reset(self, number: int) -> np.ndarray:
        """Begin an episode; see `Environment`."""
        return self._states(self.environment.reset(seed=self.seed * 1000 + number)[0])

    def step(self, command: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """Apply a command; see `Environment`."""
        seen, _, terminated, truncated, *_ = self.environment.step(command.astype(np.float32))
        states = self._states(seen)
        return states, states, bool(terminated or truncated)

    def _states(self, seen: Any) -> np.ndarray:
        names = [q.name for q in self.encoding.states]
        if isinstance(seen, dict):
            missing = [n for n in names if n not in seen]
            if missing:
                raise ConfigError(f"world: {self.name} observes {', '.join(seen)}; missing: {', '.join(missing)}.")
            return np.array([float(np.asarray(seen[n]).item()) for n in names])
        values = np.asarray(seen, float).ravel()
        if len(values) != len(names):
            raise ConfigError(
                f"world: {self.name} observes {len(values)} numbers; the simulator has {len(names)} states "
                f"({', '.join(names)}). Wrap it so that it observes these, in this order or by name."
            )
        return values
