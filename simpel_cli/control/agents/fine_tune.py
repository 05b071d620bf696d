"""Fine-tuning of a policy by the gradient of its return through the world: an analytic policy gradient.

It climbs whatever the world says, a model's errors too.

Reference: Deisenroth and Rasmussen (2011), PILCO (policies improved by gradients through a learned model); Clavera, Fu and
Abbeel (2020), Model-augmented actor-critic (by backpropagation through time).
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.control.agents.policy import Actor, Policy
from simpel_cli.control.agents.rollout import episodes, reflex
from simpel_cli.control.world import Situation, Step, World
from simpel_cli.inference.networks import Layers

Carry = tuple[Layers, Any, Float[Array, ""], Layers]  # layers, optimiser, least loss so far and its layers
CLIP = 1.0  # of the gradient's norm: through a contact or a spin it is of any size
BATCH = 64  # episodes per step


def fine_tuned(
    world: World, actor: Actor, policy: Policy, key: PRNGKeyArray, horizon: int, steps: int, rate: float, reach: float
) -> tuple[Policy, Float[Array, " steps"]]:
    """Improve a policy by gradient ascent on the mean return; traceable.

    Args:
        world: that the policy acts in; every step has episodes of its own.
        actor: the policy's architecture.
        policy: to begin with; its normaliser stays.
        key: of the episodes.
        horizon: steps of an episode.
        steps: of the ascent.
        rate: of Adam at the start, along a cosine.
        reach: steps within which what an action leads to fades from the gradient, by a factor of e.

    Returns:
        The policy of the step whose episodes earned the most, and the mean return of every step's episodes: through a model
        that is wild somewhere, the ascent may fall off.
    """
    number = -(-BATCH // world.multiple) * world.multiple
    optimiser = optax.chain(
        optax.stateless(finite), optax.clip_by_global_norm(CLIP), optax.adam(optax.cosine_decay_schedule(rate, steps))
    )

    faded = fading(world, reach)

    def loss(layers: Layers, key: PRNGKeyArray) -> Float[Array, ""]:
        own = policy._replace(layers=layers)
        return -jnp.mean(episodes(faded, reflex(lambda seen: actor.act(own, seen)), key, number, horizon).returns)

    def step(carry: Carry, key: PRNGKeyArray) -> tuple[Carry, Float[Array, ""]]:
        layers, state, least, best = carry
        value, slope = jax.value_and_grad(loss)(layers, key)
        best = jax.tree.map(lambda old, new: jnp.where(value < least, new, old), best, layers)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes float and int32 in its bias correction
            change, state = optimiser.update(slope, state, layers)
        return (optax.apply_updates(layers, change), state, jnp.fmin(value, least), best), -value

    with jax.numpy_dtype_promotion("standard"):
        begun = optimiser.init(policy.layers)
    start = (policy.layers, begun, jnp.full((), jnp.inf, policy.mean.dtype), policy.layers)
    (_, _, _, best), returns = jax.lax.scan(step, start, jax.random.split(key, steps))
    return policy._replace(layers=best), returns


def finite(slope: Any, params: Any = None) -> Any:
    """Return a gradient without what is not finite: one such step would be the last that Adam takes."""
    return jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), a, jnp.zeros_like(a)), slope)


def fading(world: World, reach: float) -> World:
    """Return the same world, of which a gradient sees less and less the further back it goes.

    Through two hundred steps of networks the gradient of a return is of any size, 1e5 as well as 10, and points anywhere: the
    further, the more. What is lost is what only a long chain of steps would tell.
    """
    kept = math.exp(-1.0 / reach)

    def fade(a: Array) -> Array:
        return kept * a + (1.0 - kept) * jax.lax.stop_gradient(a) if jnp.issubdtype(a.dtype, jnp.floating) else a

    def step(key: PRNGKeyArray, situation: Situation, action: Float[Array, "B du"]) -> Step:
        after = world.step(key, situation, action)
        return after._replace(situation=jax.tree.map(fade, after.situation))

    return world._replace(step=step)
