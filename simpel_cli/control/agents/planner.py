"""A planner: at every step the commands of the next steps are searched for in the model; nothing is trained.

The cross-entropy method with noise that is correlated in time: samples about a mean, of which the best make the next mean; the
mean of the step before, shifted, is where the search begins, and some of its best samples are tried again.

Reference: Pinneri et al. (2020), Sample-efficient cross-entropy method for real-time planning (iCEM), algorithm 1; Timmer and
König (1995), On generating power law noise.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.control.agents.rollout import Controller, charged
from simpel_cli.control.world import World
from simpel_cli.errors import ConfigError, check_at_least_one


class Plan(NamedTuple):
    """What a planner remembers: actions of the next H steps, and the best sequences that it found."""

    mean: Float[Array, "B H du"]
    kept: Float[Array, "B K H du"]


@dataclass(frozen=True)
class ICEM:
    """The `planner:` group: the improved cross-entropy method.

    Args:
        ahead: steps that are planned.
        population: sequences per round, each of which is tried in every particle of a posterior.
        elites: best sequences, which make the next mean and spread.
        rounds: per step.
        colour: exponent of the noise's power over frequency; 0 is white, 2 Brownian.
        std: of the noise at the start of a step, of actions in [-1, 1].
        momentum: share of the old mean and spread in the new ones.
        keep: share of the elites that is tried again.
    """

    ahead: int = 30
    population: int = 32
    elites: int = 6
    rounds: int = 3
    colour: float = 2.0
    std: float = 0.5
    momentum: float = 0.1
    keep: float = 0.3

    def __post_init__(self) -> None:
        check_at_least_one("planner", self, ("ahead", "population", "elites", "rounds"))
        if self.elites > self.population:
            raise ConfigError(
                f"planner.elites: got {self.elites}; it is at most planner.population ({self.population})."
            )
        for name in ("momentum", "keep"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"planner.{name}: got {getattr(self, name)}; it must be at least 0 and below 1.")
        for name in ("colour", "std"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"planner.{name}: got {getattr(self, name)}; it must not be negative.")

    def bind(self, model: World, horizon: int, dim_u: int) -> Controller:
        """Return the controller that plans in a model.

        Args:
            model: that is planned in.
            horizon: of the task; no plan is longer.
            dim_u: actions.
        """
        ahead, number, particles = min(self.ahead, horizon), self.population, model.multiple
        again = int(self.keep * self.elites)

        def begin(episodes: int) -> Plan:
            of = lambda *shape: jnp.zeros((episodes, *shape, ahead, dim_u), jnp.float32)  # noqa: E731
            return Plan(of(), of(again))

        def worth(key: PRNGKeyArray, seen: Float[Array, " do"], actions: Float[Array, "P H du"]) -> Float[Array, " P"]:
            """Return what sequences of actions earn in the model."""
            # each in every particle: the best of sequences that had a particle each would be the luckiest
            situation = model.at(jnp.broadcast_to(seen[None], (number * particles, *seen.shape)))
            actions = jnp.tile(actions, (particles, 1, 1))

            def one(carry: tuple[Any, Array], given: tuple[PRNGKeyArray, Array]) -> tuple[Any, Any]:
                situation, alive = carry
                after = model.step(given[0], situation, given[1])
                reward = jnp.where(alive, after.judged.reward, 0.0)
                return (after.situation, alive & ~after.judged.over), (reward, after.broken & alive)

            steps = (jax.random.split(key, ahead), jnp.moveaxis(actions, 1, 0))
            reward, broken = jax.lax.scan(one, (situation, jnp.ones(number * particles, bool)), steps)[1]
            return jnp.mean(jnp.sum(charged(reward, broken), axis=0).reshape(particles, number), axis=0)

        def planned(key: PRNGKeyArray, seen: Float[Array, " do"], mean: Array, kept: Array) -> tuple[Plan, Array]:
            def turn(carry: tuple[Array, Array, Array], key: PRNGKeyArray) -> tuple[tuple[Array, Array, Array], None]:
                mean, std, kept = carry
                key_noise, key_worth = jax.random.split(key)
                noise = self.coloured(key_noise, (number, ahead, dim_u))
                tried = jnp.clip(mean[None] + std[None] * noise, -1.0, 1.0)
                tried = jnp.concatenate([mean[None], kept, tried])[:number]
                best = tried[jax.lax.top_k(worth(key_worth, seen, tried), self.elites)[1]]
                old, new = self.momentum, 1 - self.momentum
                mean = old * mean + new * jnp.mean(best, axis=0)
                return (mean, old * std + new * jnp.std(best, axis=0), best[:again]), None

            start = (mean, jnp.full_like(mean, self.std), kept)
            (mean, _, kept), _ = jax.lax.scan(turn, start, jax.random.split(key, self.rounds))
            shifted = lambda a: jnp.concatenate([a[..., 1:, :], a[..., -1:, :]], axis=-2)  # noqa: E731
            return Plan(shifted(mean), shifted(kept)), mean[0]

        def act(key: PRNGKeyArray, plan: Plan, seen: Float[Array, "B do"]) -> tuple[Plan, Float[Array, "B du"]]:
            return jax.vmap(planned)(jax.random.split(key, len(seen)), seen, plan.mean, plan.kept)

        return Controller(begin, act)

    def coloured(self, key: PRNGKeyArray, shape: tuple[int, int, int]) -> Float[Array, "P H du"]:
        """Return noise of unit variance whose power falls with frequency, along the second axis."""
        number, ahead, dim_u = shape
        if ahead < 2 or self.colour == 0:
            return jax.random.normal(key, shape, jnp.float32)
        frequency = jnp.fft.rfftfreq(ahead).astype(jnp.float32)
        size = jnp.maximum(frequency, 1 / ahead) ** (-self.colour / 2)
        parts = jax.random.normal(key, (2, number, len(frequency), dim_u), jnp.float32) * size[None, None, :, None]
        wave = jnp.fft.irfft(jax.lax.complex(parts[0], parts[1]), ahead, axis=1)
        # variance of the sum: the zero frequency, and that of Nyquist where there is one, have a real part only
        twice = jnp.full(len(frequency), 2.0, jnp.float32).at[0].set(1.0)
        twice = twice.at[-1].set(1.0) if ahead % 2 == 0 else twice
        return wave * (ahead / jnp.sqrt(jnp.sum((twice * size) ** 2)))
