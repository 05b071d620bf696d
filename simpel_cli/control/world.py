"""A world that a policy acts in: a simulator or a learned model, B episodes at once.

    y = follow(x),   x = [encoded state, inputs that the commands made],   next state = advance(state, y)

States are kept in the encoding of the learning problem; what is observed is the encoded state, with sensor noise in a true
world, and the last commands. In a learned model the state is what sensors would show: its noise is part of the model.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from simpel_cli.control.task import Goal, Judged
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import OneStep

Follow = Callable[[PRNGKeyArray, Float[Array, "B dx"]], Float[Array, "B dy"]]
SAMPLING = ("ts1", "tsinf", "mean")


class Situation(NamedTuple):
    """Where B episodes are.

    Args:
        encoded: states.
        past: commands of the steps before, physical, oldest first.
    """

    encoded: Float[Array, "B de"]
    past: Float[Array, "B memory du"]


class Step(NamedTuple):
    """What one step of B episodes led to.

    Args:
        situation: afterwards.
        judged: reward, success, end of the episode.
        broken: the world could not go on; the situation is as it was.
    """

    situation: Situation
    judged: Judged
    broken: Bool[Array, " B"]


class World(NamedTuple):
    """B episodes of a task, in a simulator or a model.

    Args:
        reset: (key, n) -> initial situations; no command has been given.
        observe: (key, situations) -> observations, (B, do).
        step: (key, situations, actions in [-1, 1]) -> what they lead to.
        at: observations without noise -> the situations that show them.
        memory: commands of the past that are kept.
        multiple: B has to be a multiple of it.
    """

    reset: Callable[[PRNGKeyArray, int], Situation]
    observe: Callable[[PRNGKeyArray, Situation], Float[Array, "B do"]]
    step: Callable[[PRNGKeyArray, Situation, Float[Array, "B du"]], Step]
    at: Callable[[Float[Array, "B do"]], Situation]
    memory: int
    multiple: int = 1


def world_of(
    encoding: Encoding, goal: Goal, follow: Follow, noise_std: Float[Array, " ds"] | None = None, multiple: int = 1
) -> World:
    """Return the world in which states follow a one-step map.

    Args:
        encoding: coordinates.
        goal: the task.
        follow: one-step map of B inputs.
        noise_std: of the sensors, physical; None: the state is what they show.
        multiple: of B.
    """
    memory = max(encoding.memory, int(goal.uses_before))
    dim_u = len(encoding.inputs)

    def reset(key: PRNGKeyArray, n: int) -> Situation:
        encoded = encoding.encode(goal.start(key, n))
        rest = jnp.asarray(goal.rest, encoded.dtype)
        return Situation(encoded, jnp.broadcast_to(rest[None, None], (n, memory, dim_u)))

    def observe(key: PRNGKeyArray, situation: Situation) -> Float[Array, "B do"]:
        seen = situation.encoded
        if noise_std is not None:
            states = encoding.decode(seen)
            noise = jax.random.normal(key, states.shape, states.dtype) * noise_std[None].astype(states.dtype)
            seen = encoding.encode(states + noise)
        return jnp.concatenate([seen, situation.past.reshape(len(seen), -1)], axis=1)

    def at(seen: Float[Array, "B do"]) -> Situation:
        return Situation(seen[:, : encoding.dim_state], seen[:, encoding.dim_state :].reshape(len(seen), memory, dim_u))

    def step(key: PRNGKeyArray, situation: Situation, action: Float[Array, "B du"]) -> Step:
        command = goal.command(action.astype(situation.encoded.dtype))
        commands = jnp.concatenate([situation.past[:, memory - encoding.memory :], command[:, None]], axis=1)
        x = jnp.concatenate([situation.encoded, encoding.driven(commands)], axis=1)
        after = encoding.advance(situation.encoded, follow(key, x).astype(x.dtype))
        before = situation.past[:, -1] if memory else command
        judged = goal.judge(encoding.decode(after), command, before)
        broken = ~(jnp.isfinite(after).all(axis=1) & jnp.isfinite(judged.reward))
        past = jnp.concatenate([situation.past, command[:, None]], axis=1)[:, 1:] if memory else situation.past
        kept = Situation(jnp.where(broken[:, None], situation.encoded, after), past)
        reward = jnp.where(broken, jnp.zeros_like(judged.reward), judged.reward)
        return Step(kept, judged._replace(reward=reward, over=judged.over | broken), broken)

    return World(reset, observe, step, at, memory, multiple)


def true_world(
    encoding: Encoding, goal: Goal, one: OneStep, phi: Float[Array, " dp"], noise_std: Float[Array, " ds"]
) -> World:
    """Return the world of a simulator with known parameters and noisy sensors."""

    def follow(key: PRNGKeyArray, x: Float[Array, "B dx"]) -> Float[Array, "B dy"]:
        return jax.vmap(one, in_axes=(0, None))(x, phi.astype(x.dtype))

    return world_of(encoding, goal, follow, noise_std)


def learned_world(
    encoding: Encoding,
    goal: Goal,
    members: Callable[[Float[Array, "L n dx"]], Float[Array, "L n dy"]],
    noise_scale: Float[Array, " dy"],
    particles: int,
    sampling: str = "ts1",
    *,
    aleatoric: bool = True,
    tail: Float[Array, " dy"] | None = None,
    relative: Callable[[Float[Array, "n dx"], Float[Array, "n dy"]], Float[Array, "n dy"]] | None = None,
) -> World:
    """Return the world of a posterior.

    Args:
        encoding: coordinates.
        goal: the task.
        members: targets of every particle at its own inputs.
        noise_scale: of the observations, data units.
        particles: L.
        sampling: `ts1` a particle drawn anew at every step, `tsinf` one for a whole roll-out, `mean` the mean of all.
        aleatoric: whether noise is added (never to the mean).
        tail: 1/nu of noise that is Student's t; None: it is Gaussian.
        relative: inputs and targets to the noise of each over `noise_scale`; None: 1.

    Reference: Chua et al. (2018), Deep reinforcement learning in a handful of trials, section 5 (trajectory sampling).
    """

    def follow(key: PRNGKeyArray, x: Float[Array, "B dx"]) -> Float[Array, "B dy"]:
        if sampling == "mean":
            return jnp.mean(members(jnp.broadcast_to(x[None], (particles, *x.shape))), axis=0)
        n = len(x)
        key_turn, key_noise = jax.random.split(key)
        # every particle takes its share of the episodes, so that only the particle that is asked is evaluated
        turn: Int[Array, ""] = jnp.int32(0)
        if sampling == "ts1":
            turn = jax.random.randint(key_turn, (), 0, particles, jnp.int32) * (n // particles)
        rolled = jnp.roll(x, turn, axis=0)
        y = members(rolled.reshape(particles, n // particles, -1)).reshape(n, -1)
        y = jnp.roll(y, -turn, axis=0)
        if not aleatoric:
            return y
        if tail is None:
            error = jax.random.normal(key_noise, y.shape, y.dtype)
        else:
            error = jax.random.t(key_noise, jnp.broadcast_to(1 / tail[None], y.shape).astype(y.dtype), y.shape, y.dtype)
        scale = noise_scale[None].astype(y.dtype)
        return y + (scale if relative is None else scale * relative(x, y).astype(y.dtype)) * error

    return world_of(encoding, goal, follow, multiple=1 if sampling == "mean" else particles)


def beginning_at(
    world: World, encoding: Encoding, x: Float[Array, "m dx"], count: Int[Array, ""], share: float
) -> World:
    """Return a world in which a share of the episodes begins at measured inputs, the others as the task does.

    Args:
        world: as the task begins.
        encoding: coordinates.
        x: inputs in data units, of which the first `count` are measured.
        count: of them.
        share: of the episodes.
    """

    def reset(key: PRNGKeyArray, n: int) -> Situation:
        key_task, key_rows, key_share = jax.random.split(key, 3)
        fresh = world.reset(key_task, n)
        at = x[jax.random.randint(key_rows, (n,), 0, count, jnp.int32)].astype(fresh.encoded.dtype)
        known = world.memory == encoding.memory
        past = encoding.commands(at[:, encoding.dim_state :]) if known else fresh.past
        measured = jax.random.bernoulli(key_share, share, (n,)) & (count > 0)
        return Situation(
            jnp.where(measured[:, None], at[:, : encoding.dim_state], fresh.encoded),
            jnp.where(measured[:, None, None], past, fresh.past),
        )

    return world._replace(reset=reset) if share else world
