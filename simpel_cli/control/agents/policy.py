"""Policies: a network from observations to actions in [-1, 1]."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.inference.networks import MLP, Layers

LOG_STD = (-5.0, 2.0)  # of the Gaussian before the tanh


class Policy(NamedTuple):
    """A tanh-Gaussian policy; deterministic, it takes the Gaussian's mean.

    Args:
        layers: of the network, which gives mean and log standard deviation.
        mean, std: of the observations, which the network sees normalised.
    """

    layers: Layers
    mean: Float[Array, " do"]
    std: Float[Array, " do"]


class Sampled(NamedTuple):
    """Actions in (-1, 1) and the log of their density."""

    action: Float[Array, "n du"]
    log_prob: Float[Array, " n"]


@dataclass(frozen=True)
class Actor:
    """A policy's architecture.

    Args:
        network: from normalised observations.
        dim_u: actions.
    """

    network: MLP
    dim_u: int

    def init(self, key: PRNGKeyArray, dim_o: int, dtype: jnp.dtype) -> Layers:
        """Draw the weights."""
        return self.network.init(key, dim_o, 2 * self.dim_u, dtype)

    def act(self, policy: Policy, seen: Float[Array, "n do"]) -> Float[Array, "n du"]:
        """Return deterministic actions at observations."""
        out = self.network.apply(policy.layers, (seen - policy.mean[None]) / policy.std[None])
        return jnp.tanh(out[:, : self.dim_u])

    def sample(self, layers: Layers, seen: Float[Array, "n do"], noise: Float[Array, "n du"]) -> Sampled:
        """Return actions at normalised observations.

        Args:
            layers: of the network.
            seen: normalised.
            noise: standard normal.

        Reference: Haarnoja et al. (2018), Soft actor-critic, appendix C.
        """
        out = self.network.apply(layers, seen)
        mean, raw = out[:, : self.dim_u], out[:, self.dim_u :]
        low, high = LOG_STD
        log_std = low + 0.5 * (high - low) * (jnp.tanh(raw) + 1)
        before = mean + jnp.exp(log_std) * noise
        # log(1 - tanh^2), without cancellation
        squashed = 2 * (jnp.log(2.0).astype(before.dtype) - before - jax.nn.softplus(-2 * before))
        gaussian = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi).astype(before.dtype)
        return Sampled(jnp.tanh(before), jnp.sum(gaussian - squashed, axis=1))
