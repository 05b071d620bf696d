"""What a controller is asked for, and where: the groups of control bound to one simulator."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp

from simpel_cli.control.agents.planner import ICEM
from simpel_cli.control.agents.sac import SAC
from simpel_cli.control.compatibility import check_compatible
from simpel_cli.control.settings import Control
from simpel_cli.control.task import Goal, Task
from simpel_cli.control.world import World, true_world
from simpel_cli.data.recording import Source
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.errors import ConfigError
from simpel_cli.studies.declared import Declared
from simulators.model import Model


class Assignment(NamedTuple):
    """What a controller is asked for, and where.

    Args:
        task: as declared.
        encoding: of the simulator's quantities.
        goal: bound to the quantities.
        control: how the policy meets the model.
        policy: how it learns.
        planner: in its place, plans in the model at every step; None: a policy is learned.
        source: the simulator.
        truth: the true simulator; None: there is none to test in.
        truth_name: its name.
    """

    task: Task
    encoding: Encoding
    goal: Goal
    control: Control
    policy: SAC
    planner: ICEM | None
    source: Source
    truth: World | None
    truth_name: str

    @property
    def memory(self) -> int:
        """Past commands that a policy sees."""
        return max(self.encoding.memory, int(self.goal.uses_before))


def assignment(declared: Declared) -> Assignment:
    """Bind the groups of control to the simulator, before anything is fitted.

    Raises:
        ConfigError: a key, or quantities of the truth that are not those of the simulator.
    """
    groups = declared.groups
    task: Task | None = groups.get("reward")
    if task is None:
        raise ConfigError("reward: missing; name a task, e.g. reward=parking, or an experiment that brings one.")
    control, source = groups.get("control") or Control(), declared.source
    if not source.states:
        raise ConfigError(f"sim: {source.name} has no states, so there is nothing to control.")
    for name, column in source.per.items() if isinstance(source, Model) else ():
        raise ConfigError(
            f"sim.parameters.{name}.per: it differs from one {column} to another, and a policy does not know which it drives. "
            f"Leave `per` out: a policy for all of them, or give the value of one: sim.parameters.{name}=<number>."
        )
    for name in source.covariates if isinstance(source, Model) else ():
        raise ConfigError(
            f"sim.parameters.{name}.column: a column knows it in every row, but a policy does not drive it. Say for which "
            f"value the policy is: sim.parameters.{name}=<number>."
        )
    encoding = encoding_of(source, stack=declared.measurements.stack_actions)
    goal = task.bind(encoding)
    true, truth, name = groups.get("truth"), None, ""
    if true is not None:
        if isinstance(true, Model):  # driven as the rig is, where it says nothing of its own
            true = replace(true, between_rows=dict(declared.measurements.between_rows) | true.between_rows)
        truth, name = _true_world(true, task, goal, encoding, source.dt), true.name
    return Assignment(task, encoding, goal, control, groups["policy"], groups.get("planner"), source, truth, name)


def remarks(asked: Assignment) -> list[str]:
    """Return warnings about a task, one line each."""
    found = []
    for q in asked.source.states:
        low, high = asked.task.begins(q.name)
        if not q.periodic and (low < q.low - 0.1 * (q.high - q.low) or high > q.high + 0.1 * (q.high - q.low)):
            found.append(
                f"reward.initial.{q.name}: {asked.task.initial.get(q.name, 0.0)} extends beyond its range "
                f"[{q.low:g}, {q.high:g}] {q.unit} (sim.states.{q.name}): the model is not valid there"
            )
    return found


def _true_world(source: Any, task: Task, goal: Goal, own: Encoding, dt: float) -> World:
    if not isinstance(source, Model):
        raise ConfigError(f"truth: {source.name} is a black box; name a simulator with equations, e.g. sim@truth=...")
    encoding = encoding_of(source, stack=own.stack)
    check_compatible("truth", source, own, goal, dt)
    phi = jnp.asarray([q.middle for q in source.params], jnp.float32)
    noise = jnp.asarray([task.noise_std.get(q.name, 0.0) for q in own.states], jnp.float32)
    return true_world(encoding, goal, transition(source, encoding).step, phi, noise)


def refuse_outputs(encoding: Encoding) -> None:
    """Refuse measurements of more than states.

    Raises:
        ConfigError: names what is measured.
    """
    if encoding.outputs:
        measured = ", ".join(q.name for q in encoding.outputs)
        raise ConfigError(
            f"data.columns: {measured} is measured besides the states, but a policy uses states only. Leave it out."
        )
