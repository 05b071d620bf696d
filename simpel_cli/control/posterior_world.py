"""The posterior of a fit as a world that a policy acts in."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from simpel_cli.control.assignment import Assignment
from simpel_cli.control.world import World, beginning_at, learned_world
from simpel_cli.inference.protocols import Problem
from simpel_cli.studies.fit import Learned


def multiple_of_rollouts(learned: Learned, asked: Assignment) -> int:
    """Return what the number of roll-outs in a posterior is a multiple of."""
    return 1 if asked.control.sampling == "mean" else learned.study.method.particles


def world_of_posterior(learned: Learned, asked: Assignment) -> Callable[[tuple[Problem, Any], float], World]:
    """Return the map from a problem, a posterior's state and a share of roll-outs that begin at data to its world."""
    study, control = learned.study, asked.control
    encoding = study.system.encoding

    def world_at(arrays: tuple[Problem, Any], share: float) -> World:
        problem, state = arrays
        rule = learned.fitted.bind(problem)
        law = (rule.typical or rule.predict)(state, jnp.zeros((1, encoding.dim_x), problem.x.dtype))
        world = learned_world(
            encoding, asked.goal, lambda x: rule.members(state, x), law.noise_scale, study.method.particles, control.sampling,
            aleatoric=control.aleatoric, tail=law.tail, relative=rule.relative,
        )  # fmt: skip
        return beginning_at(world, encoding, jnp.asarray(problem.x), jnp.asarray(problem.m), share)

    return world_at
