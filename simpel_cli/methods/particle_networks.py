"""Networks that share a noise: how they begin, predict and take a step, whatever says where they should go."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.errors import ConfigError
from simpel_cli.inference import student_t
from simpel_cli.inference.networks import MLP, Particles
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.predictive import Predictive
from simpel_cli.inference.protocols import Problem


def refuse_rates(learning_rate: float, final: float) -> None:
    """Refuse what is no learning rate, or no fraction of it that is left at the last step.

    Raises:
        ConfigError: with what is allowed.
    """
    if not learning_rate > 0:
        raise ConfigError(f"method.learning_rate: got {learning_rate}; it must be positive.")
    if not 0 <= final <= 1:
        raise ConfigError(
            f"method.final_learning_rate: got {final}; it is the fraction that is left at the end: 0 to 1."
        )


class State(NamedTuple):
    """L networks, the noise parameter, and the optimiser's state of both."""

    particles: Particles
    noise: Float[Array, " dy"]
    optimiser: optax.OptState


class Networks(NamedTuple):
    """L networks on one problem.

    Args:
        number: of networks, L.
        network: architecture.
        noise: observation noise, shared by the networks.
        optimiser: of networks and noise.
        problem: what they learn.
    """

    number: int
    network: MLP
    noise: NoiseModel
    optimiser: optax.GradientTransformation
    problem: Problem

    def init(self, key: PRNGKeyArray) -> State:
        """Return independent networks and the noise's initial value."""
        problem = self.problem
        dims, dtype = (problem.x.shape[1], problem.y.shape[1]), jnp.asarray(problem.x).dtype
        particles = jax.vmap(lambda k: self.network.init(k, *dims, dtype))(jax.random.split(key, self.number))
        noise = self.noise.init(problem.noise_init, problem.noise_floor)
        return State(particles, noise, self.optimiser.init((particles, noise)))

    def noise_scale(self, rho: Float[Array, " dy"]) -> Float[Array, " dy"]:
        """Return sigma, normalised."""
        return self.noise.std(rho, self.problem.noise_floor)

    def noise_std(self, rho: Float[Array, " dy"]) -> Float[Array, " dy"]:
        """Return the standard deviation of the noise, normalised."""
        return student_t.standard_deviation(self.noise_scale(rho), self.problem.tails)

    def ascended(self, state: State, ascent: Particles, slope_noise: Float[Array, " dy"]) -> State:
        """Take a step.

        Args:
            state: before it.
            ascent: where the networks should go.
            slope_noise: slope of the log likelihood of all training rows in the noise parameter, summed over networks.
        """
        problem = self.problem
        # the noise is shared by the particles: its gradient is averaged over them
        prior = jax.grad(self.noise.log_prior)(state.noise, problem.noise_init, problem.noise_floor)
        ascent_noise = slope_noise / self.number + prior if self.noise.learn else 0 * state.noise
        descent = jax.tree.map(jnp.negative, (ascent, ascent_noise))
        with jax.numpy_dtype_promotion("standard"):  # optax mixes float and int32 in its bias correction
            updates, optimiser = self.optimiser.update(descent, state.optimiser, (state.particles, state.noise))
        particles = optax.apply_updates(state.particles, updates[0])
        return State(particles, state.noise + self.noise.rate * updates[1], optimiser)

    def predict(self, state: State, x: Float[Array, "n dx"]) -> Predictive:
        """Return the predictive at inputs in data units."""
        scale = self.problem.normaliser
        h = self.network.apply_all(state.particles, scale.x(x))
        return Predictive(scale.y_to_data(h), self.noise_scale(state.noise) * scale.y_std, self.problem.tails)

    def members(self, state: State, x: Float[Array, "L n dx"]) -> Float[Array, "L n dy"]:
        """Return the targets of every network at its own inputs, data units."""
        scale = self.problem.normaliser
        return scale.y_to_data(jax.vmap(self.network.apply)(state.particles, jax.vmap(scale.x)(x)))
