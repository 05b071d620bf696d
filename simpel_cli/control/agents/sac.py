"""Soft actor-critic: whole training, roll-outs, replay and updates, in one compiled scan.

    J_Q = E (Q_i(s, a) - r - gamma alive (min_j Q'_j(s', a') - alpha log pi(a'|s')))^2
    J_pi = E [alpha log pi(a|s) - min_j Q_j(s, a)],    J_alpha = -E alpha (log pi(a|s) + target)

Reference: Haarnoja et al. (2018), Soft actor-critic algorithms and applications, eqs. 5-7, 17; twin critics after Fujimoto et
al. (2018).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PRNGKeyArray

from simpel_cli.control.agents import replay as memory
from simpel_cli.control.agents.policy import Actor, Policy
from simpel_cli.control.agents.replay import Replay, Transitions
from simpel_cli.control.world import Situation, World
from simpel_cli.errors import ConfigError, check_at_least_one
from simpel_cli.inference.networks import MLP

FLOAT32 = jnp.dtype("float32")
LEAST_STD = 1e-3  # of an observation, in its unit: what never changes tells nothing


class Scaler(NamedTuple):
    """Running moments of the observations."""

    number: Float[Array, ""]
    mean: Float[Array, " do"]
    square: Float[Array, " do"]

    def add(self, seen: Float[Array, "n do"]) -> "Scaler":
        """Return the moments with more observations (Chan et al. 1983)."""
        n = len(seen)
        total = self.number + n
        mean = jnp.mean(seen, axis=0)
        off = mean - self.mean
        square = self.square + jnp.sum((seen - mean[None]) ** 2, axis=0) + off**2 * (self.number * n / total)
        return Scaler(total, self.mean + off * (n / total), square)

    @property
    def std(self) -> Float[Array, " do"]:
        """Standard deviation."""
        return jnp.maximum(jnp.sqrt(self.square / self.number), LEAST_STD)


class Weights(NamedTuple):
    """What is learned, each as one vector: one fused update in place of dozens of small ones."""

    actor: Float[Array, " a"]
    critics: Float[Array, " c"]
    log_temperature: Float[Array, ""]


class State(NamedTuple):
    """Of a training."""

    weights: Weights
    targets: Float[Array, " c"]
    optimiser: optax.OptState
    replay: Replay
    scaler: Scaler
    situation: Situation
    age: Int[Array, " B"]
    seen: Float[Array, "B do"]


class Info(NamedTuple):
    """What an iteration reports: means over its updates and steps."""

    reward: Float[Array, ""]
    critic_loss: Float[Array, ""]
    log_prob: Float[Array, ""]
    temperature: Float[Array, ""]
    broken: Float[Array, ""]


class Rule(NamedTuple):
    """The training on one world, as `simpel_cli.inference.loop` runs it, and the policy of a state."""

    init: Callable[[PRNGKeyArray], State]
    draw: Callable[[PRNGKeyArray, State], None]
    step: Callable[[PRNGKeyArray, State, None], tuple[State, Info]]
    policy: Callable[[State], Policy]
    values: Callable[
        [State, Float[Array, "b do"], Float[Array, "b du"]], Float[Array, "2 b"]
    ]  # of normalised observations
    actor: Actor


@dataclass(frozen=True)
class SAC:
    """The `policy:` group, learned by soft actor-critic.

    Args:
        steps: of the world, over all environments.
        environments: episodes side by side; rounded up where a posterior's particles share them.
        collect: steps of every environment between two rounds of updates.
        updates: per step of the world.
        batch: transitions per update.
        hidden: widths of policy and critics.
        learning_rate: of Adam, at the start.
        final_learning_rate: fraction of it that is left at the last step, along a cosine.
        clip: largest norm of a gradient; null: none.
        discount: per step.
        polyak: share of the critics that goes into their targets at every update.
        target_entropy: of the policy, nats.
        temperature: at the start.
        reward_scale: factor of the reward.
        episode: steps after which an environment starts anew; null: the task's horizon.
        capacity: transitions that are remembered.
        policies: trained side by side, of which the best in the model is kept: seeds fall into local optima.
        looks: evaluations of every policy, the best of which is kept.
    """

    steps: int = 500_000
    environments: int = 128
    collect: int = 16
    updates: float = 0.25
    batch: int = 64
    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 1e-3
    final_learning_rate: float = 0.1
    clip: float | None = None
    discount: float = 0.99
    polyak: float = 0.005
    target_entropy: float = -1.0
    temperature: float = 1.0
    reward_scale: float = 1.0
    episode: int | None = None
    capacity: int = 50_000
    policies: int = 3
    looks: int = 20

    def __post_init__(self) -> None:
        check_at_least_one(
            "policy", self, ("steps", "environments", "collect", "batch", "capacity", "policies", "looks")
        )
        for name in ("updates", "learning_rate", "temperature", "reward_scale"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"policy.{name}: got {getattr(self, name)}; it must be positive.")
        for name in ("discount", "polyak"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"policy.{name}: got {getattr(self, name)}; it must be above 0 and at most 1.")
        if not 0 <= self.final_learning_rate <= 1:
            raise ConfigError(f"policy.final_learning_rate: got {self.final_learning_rate}; allowed are 0 to 1.")
        if not math.isfinite(self.target_entropy):
            raise ConfigError(f"policy.target_entropy: got {self.target_entropy}; it must be a finite number.")
        if self.clip is not None and not self.clip > 0:
            raise ConfigError(f"policy.clip: got {self.clip}; it must be positive, or null.")
        if self.episode is not None and self.episode < 1:
            raise ConfigError(f"policy.episode: got {self.episode}; it must be at least 1, or null.")

    def side_by_side(self, multiple: int) -> int:
        """Return the number of environments, a multiple of a world's."""
        return -(-self.environments // multiple) * multiple

    def iterations(self, multiple: int) -> int:
        """Return the number of iterations that make up `steps`, at least one."""
        return max(1, round(self.steps / (self.side_by_side(multiple) * self.collect)))

    def begun_with(self, fresh: State, last: State) -> State:
        """Return the beginning of a training that goes on with what another one learned, with an empty memory.

        Args:
            fresh: a beginning.
            last: the end of a training of the same shape.
        """
        return fresh._replace(weights=last.weights, targets=last.targets, scaler=last.scaler)

    def bind(self, world: World, horizon: int, dim_u: int, dtype: jnp.dtype = FLOAT32) -> Rule:
        """Return the training on a world; called while tracing.

        Args:
            world: that the policy acts in.
            horizon: of the task.
            dim_u: actions.
            dtype: of everything that is learned.
        """
        network = MLP(self.hidden, negative_slope=0.0)
        actor = Actor(network, dim_u)
        n, length = self.side_by_side(world.multiple), self.episode or horizon
        new, lasting = n * self.collect, 1 / (1 - self.discount) if self.discount < 1 else length
        rounds = max(1, round(self.updates * new))
        capacity = max(1, self.capacity // new) * new
        total = self.iterations(world.multiple) * rounds
        adam = optax.adam(optax.cosine_decay_schedule(self.learning_rate, total, alpha=self.final_learning_rate))
        optimiser = adam if self.clip is None else optax.chain(optax.clip_by_global_norm(self.clip), adam)
        dim_o = jax.eval_shape(
            lambda key: world.observe(key, world.reset(key, n)), jax.eval_shape(lambda: jax.random.key(0))
        ).shape[1]

        def weights_of(key: PRNGKeyArray) -> tuple[Any, Any]:
            key_actor, *keys = jax.random.split(key, 3)
            twins = jax.vmap(lambda k: network.init(k, dim_o + dim_u, 1, dtype))(jnp.stack(keys))
            return actor.init(key_actor, dim_o, dtype), twins

        shapes = jax.eval_shape(weights_of, jax.eval_shape(lambda: jax.random.key(0)))
        to_actor, to_critics = (
            ravel_pytree(jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape))[1] for shape in shapes
        )

        def values(critics: Float[Array, " c"], x: Float[Array, "b d"]) -> Float[Array, "2 b"]:
            return network.apply_all(to_critics(critics), x)[:, :, 0]

        def init(key: PRNGKeyArray) -> State:
            key_weights, key_reset, key_seen = jax.random.split(key, 3)
            layers, twins = weights_of(key_weights)
            flat, critics = ravel_pytree(layers)[0], ravel_pytree(twins)[0]
            weights = Weights(flat, critics, jnp.log(jnp.asarray(self.temperature, dtype)))
            situation = world.reset(key_reset, n)
            seen = world.observe(key_seen, situation).astype(dtype)
            scaler = Scaler(jnp.zeros((), dtype), jnp.zeros(dim_o, dtype), jnp.zeros(dim_o, dtype)).add(seen)
            # episodes begin at different ages: what is remembered is then never of one age
            age = jnp.arange(n, dtype=jnp.int32) * length // n
            with jax.numpy_dtype_promotion("standard"):
                begun = optimiser.init(weights)
            return State(
                weights, critics, begun, memory.empty(capacity, dim_o, dim_u, dtype), scaler, situation, age, seen
            )

        def collected(key: PRNGKeyArray, state: State) -> tuple[Any, Transitions, Float[Array, ""]]:
            layers, mean, std = to_actor(state.weights.actor), state.scaler.mean, state.scaler.std

            def one(carry: tuple[Situation, Array, Array], key: PRNGKeyArray) -> tuple[Any, Any]:
                situation, age, seen = carry
                key_act, key_step, key_see, key_new, key_begin = jax.random.split(key, 5)
                noise = jax.random.normal(key_act, (n, dim_u), dtype)
                action = actor.sample(layers, (seen - mean[None]) / std[None], noise).action
                after = world.step(key_step, situation, action)
                then = world.observe(key_see, after.situation).astype(dtype)
                over = after.judged.over
                row = Transitions(seen, action, after.judged.reward.astype(dtype), then, 1 - over.astype(dtype))
                fresh = world.reset(key_new, n)
                anew = over | (age + 1 >= length)
                following = jax.tree.map(
                    lambda a, b: jnp.where(anew.reshape(n, *[1] * (a.ndim - 1)), a, b), fresh, after.situation
                )
                begun = world.observe(key_begin, fresh).astype(dtype)
                carry = (following, jnp.where(anew, 0, age + 1), jnp.where(anew[:, None], begun, then))
                return carry, (row, after.broken)

            carry, (rows, broken) = jax.lax.scan(
                one, (state.situation, state.age, state.seen), jax.random.split(key, self.collect)
            )
            # a step that the world could not take costs what the least reward costs for ever (see `charged`)
            least = jnp.minimum(jnp.min(rows.reward), 0.0) * lasting
            rows = rows._replace(reward=jnp.where(broken, least, rows.reward))
            rows = jax.tree.map(lambda a: a.reshape(new, *a.shape[2:]), rows)
            return carry, rows, jnp.mean(broken.astype(dtype))

        def loss(
            weights: Weights, targets: Float[Array, " c"], batch: Transitions, noise: Float[Array, "2 b du"]
        ) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Float[Array, ""]]]:
            layers, fixed = to_actor(weights.actor), jax.lax.stop_gradient(weights)
            temperature = jnp.exp(fixed.log_temperature)
            follows = actor.sample(to_actor(fixed.actor), batch.then, noise[0])
            beyond = jnp.min(values(targets, jnp.concatenate([batch.then, follows.action], 1)), axis=0)
            backup = batch.reward + self.discount * batch.alive * (beyond - temperature * follows.log_prob)
            now = values(weights.critics, jnp.concatenate([batch.seen, batch.action], 1))
            critic = 0.5 * jnp.mean(jnp.sum((now - jax.lax.stop_gradient(backup)[None]) ** 2, axis=0))
            mine = actor.sample(layers, batch.seen, noise[1])
            worth = jnp.min(values(fixed.critics, jnp.concatenate([batch.seen, mine.action], 1)), axis=0)
            policy = jnp.mean(temperature * mine.log_prob - worth)
            missing = jax.lax.stop_gradient(jnp.mean(mine.log_prob)) + self.target_entropy
            return critic + policy - jnp.exp(weights.log_temperature) * missing, (critic, jnp.mean(mine.log_prob))

        def step(key: PRNGKeyArray, state: State, drawn: None) -> tuple[State, Info]:
            key_collect, key_batch, key_noise = jax.random.split(key, 3)
            (situation, age, seen), rows, broken = collected(key_collect, state)
            scaler, replay = state.scaler.add(rows.seen), memory.put(state.replay, rows)
            found = memory.batches(key_batch, replay, rounds, self.batch)
            shift, scale = scaler.mean[None, None], scaler.std[None, None]
            found = found._replace(
                seen=(found.seen - shift) / scale, then=(found.then - shift) / scale,
                reward=found.reward * self.reward_scale,
            )  # fmt: skip
            noise = jax.random.normal(key_noise, (rounds, 2, self.batch, dim_u), dtype)

            def update(carry: tuple[Weights, Array, Any], given: tuple[Transitions, Array]) -> tuple[Any, Any]:
                weights, targets, inner = carry
                slope, reported = jax.grad(loss, has_aux=True)(weights, targets, *given)
                with jax.numpy_dtype_promotion("standard"):  # optax mixes float and int32 in its bias correction
                    change, inner = optimiser.update(slope, inner, weights)
                weights = optax.apply_updates(weights, change)
                targets = targets + self.polyak * (weights.critics - targets)
                return (weights, targets, inner), reported

            carry, reported = jax.lax.scan(update, (state.weights, state.targets, state.optimiser), (found, noise))
            weights, targets, inner = carry
            info = Info(
                jnp.mean(rows.reward),
                jnp.mean(reported[0]),
                jnp.mean(reported[1]),
                jnp.exp(weights.log_temperature),
                broken,
            )
            return State(weights, targets, inner, replay, scaler, situation, age, seen), info

        def policy(state: State) -> Policy:
            return Policy(to_actor(state.weights.actor), state.scaler.mean, state.scaler.std)

        def worth(state: State, seen: Float[Array, "b do"], action: Float[Array, "b du"]) -> Float[Array, "2 b"]:
            return values(state.weights.critics, jnp.concatenate([seen, action], 1))

        return Rule(init, lambda key, state: None, step, policy, worth, actor)
