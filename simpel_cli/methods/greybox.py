"""Grey box: the simulator is identified first, then networks learn what it leaves, under a Gaussian-process prior.

    y = g(x, phi_hat) + h~(x) + noise,    phi_hat: MAP (`sysid`),    h~: FSVGD

The residual is scaled by the targets' spread and not shifted. The parameters are not looked at again, so the spread of the
posterior is that of the residual alone.

Reference: Psichogios and Ungar (1992), A hybrid neural network - first principles approach to process modeling.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from simpel_cli.inference import Inference, Info, NoiseModel, Numbers, Problem, Setting
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.methods.likeliest_noise import likeliest, spectrum
from simpel_cli.methods.sysid import SysID, identified, simulator_of
from simpel_cli.predictive import Predictive
from simpel_cli.prior import GPPrior
from simpel_cli.scores.gaussian import Gaussian

MOST_ROWS = 512  # of which the marginal likelihood is taken


class State(NamedTuple):
    """Identified parameters, what their simulator predicts of the training targets, least noise, and the networks."""

    phi: Float[Array, " dp"]
    simulated: Float[Array, "m dy"]
    noise_floor: Float[Array, " dy"]
    residual: Any


@dataclass(frozen=True)
class GreyBox:
    """Identified simulator plus networks.

    Args:
        sysid: the first stage, which runs before the first step.
        residual: the second one.
        prior: of the residual, in units of the targets' spread.
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
        """Return the rule for this problem (see `simpel_cli.inference.Inference`)."""
        _, run = simulator_of(setting)
        scale, dtype = problem.normaliser, problem.x.dtype
        bound = self.prior.bind(None, problem.x.shape[1], problem.y.shape[1], jnp.asarray(scale.x_std))
        own = Setting(bound, Gaussian(), setting.sample_inputs)
        kappa = jnp.full(problem.y.shape[1:], self.prior.scale, dtype)
        # what is left has mean zero, not that of the targets
        unshifted = scale._replace(y_mean=jnp.zeros_like(jnp.asarray(scale.y_mean)))
        frame = problem._replace(gap_scale=kappa, bank=None, normaliser=unshifted)

        def simulated(phi: Float[Array, " dp"], x: Float[Numbers, "n dx"]) -> Float[Array, "n dy"]:
            """Data units."""
            return jax.vmap(run, in_axes=(0, None))(jnp.asarray(x), phi)

        def left(predicted: Float[Array, "m dy"]) -> Float[Array, "m dy"]:
            """Normalised targets of the second stage."""
            return jnp.asarray(problem.y) - (predicted - scale.y_mean[None]) / scale.y_std[None]

        def least_noise(predicted: Float[Array, "m dy"]) -> Float[Array, " dy"]:
            """The floor that every method has (`NoiseModel.marginal_share`), under the residual's prior."""
            noise, rows = self.residual.noise, problem.x.shape[0]
            if not (noise.learn and noise.marginal_share > 0 and rows <= MOST_ROWS):
                return jnp.asarray(problem.noise_floor)
            known = bound._replace(white_variance=0.0).covariance(scale.x(problem.x), jnp.ones((1,), dtype))[0]
            data = spectrum(known, left(predicted), problem.m)
            sigma, _ = likeliest(data, kappa, self.prior.white_variance, noise, problem.noise_floor, problem.noise_init)
            most = 0.99 * problem.noise_init
            return jnp.clip(noise.marginal_share * sigma.astype(dtype), problem.noise_floor, most)

        def second(predicted: Float[Array, "m dy"], noise_floor: Float[Array, " dy"]) -> Inference:
            return self.residual.bind(own, frame._replace(y=left(predicted), noise_floor=noise_floor))

        def init(key: PRNGKeyArray) -> State:
            key_first, key_second = jax.random.split(key)
            phi = identified(self.sysid, setting, problem, key_first)
            predicted = simulated(phi, problem.x)
            floor = least_noise(predicted)
            return State(phi, predicted, floor, second(predicted, floor).init(key_second))

        def draw(key: PRNGKeyArray) -> Any:
            return self.residual.bind(own, frame).draw(key)

        def step(key: PRNGKeyArray, state: State, draws: Any) -> tuple[State, Info]:
            after, info = second(state.simulated, state.noise_floor).step(key, state.residual, draws)
            return state._replace(residual=after), info

        def predict(state: State, x: Float[Array, "n dx"]) -> Predictive:
            rest = second(state.simulated, state.noise_floor).predict(state.residual, x)
            return rest._replace(particles=rest.particles + simulated(state.phi, x)[None])

        def members(state: State, x: Float[Array, "L n dx"]) -> Float[Array, "L n dy"]:
            rest = second(state.simulated, state.noise_floor).members(state.residual, x)
            return rest + jax.vmap(lambda x: simulated(state.phi, x))(x)

        return Inference(init, draw, step, predict, members)
