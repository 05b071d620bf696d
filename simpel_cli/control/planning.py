"""A planner in every seed's posterior, judged there and in the true world."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from simpel_cli.control.agents.rollout import Episodes, episodes
from simpel_cli.control.assignment import Assignment
from simpel_cli.control.posterior_world import multiple_of_rollouts, world_of_posterior
from simpel_cli.control.training import TrainedPolicies
from simpel_cli.inference.protocols import Problem
from simpel_cli.runs.settings import stream
from simpel_cli.studies.fit import Learned


def plan(learned: Learned, asked: Assignment) -> tuple[TrainedPolicies, Episodes | None]:
    """Let a planner act in every seed's posterior and, planning there, in the true world.

    Returns:
        What it earns in the model, and its episodes in the true world, leaves (seeds, ...).
    """
    planner, control, task = asked.planner, asked.control, asked.task
    assert planner is not None
    world_at, dim_u = world_of_posterior(learned, asked), len(asked.encoding.inputs)
    multiple = multiple_of_rollouts(learned, asked)
    number = -(-control.episodes // multiple) * multiple

    def in_model(arrays: tuple[Problem, Any], key: PRNGKeyArray) -> tuple[Any, Any]:
        world = world_at(arrays, 0.0)
        found = episodes(world, planner.bind(world, task.horizon, dim_u), key, number, task.horizon)
        return jnp.mean(found.returns), jnp.mean(found.broken.astype(jnp.float32))

    def in_truth(arrays: tuple[Problem, Any], key: PRNGKeyArray) -> Episodes:
        assert asked.truth is not None
        controller = planner.bind(world_at(arrays, 0.0), task.horizon, dim_u)
        return episodes(asked.truth, controller, key, control.episodes, task.horizon)

    problems = jax.tree.map(jnp.asarray, (learned.fitted.assembled.problems, learned.state))
    began = time.perf_counter()
    earned, broken = jax.jit(jax.vmap(in_model, in_axes=(0, None)))(problems, stream(0, "judge"))
    judged = None
    if asked.truth is not None:
        judged = jax.jit(jax.vmap(in_truth, in_axes=(0, None)))(problems, stream(0, "judge in the truth"))
    return TrainedPolicies(None, np.asarray(earned), np.asarray(broken), time.perf_counter() - began, 0.0), judged
