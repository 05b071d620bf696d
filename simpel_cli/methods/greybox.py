"""Grey box: the simulator is identified first, then networks learn what it leaves, under a Gaussian-process prior.

    y = g(x, phi_hat) + h~(x) + noise,    phi_hat: MAP (`sysid`),    h~: FSVGD

The residual is not shifted, and scaled by what its marginal likelihood says that the simulator leaves (`prior.scale`). The
parameters are not looked at again, so the spread of the posterior is that of the residual alone, but for groups that were never
seen: every particle has its own draw of the population for them.

Reference: Psichogios and Ungar (1992), A hybrid neural network - first principles approach to process modeling.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.inference.noise import NoiseModel, Numbers
from simpel_cli.inference.predictive import Predictive
from simpel_cli.inference.protocols import Inference, Info, Problem, Setting
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.methods.sysid import Identified, SysID, identified, simulator_of
from simpel_cli.priors.function_prior import GPPrior
from simpel_cli.priors.marginal_likelihood import (
    MOST_ROWS,
    best_scales,
    evenly,
    noise_of_smooth,
    weighted_spectra,
)
from simpel_cli.scores.gaussian import Gaussian


class State(NamedTuple):
    """What the first stage found, and the networks.

    Args:
        found: the identified simulator.
        simulated: what their simulator predicts of the training targets, data units.
        scale: of the residual, normalised.
        noise_floor: least noise, normalised.
        residual: state of the second stage.
    """

    found: Identified
    simulated: Float[Array, "m dy"]
    scale: Float[Array, " dy"]
    noise_floor: Float[Array, " dy"]
    residual: Any


@dataclass(frozen=True)
class GreyBox:
    """Identified simulator plus networks.

    Args:
        sysid: the first stage, which runs before the first step.
        residual: the second one.
        prior: of the residual; its scale in units of the targets' spread, or `auto`.
    """

    sysid: SysID = SysID()
    residual: FSVGD = FSVGD()
    prior: GPPrior = GPPrior()

    uses_score = False  # not a field: the score of a Gaussian process is known

    @property
    def steps(self) -> int:
        """Steps of the second stage."""
        return self.residual.steps

    @property
    def particles(self) -> int:
        """Number of networks."""
        return self.residual.particles

    @property
    def pool(self) -> int:
        """Points of the domain that a stretch of steps of the second stage chooses from."""
        return self.residual.pool

    @property
    def noise(self) -> NoiseModel:
        """Observation noise of the second stage, whose floor is that of its own prior, not of the simulator's."""
        return replace(self.residual.noise, marginal_share=0.0)

    def bind(self, setting: Setting, problem: Problem) -> Inference:
        """Return the rule for this problem (see `simpel_cli.inference.protocols.Inference`)."""
        _, run = simulator_of(setting)
        scale, dtype = problem.normaliser, problem.x.dtype
        # of a residual that is scaled to 1
        relative = 1.0 if isinstance(self.prior.scale, str) else self.prior.scale**2
        own_prior = replace(self.prior, white_variance=self.prior.white_variance / relative)
        bound = own_prior.bind(None, problem.x.shape[1], problem.y.shape[1], jnp.asarray(scale.x_std))
        own = Setting(bound, Gaussian(), setting.sample_inputs)
        ones, y_std = jnp.ones(problem.y.shape[1:], dtype), jnp.asarray(scale.y_std)
        # what is left has mean zero, not that of the targets
        frame = problem._replace(
            gap_scale=ones, gap_relevance=None, bank=None, normaliser=scale._replace(y_mean=0 * y_std)
        )

        def simulated(phi: Float[Array, " dp"], x: Float[Numbers, "n dx"]) -> Float[Array, "n dy"]:
            """Data units."""
            return jax.vmap(run, in_axes=(0, None))(jnp.asarray(x), phi)

        def left(predicted: Float[Array, "m dy"]) -> Float[Array, "m dy"]:
            """Normalised targets of the second stage."""
            return jnp.asarray(problem.y) - (predicted - scale.y_mean[None]) / scale.y_std[None]

        def likely(predicted: Float[Array, "m dy"]) -> tuple[Float[Array, " dy"], Float[Array, " dy"]]:
            """Scale and floor of the noise: what every method has (`NoiseModel.marginal_share`), under the residual's prior."""
            noise, kappa = self.residual.noise, None
            if not isinstance(self.prior.scale, str):
                kappa = self.prior.scale * ones
            floors = noise.learn and noise.marginal_share > 0 and len(problem.x) <= MOST_ROWS
            if kappa is not None and not floors:
                return kappa, jnp.asarray(problem.noise_floor)
            rows, m = evenly(len(problem.x), problem.m, MOST_ROWS)
            x, y = scale.x(jnp.asarray(problem.x)[rows]), left(predicted)[rows]
            init, floor = problem.noise_init, problem.noise_floor

            def correlation(longer: float) -> Float[Array, "m m"]:
                stretched = bound._replace(input_scale=jnp.asarray(bound.input_scale) / longer)
                return stretched.covariance(x, ones[:1])[0]

            prior_std = noise.prior_std if noise.learn else None
            weights = None if problem.weights is None else jnp.asarray(problem.weights)[rows]
            tells = None if problem.tells is None else jnp.asarray(problem.tells)[rows]
            spectra = weighted_spectra(correlation(1.0)[None], y, m, weights, tells)
            best = best_scales(spectra, kappa, 0.0, prior_std, floor, init)
            if not floors:
                return best.scale.astype(dtype), jnp.asarray(floor)
            sigma = jnp.maximum(
                best.noise, noise_of_smooth(correlation, y, m, 0.0, noise.prior_std, floor, init, weights, tells)
            )
            least = noise.raised(floor, noise.marginal_share * sigma.astype(dtype), init)
            return best.scale.astype(dtype), jnp.asarray(least)

        def second(state: State) -> Inference:
            own_units = frame._replace(
                y=left(state.simulated) / state.scale[None],
                normaliser=frame.normaliser._replace(y_std=y_std * state.scale),
                noise_init=problem.noise_init / state.scale,
                noise_floor=state.noise_floor / state.scale,
            )
            return self.residual.bind(own, own_units)

        def init(key: PRNGKeyArray) -> State:
            key_first, key_second = jax.random.split(key)
            found = identified(self.sysid, setting, problem, key_first, self.particles)
            predicted = simulated(found.phi, problem.x)
            first = State(found, predicted, *likely(predicted), None)
            return first._replace(residual=second(first).init(key_second))

        def draw(key: PRNGKeyArray, state: State) -> Any:
            return self.residual.bind(own, frame).draw(key, state.residual)

        def step(key: PRNGKeyArray, state: State, draws: Any) -> tuple[State, Info]:
            after, info = second(state).step(key, state.residual, draws)
            return state._replace(residual=after), info._replace(noise_std=info.noise_std * state.scale)

        def predict(state: State, x: Float[Array, "n dx"]) -> Predictive:
            rest = second(state).predict(state.residual, x)
            return rest._replace(particles=rest.particles + jax.vmap(simulated, in_axes=(0, None))(state.found.each, x))

        def members(state: State, x: Float[Array, "L n dx"]) -> Float[Array, "L n dy"]:
            rest = second(state).members(state.residual, x)
            phi = jnp.broadcast_to(state.found.each, (self.particles, *state.found.phi.shape))
            return rest + jax.vmap(simulated)(phi, x)

        return Inference(init, draw, step, predict, members)
