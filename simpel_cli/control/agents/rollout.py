"""Episodes of a controller in a world: what it earns, where it ends."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from simpel_cli.control.world import World


class Episodes(NamedTuple):
    """B episodes of T steps.

    Args:
        encoded: states, the initial one first.
        seen: observations that the policy acted on.
        action: in [-1, 1], clipped.
        reward: of every step; 0 after the end, and after the world could not go on what `charged` says.
        good: whether the state was where it should be.
        lived: steps that count.
        broken: whether the world could not go on.
    """

    encoded: Float[Array, "T1 B de"]
    seen: Float[Array, "T B do"]
    action: Float[Array, "T B du"]
    reward: Float[Array, "T B"]
    good: Bool[Array, "T B"]
    lived: Bool[Array, "T B"]
    broken: Bool[Array, " B"]

    @property
    def returns(self) -> Float[Array, " B"]:
        """Sum of the rewards."""
        return jnp.sum(self.reward, axis=0)

    def succeeded(self, settled: int) -> Bool[Array, " B"]:
        """Whether the state was where it should be in the last steps."""
        return jnp.all(self.good[-settled:] & self.lived[-settled:], axis=0)


class Controller(NamedTuple):
    """What acts on observations, and may remember.

    Args:
        begin: number of episodes -> what it remembers at their beginning.
        act: (key, what it remembers, observations) -> what it then remembers, and actions.
    """

    begin: Callable[[int], Any]
    act: Callable[[PRNGKeyArray, Any, Float[Array, "B do"]], tuple[Any, Float[Array, "B du"]]]


def reflex(act: Callable[[Float[Array, "B do"]], Float[Array, "B du"]]) -> Controller:
    """Return the controller that remembers nothing."""
    return Controller(lambda number: (), lambda key, memory, seen: (memory, act(seen)))


def episodes(world: World, controller: Controller, key: PRNGKeyArray, number: int, horizon: int) -> Episodes:
    """Run B episodes; traceable. An episode that ended stays where it is and earns nothing."""
    key_reset, key_steps = jax.random.split(key)
    first = world.reset(key_reset, number)

    def one(carry: Any, key: PRNGKeyArray) -> Any:
        situation, alive, memory = carry
        key_see, key_step, key_act = jax.random.split(key, 3)
        seen = world.observe(key_see, situation)
        memory, chosen = controller.act(key_act, memory, seen)
        action = jnp.clip(chosen, -1.0, 1.0)
        after = world.step(key_step, situation, action)
        reward = jnp.where(alive, after.judged.reward, 0.0)
        kept = jax.tree.map(
            lambda a, b: jnp.where(alive.reshape(number, *[1] * (a.ndim - 1)), a, b), after.situation, situation
        )
        row = (kept.encoded, seen, action, reward, after.judged.good & alive, alive, after.broken & alive)
        return (kept, alive & ~after.judged.over, memory), row

    start = (first, jnp.ones(number, bool), controller.begin(number))
    _, (encoded, *rest) = jax.lax.scan(one, start, jax.random.split(key_steps, horizon))
    seen, action, reward, good, lived, broken = rest
    states = jnp.concatenate([first.encoded[None], encoded])
    return Episodes(states, seen, action, charged(reward, broken), good, lived, jnp.any(broken, axis=0))


def charged(reward: Float[Array, "T B"], broken: Bool[Array, "T B"]) -> Float[Array, "T B"]:
    """Return rewards of which those from a step on that the world could not take are the least of all, or 0 if that is less.

    Where rewards are negative, nothing would pay as well as driving a model to where it has no answer.
    """
    least = jax.lax.stop_gradient(jnp.minimum(jnp.min(reward), 0.0))
    return jnp.where(jnp.cumsum(broken, axis=0) > 0, least, reward)
