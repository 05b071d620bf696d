"""Stein variational gradient descent on the weights of networks, under independent Gaussian priors of weights and biases.

Reference: Liu and Wang (2016), Stein variational gradient descent, algorithm 1.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.errors import ConfigError, check_at_least_one
from simpel_cli.inference.networks import MLP, Particles
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Inference, Info, Problem, Setting
from simpel_cli.methods.fsvgd import refuse_bandwidth, stein_velocity
from simpel_cli.methods.function_space import at_least_one, distinct_rows, log_likelihood
from simpel_cli.methods.particle_networks import Networks, State, refuse_rates


@dataclass(frozen=True)
class SVGD:
    """SVGD with Adam; the prior is that of the weights, so nothing decays.

    Args:
        steps: number of steps.
        particles: number of networks, L.
        network: architecture.
        learning_rate: of Adam, at the start.
        final_learning_rate: fraction of it that is left at the last step, along a cosine.
        batch: training points per step, at most; drawn without replacement.
        weight_std: standard deviation of a weight under the prior.
        bias_std: of a bias.
        bandwidth: s of the kernel on all weights; or `median`.
        prior_weight: exponent of the prior; 1 is Bayes.
        noise: observation noise.
    """

    steps: int = 5000
    particles: int = 20
    network: MLP = MLP(activation="silu")
    learning_rate: float = 3e-3
    final_learning_rate: float = 0.03
    batch: int = 24
    weight_std: float = 0.5
    bias_std: float = 1.0
    bandwidth: float | str = "median"
    prior_weight: float = 1.0
    noise: NoiseModel = NoiseModel()

    pool = 1  # not a field: no points of the domain are looked at
    uses_score = False  # nor is a prior over functions

    def __post_init__(self) -> None:
        refuse_bandwidth(self.bandwidth)
        check_at_least_one("method", self, ("steps", "particles", "batch"))
        refuse_rates(self.learning_rate, self.final_learning_rate)
        for name in ("weight_std", "bias_std"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"method.{name}: got {getattr(self, name)}; it must be positive.")

    def bind(self, setting: Setting, problem: Problem) -> Inference:
        """Return the rule for this problem (see `simpel_cli.inference.protocols.Inference`)."""
        to_normalised = problem.normaliser
        dtype = problem.x.dtype
        n_rows = problem.x.shape[0]
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps, alpha=self.final_learning_rate)
        optimiser = optax.adam(rate)

        networks = Networks(self.particles, self.network, self.noise, optimiser, problem)

        def step(key: PRNGKeyArray, state: State, draws: None) -> tuple[State, Info]:
            batch, is_data = distinct_rows(key, min(self.batch, n_rows), jnp.asarray(problem.m))
            counted = is_data.astype(dtype)
            x, y = to_normalised.x(jnp.asarray(problem.x)[batch]), jnp.asarray(problem.y)[batch]
            weight = problem.m.astype(dtype) / at_least_one(counted)

            def fit(particles: Particles, rho: Float[Array, " dy"]) -> Float[Array, ""]:
                h, sigma = self.network.apply_all(particles, x), networks.noise_scale(rho)
                return log_likelihood(h, sigma, y, counted, problem.tails, problem.counted(batch))

            value, (slope, slope_noise) = jax.value_and_grad(fit, argnums=(0, 1))(state.particles, state.noise)
            prior = jax.grad(lambda p: self.log_prior(p))(state.particles)
            score = jax.tree.map(lambda a, b: weight * a + self.prior_weight * b, slope, prior)
            flat, unflatten = _flattened(state.particles)
            velocity, mean_kernel = stein_velocity(flat, _flattened(score)[0], self.bandwidth)
            after = networks.ascended(state, unflatten(velocity), weight * slope_noise)
            info = Info(-value / (at_least_one(counted) * self.particles), networks.noise_std(state.noise), mean_kernel)
            return after, info

        return Inference(networks.init, lambda key, state: None, step, networks.predict, networks.members)

    def log_prior(self, particles: Particles) -> Float[Array, ""]:
        """Return the sum over particles of the log density of their weights, up to a constant."""
        each = [
            jnp.sum(kernel**2) / self.weight_std**2 + jnp.sum(bias**2) / self.bias_std**2 for kernel, bias in particles
        ]
        return -0.5 * sum(each[1:], each[0])


def _flattened(particles: Particles) -> tuple[Float[Array, "L w"], jax.tree_util.Partial]:
    """Return the weights of every particle as a vector, and the way back."""
    leaves, structure = jax.tree.flatten(particles)
    shapes, sizes = [leaf.shape for leaf in leaves], [leaf[0].size for leaf in leaves]
    ends = [sum(sizes[: i + 1]) for i in range(len(sizes))][:-1]

    def back(flat: Float[Array, "L w"]) -> Particles:
        parts = jnp.split(flat, ends, axis=1)
        return jax.tree.unflatten(structure, [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)])

    return jnp.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in leaves], axis=1), jax.tree_util.Partial(back)
