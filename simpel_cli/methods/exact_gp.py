"""Exact Gaussian process with the calibrated simulator as its mean: cheap, strong, and no network.

    y = g(x, phi_hat) + h~(x) + noise,    h~ ~ GP(0, kappa^2 rho(|x - x'|/l)) in closed form

kappa is that of the prior, chosen by marginal likelihood unless it is declared; the noise is the one that maximises the
marginal likelihood with it.

Reference: Rasmussen and Williams (2006), eqs. 2.25-2.26 and 5.8; Kennedy and O'Hagan (2001), Bayesian calibration of computer
models.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.errors import ConfigError
from simpel_cli.inference import student_t
from simpel_cli.inference.noise import NoiseModel, Numbers
from simpel_cli.inference.predictive import Predictive
from simpel_cli.inference.protocols import Inference, Info, Problem, Setting
from simpel_cli.methods.sysid import Identified, SysID, identified, simulator_of
from simpel_cli.priors.marginal_likelihood import Spectrum, best_scales, weighted_spectra


class State(NamedTuple):
    """Everything that the training data say: parameters, residuals, noise."""

    found: Identified
    data: Spectrum
    noise_std: Float[Array, " dy"]
    loss: Float[Array, ""]


@dataclass(frozen=True)
class ExactGP:
    """Gaussian process about an identified simulator.

    Args:
        sysid: how the simulator is calibrated.
        particles: of the mixture that stands for the Gaussian predictive, L: its quantiles; for a group that was never seen
            each has a draw of the population.
    """

    sysid: SysID = SysID()
    particles: int = 20

    steps = 1  # not a field: there is nothing to iterate
    uses_score = False  # nor to estimate

    def __post_init__(self) -> None:
        if self.particles < 2:
            raise ConfigError(f"method.particles: got {self.particles}; it must be at least 2.")

    @property
    def pool(self) -> int:
        """No points of the domain are looked at."""
        return self.sysid.pool

    @property
    def noise(self) -> NoiseModel:
        """Observation noise."""
        return self.sysid.noise

    def bind(self, setting: Setting, problem: Problem) -> Inference:
        """Return the rule for this problem (see `simpel_cli.inference.protocols.Inference`).

        Raises:
            ConfigError: the prior has no gap process.
        """
        prior, run = simulator_of(setting)
        if prior.kernel is None:
            raise ConfigError("method: gp needs the gap process of prior=simulator; prior=simulator_only has none.")
        scale, dtype = problem.normaliser, problem.x.dtype
        # noise with heavy tails holds the white model error, too (`priors.noise_law`)
        white = prior.white_variance if problem.tail is None else 0.0
        counts = (jnp.arange(problem.x.shape[0], dtype=jnp.int32) < problem.m).astype(jnp.float64)
        kappa = jnp.asarray(problem.gap_scale).astype(jnp.float64)
        weights = problem.weights
        if weights is None and problem.gap_relevance is not None:  # each output has a basis of its own
            weights = jnp.ones_like(problem.y)

        def simulated(phi: Float[Array, " dp"], x: Float[Numbers, "n dx"]) -> Float[Array, "n dy"]:
            return (jax.vmap(run, in_axes=(0, None))(jnp.asarray(x), phi) - scale.y_mean[None]) / scale.y_std[None]

        def correlation(x: Float[Numbers, "n dx"]) -> Float[Array, "d n m"]:
            at, known = (scale.x(a).astype(jnp.float64) for a in (x, problem.x))
            return prior.correlation(at, known, problem.gap_relevance)

        def init(key: PRNGKeyArray) -> State:
            found = identified(self.sysid, setting, problem, key, self.particles)
            left = jnp.asarray(problem.y) - simulated(found.phi, problem.x)
            among = correlation(problem.x)
            data = weighted_spectra(among, left, problem.m, weights, None, kappa, white)
            telling = data
            if problem.tells is not None:
                telling = weighted_spectra(among, left, problem.m, weights, problem.tells, kappa, white)
            prior_std = self.noise.prior_std if self.noise.learn else None
            # of rows that count by their weights both are in the spectra already
            scales, left_over = (kappa, white) if weights is None else (jnp.ones_like(kappa), 0.0)
            best = best_scales(telling, scales, left_over, prior_std, problem.noise_floor, problem.noise_init)
            return State(
                found,
                data,
                best.noise.astype(dtype),
                (jnp.sum(best.loss) / jnp.maximum(jnp.sum(counts), 1)).astype(dtype),
            )

        def step(key: PRNGKeyArray, state: State, draws: None) -> tuple[State, Info]:
            return state, Info(
                state.loss, student_t.standard_deviation(state.noise_std, problem.tails), jnp.zeros((), dtype)
            )

        def predicted(state: State, x: Float[Array, "n dx"]) -> tuple[Float[Array, "n dy"], Float[Array, "n dy"]]:
            """Mean and standard deviation of what the simulator leaves, normalised."""
            known, data = correlation(x) * counts[None, None], state.data
            if weights is None:  # one basis serves all outputs
                values, reach, turned, own = data.values, known[0] @ data.vectors, data.turned.T, None
            else:
                roots = jnp.sqrt(jnp.asarray(weights).astype(jnp.float64)).T
                reach = (known * roots[:, None]) @ data.vectors
                values, turned, own = data.values, data.turned[..., 0], 0

            def of_output(
                kappa: Float[Array, ""],
                sigma: Float[Array, ""],
                values: Float[Array, " m"],
                reach: Float[Array, "n m"],
                turned: Float[Array, " m"],
            ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
                known = kappa**2 * values + white if weights is None else values
                total = known + sigma.astype(jnp.float64) ** 2
                taken = kappa**4 * jnp.sum(reach**2 / total[None], axis=1)
                std = jnp.sqrt(jnp.maximum(kappa**2 - taken, 0.0) + white)
                return kappa**2 * (reach @ (turned / total)), std

            each = jax.vmap(of_output, in_axes=(0, 0, own, own, 0), out_axes=1)
            mean, std = each(kappa, state.noise_std, values, reach, turned)
            return mean.astype(dtype), std.astype(dtype)

        def quantiles() -> Float[Array, "L dy"]:
            """Standard normal quantiles of unit variance, in another order for every output, so that they are independent."""
            q = jax.scipy.special.ndtri((jnp.arange(self.particles, dtype=dtype) + 0.5) / self.particles)
            q = q / jnp.sqrt(jnp.mean(q**2))
            keys = jax.random.split(jax.random.key(0), problem.y.shape[1])
            return jnp.stack([jax.random.permutation(key, q) for key in keys], axis=1)

        def predict(state: State, x: Float[Array, "n dx"]) -> Predictive:
            mean, std = predicted(state, x)
            g = jax.vmap(simulated, in_axes=(0, None))(state.found.each, x)
            h = g + mean[None] + quantiles()[:, None] * std[None]
            return Predictive(scale.y_to_data(h), state.noise_std * scale.y_std, problem.tails)

        def members(state: State, x: Float[Array, "L n dx"]) -> Float[Array, "L n dy"]:
            def one(x: Float[Array, "n dx"], q: Float[Array, " dy"], phi: Float[Array, " dp"]) -> Float[Array, "n dy"]:
                mean, std = predicted(state, x)
                return simulated(phi, x) + mean + q[None] * std

            phi = jnp.broadcast_to(state.found.each, (self.particles, *state.found.phi.shape))
            return scale.y_to_data(jax.vmap(one)(x, quantiles(), phi))

        return Inference(init, lambda key, state: None, step, predict, members)
