"""Multilayer perceptrons, written for one particle and one input; vmap at the boundary."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.errors import ConfigError

# sizes differ from layer to layer, hence `=_`: names for the reader, not to be held equal
Layers = tuple[tuple[Float[Array, "fan_in=_ fan_out=_"], Float[Array, "fan_out=_"]], ...]
Particles = tuple[tuple[Float[Array, "L fan_in=_ fan_out=_"], Float[Array, "L fan_out=_"]], ...]

SLOPE = 0.01
ACTIVATIONS: dict[str, Callable[[Array, float], Array]] = {  # of a layer's sums, and the slope below zero
    "leaky_relu": jax.nn.leaky_relu,
    "silu": lambda x, _: jax.nn.silu(x),
    "tanh": lambda x, _: jnp.tanh(x),
}


@dataclass(frozen=True)
class MLP:
    """Fully connected network.

    Hidden kernels are He-uniform, hidden biases U(+-1/sqrt(fan_in)), the output kernel LeCun-normal, the output bias 0.

    Args:
        hidden: widths of the hidden layers.
        negative_slope: slope of the leaky ReLU below zero; the others have none to choose.
        activation: leaky_relu, silu or tanh. silu is x/(1 + exp(-x)): smooth, as what a simulator computes mostly is.
    """

    hidden: tuple[int, ...] = (64, 64, 64)
    negative_slope: float = SLOPE
    activation: str = "leaky_relu"

    def __post_init__(self) -> None:
        if not all(width >= 1 for width in self.hidden):
            raise ConfigError(f"method.network.hidden: got {list(self.hidden)}; every width must be at least 1.")
        if self.activation not in ACTIVATIONS:
            allowed = ", ".join(ACTIVATIONS)
            raise ConfigError(f"method.network.activation: got {self.activation!r}; allowed are {allowed}.")
        if self.activation != "leaky_relu" and self.negative_slope != SLOPE:
            raise ConfigError(
                f"method.network.negative_slope: got {self.negative_slope}; {self.activation} has no slope to choose. Use it "
                "with method.network.activation=leaky_relu."
            )

    def init(self, key: PRNGKeyArray, dim_in: int, dim_out: int, dtype: jnp.dtype) -> Layers:
        """Draw the weights of one network.

        Reference: He et al. (2015) for the hidden kernels, LeCun et al. (1998) for the output kernel.
        """
        sizes = (dim_in, *self.hidden, dim_out)
        keys = jax.random.split(key, 2 * (len(sizes) - 1))
        layers = []
        for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            if i < len(self.hidden):
                bound = (6.0 / fan_in) ** 0.5
                kernel = jax.random.uniform(keys[2 * i], (fan_in, fan_out), dtype, -bound, bound)
                bias_bound = fan_in**-0.5
                bias = jax.random.uniform(keys[2 * i + 1], (fan_out,), dtype, -bias_bound, bias_bound)
            else:
                kernel = jax.random.normal(keys[2 * i], (fan_in, fan_out), dtype) * fan_in**-0.5
                bias = jnp.zeros((fan_out,), dtype)
            layers.append((kernel, bias))
        return tuple(layers)

    def apply(self, layers: Layers, x: Float[Array, "n dx"]) -> Float[Array, "n dy"]:
        """Evaluate one network at n inputs."""
        activation = ACTIVATIONS[self.activation]
        for kernel, bias in layers[:-1]:
            x = activation(x @ kernel + bias[None], self.negative_slope)
        kernel, bias = layers[-1]
        return x @ kernel + bias[None]

    def apply_all(self, particles: Particles, x: Float[Array, "n dx"]) -> Float[Array, "L n dy"]:
        """Evaluate L networks (leaves with a leading axis L) at the same n inputs."""
        return jax.vmap(self.apply, in_axes=(0, None))(particles, x)
