"""System identification: the parameters of the simulator, most probable under their prior, with Laplace intervals.

    f(u, rho) = 1/2 sum_jk (y_jk - g_k(x_j, phi(u)))^2 / sigma_k^2 + m sum_k log sigma_k - log p(u) - log p(rho)

by damped Fisher scoring from several draws of the prior, within the bounds of uniform priors. Effects that the simulator
lacks stay absent: what is left is noise to it. Spreads of groups have no such optimum; they are those of the largest evidence
(`simpel_cli.methods.populations`).

Reference: Levenberg (1944), Marquardt (1963); MacKay (1992), A practical Bayesian framework for backpropagation networks,
sec. 2 (the Gaussian about the optimum).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from simpel_cli.dynamics.transition import OneStep
from simpel_cli.errors import ConfigError, check_at_least_one
from simpel_cli.inference import student_t
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.predictive import Predictive
from simpel_cli.inference.protocols import Inference, Info, Problem, Setting
from simpel_cli.methods.populations import Populations, Told
from simpel_cli.priors.function_prior import WIDE, FunctionPrior

FIRST_DAMPING, MOST_DAMPING = 1e-2, 1e8
HOPELESS = 1e6  # damping at which a refused step was as good as none
EASIER, HARDER = 0.3, 5.0  # what the damping is multiplied by
SMALL, PATIENCE = 1e-6, 4  # a start has ended where its loss falls by less than so much of itself, so many times on end
FAR = 6.0  # standard deviations of a normal prior that a parameter may go


class State(NamedTuple):
    """Every start of the search: unit coordinates, noise, damping, the loss there, and steps on end that gained nothing.

    Where parameters differ from group to group: what the data tell of the groups. None: there are no groups.
    """

    u: Float[Array, "S dp"]
    rho: Float[Array, "S dy"]
    damping: Float[Array, " S"]
    loss: Float[Array, " S"]
    idle: Float[Array, " S"]
    told: Told | None = None

    @property
    def best(self) -> Int[Array, ""]:
        """The start that counts."""
        return jnp.argmin(self.loss if self.told is None else self.loss + self.told.paid)


class Identified(NamedTuple):
    """The simulator that was found, in physical units.

    Args:
        phi: most probable parameters, (dp,).
        particles: the same for every particle, but groups that were never seen, which are drawn from the population; None:
            there are no groups.
    """

    phi: Float[Array, " dp"]
    particles: Float[Array, "L dp"] | None

    @property
    def each(self) -> Float[Array, "P dp"]:
        """Parameters of every particle, of all of them where they are alike."""
        return self.phi[None] if self.particles is None else self.particles


@dataclass(frozen=True)
class SysID:
    """Maximum a posteriori simulator with Laplace intervals.

    Args:
        steps: of the search; each is one simulation of the training data and its derivatives per start.
        starts: beginnings, draws of the prior; the best end counts.
        particles: draws of the Gaussian about the optimum that a prediction is a mixture of, L.
        noise: observation noise.
    """

    steps: int = 200
    starts: int = 8
    particles: int = 20
    noise: NoiseModel = NoiseModel()

    pool = 1  # not a field: no points of the domain are looked at
    uses_score = False  # nor is the prior over functions, but for its parameters

    def __post_init__(self) -> None:
        check_at_least_one("method", self, ("steps", "starts", "particles"))

    def bind(self, setting: Setting, problem: Problem) -> Inference:
        """Return the rule for this problem (see `simpel_cli.inference.protocols.Inference`).

        Raises:
            ConfigError: there is no simulator in symbols to identify.
        """
        prior, run = simulator_of(setting)
        if not prior.params:
            raise ConfigError(
                "method: sysid has nothing to identify; give a parameter of the simulator a range (sim.parameters.X.range)."
            )
        scale, dtype = problem.normaliser, problem.x.dtype
        dim_u, dim_y, n_rows = len(prior.params), problem.y.shape[1], problem.x.shape[0]
        low, high = (jnp.asarray(side, dtype) for side in bounds(prior))
        gaussian = jnp.asarray([q.prior != "uniform" for q in prior.params], bool)
        populations = Populations(prior.params)
        counts = (jnp.arange(n_rows, dtype=jnp.int32) < problem.m).astype(dtype)[:, None]

        def simulated(u: Float[Array, " dp"], x: Float[Array, "n dx"]) -> Float[Array, "n dy"]:
            phi = physical(prior, u)
            y = prior.a_few_at_a_time(lambda row: run(row, phi), x, copies=1 + dim_u)  # the value and its derivatives
            return (y - scale.y_mean[None]) / scale.y_std[None]

        def sigma(rho: Float[Array, " dy"]) -> Float[Array, " dy"]:
            return self.noise.std(rho, problem.noise_floor)

        def judged(f: Float[Array, "n dy"], u: Float[Array, " dp"], rho: Float[Array, " dy"]) -> Float[Array, ""]:
            """Return the loss of simulated targets f."""

            def law(z: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
                return 0.5 * z**2 if problem.tails is None else -student_t.log_density(z, problem.tails[None])

            e, rows = jnp.asarray(problem.y) - f, problem.counted()
            if rows is None:
                misfit = law(e / sigma(rho)[None]) + jnp.log(sigma(rho))[None]
            else:
                misfit = rows.misfit(e, sigma(rho), law)
            data = jnp.sum(counts * misfit)
            learned = self.noise.log_prior(rho, problem.noise_init, problem.noise_floor) if self.noise.learn else 0.0
            return data + 0.5 * jnp.sum(jnp.where(gaussian, u**2, 0.0)) - learned

        def loss(u: Float[Array, " dp"], rho: Float[Array, " dy"]) -> Float[Array, ""]:
            return judged(simulated(u, jnp.asarray(problem.x)), u, rho)

        def linearised(u: Float[Array, " dp"]) -> tuple[Float[Array, "n dy"], Float[Array, "n dy dp"]]:
            """Return simulated targets and their derivatives: forwards only, which compiles sooner than backwards."""
            f, along = jax.linearize(lambda u: simulated(u, jnp.asarray(problem.x)), u)
            return f, jax.vmap(along, out_axes=-1)(jnp.eye(dim_u, dtype=dtype))

        def fisher(slope: Float[Array, "n dy dp"], rho: Float[Array, " dy"]) -> Float[Array, "d d"]:
            """Information of unit coordinates and noise."""
            slope, of_scale = slope / sigma(rho)[None, :, None], jnp.full((dim_y,), 2.0, dtype)
            if problem.tails is not None:
                of_location, of_scale = student_t.information(problem.tails)
                slope = slope * jnp.sqrt(of_location)[None, :, None]
            rows = problem.counted()
            location, scales = (
                (counts, problem.m.astype(dtype))
                if rows is None
                else (counts * rows.precision, jnp.sum(counts * rows.tells, axis=0))
            )
            of_u = jnp.einsum("nki,nkj->ij", slope * location[:, :, None], slope) + jnp.diag(gaussian.astype(dtype))
            of_log = of_scale * scales + 1 / self.noise.prior_std**2
            bend = jax.nn.sigmoid(rho) / sigma(rho)  # d log sigma / d rho
            return jax.scipy.linalg.block_diag(of_u, jnp.diag(of_log * bend**2))

        def known(slope: Float[Array, "n dy dp"], rho: Float[Array, " dy"]) -> Float[Array, "dp dp"]:
            """Information of unit coordinates in which a uniform prior knows its variance of 1/12.

            Where data see nothing, a draw is spread over the range.
            """
            return fisher(slope, rho)[:dim_u, :dim_u] + jnp.diag(jnp.where(gaussian, 0.0, 12.0).astype(dtype))

        def respread(state: State, of_f: Float[Array, "n dy dp"]) -> tuple[State, Float[Array, "n dy dp"]]:
            """Go on with other spreads of groups where a start has come to rest with those that it had."""
            held = (state.u <= low) | (state.u >= high)
            told = populations.told(known(of_f, state.rho), held)
            moved = populations.moved(state.u, told, FAR)
            rests = (state.idle > 0) & jnp.isfinite(state.loss) & ~moved.settled
            after = state._replace(
                u=jnp.where(rests, moved.u, state.u),
                loss=state.loss + jnp.where(rests, moved.loss, 0.0),
                damping=jnp.where(rests, jnp.minimum(state.damping, FIRST_DAMPING), state.damping),
                idle=jnp.where(rests, 0.0, state.idle),
                told=told,
            )
            return after, of_f * jnp.where(rests, moved.stretch, 1.0)[None, None]

        def better(state: State) -> State:
            """One damped step of one start."""
            f, of_f = linearised(state.u)
            if populations:
                state, of_f = respread(state, of_f)
            at = jnp.concatenate([state.u, state.rho])
            by_f, by_u, by_rho = jax.grad(judged, argnums=(0, 1, 2))(f, state.u, state.rho)
            slope = jnp.concatenate([by_u + jnp.einsum("nk,nki->i", by_f, of_f), by_rho])
            edge = (
                jnp.concatenate([low, jnp.full((dim_y,), -jnp.inf, dtype)]),
                jnp.concatenate([high, jnp.full((dim_y,), jnp.inf, dtype)]),
            )
            stuck = ((at <= edge[0]) & (slope > 0)) | ((at >= edge[1]) & (slope < 0))
            still = stuck | (jnp.arange(at.shape[0]) >= dim_u) if not self.noise.learn else stuck
            if populations:
                still = still | jnp.asarray(np.append(populations.held, np.zeros(dim_y, bool)))
            moves = jnp.where(still, 0.0, 1.0).astype(dtype)
            h = fisher(of_f, state.rho) * moves[:, None] * moves[None]
            h = h + jnp.diag(state.damping * jnp.diag(h) + jnp.where(still, 1.0, 1e-9 * jnp.trace(h) + 1e-12))
            new = jnp.clip(at - jnp.linalg.solve(h, slope * moves), *edge)
            value = loss(new[:dim_u], new[dim_u:])
            good = jnp.isfinite(value) & (value < state.loss)
            here = jnp.where(good, new, at)
            damping = jnp.clip(state.damping * jnp.where(good, EASIER, HARDER), 1e-9, MOST_DAMPING)
            gained = jnp.where(good, state.loss - value, 0.0) > SMALL * (1 + jnp.abs(state.loss))
            # a step that was refused says nothing before it was tried shorter and shorter
            waited = (good | (state.damping >= HOPELESS)).astype(dtype)
            idle = jnp.where(gained, 0.0, state.idle + waited).astype(dtype)
            loss_here = jnp.where(good, value, state.loss)
            return State(here[:dim_u], here[dim_u:], damping.astype(dtype), loss_here, idle, state.told)

        def all_better(state: State) -> State:
            """One step of every start; starts of a wide simulator one after the other."""
            return jax.vmap(better)(state) if prior.width <= WIDE else jax.lax.map(better, state)

        def init(key: PRNGKeyArray) -> State:
            random = jax.random.uniform(key, (self.starts, dim_u), dtype, 0.05, 0.95)
            u = jnp.where(gaussian[None], jax.scipy.special.ndtri(random), random)
            u = u.at[0].set(jnp.where(gaussian, 0.0, 0.5))  # one from the middle
            rho = jnp.tile(self.noise.init(problem.noise_init, problem.noise_floor)[None], (self.starts, 1)).astype(
                dtype
            )
            first = jax.vmap(loss)(u, rho)
            damping = jnp.full((self.starts,), FIRST_DAMPING, dtype)
            none = jnp.zeros_like(damping)
            told = Told(jnp.zeros((self.starts, len(populations.spreads)), dtype), none) if populations else None
            return State(u, rho, damping, jnp.where(jnp.isfinite(first), first, jnp.inf), none, told)

        def step(key: PRNGKeyArray, state: State, draws: None) -> tuple[State, Info]:
            # a loop of one turn or none: where every start has ended, nothing is simulated, under vmap either
            after, _ = jax.lax.while_loop(
                lambda carry: carry[1] & jnp.any(carry[0].idle < PATIENCE),
                lambda carry: (all_better(carry[0]), jnp.zeros((), bool)),
                (state, jnp.ones((), bool)),
            )
            best = after.best
            info = Info(
                after.loss[best] / jnp.maximum(problem.m, 1).astype(dtype),
                student_t.standard_deviation(sigma(after.rho[best]), problem.tails),
                jnp.zeros((), dtype),
            )
            return after, info

        def drawn(state: State) -> tuple[Float[Array, "L dp"], Float[Array, " dy"]]:
            """Unit coordinates from the Gaussian about the best optimum, within bounds, and the noise."""
            best = state.best
            u, rho = state.u[best], state.rho[best]
            h = known(linearised(u)[1], rho)
            held = (u <= low) | (u >= high)  # at a bound half of the mass lies beyond it: the optimum stands for it
            if populations:
                held = held | jnp.asarray(populations.held)
            h = jnp.where(held[:, None] | held[None], jnp.eye(dim_u, dtype=dtype), h)
            factor = jnp.linalg.cholesky(h.astype(jnp.float64)).astype(dtype)
            white = white_noise(self.particles, dim_u, dtype)
            apart = jax.scipy.linalg.solve_triangular(factor, white.T, lower=True, trans=1).T
            apart = jnp.where(held[None], 0.0, apart)
            # a draw beyond a bound is shortened along its own direction: clipped, it would leave a ridge of parameters that
            # fit equally well
            room = jnp.where(apart > 0, (high - u)[None], (u - low)[None]) / jnp.maximum(jnp.abs(apart), 1e-12)
            draws = u[None] + jnp.minimum(jnp.min(room, axis=1, initial=1.0), 1.0)[:, None] * apart
            if state.told is not None:
                draws = populations.drawn(draws, state.told.gamma[best], white)
            return draws, sigma(rho)

        def predict(state: State, x: Float[Array, "n dx"]) -> Predictive:
            u, noise_std = drawn(state)
            h = jax.vmap(simulated, in_axes=(0, None))(u, x)
            return Predictive(scale.y_to_data(h), noise_std * scale.y_std, problem.tails)

        def members(state: State, x: Float[Array, "L n dx"]) -> Float[Array, "L n dy"]:
            return scale.y_to_data(jax.vmap(simulated)(drawn(state)[0], x))

        return Inference(init, lambda key, state: None, step, predict, members)


def white_noise(n: int, dim: int, dtype: jnp.dtype) -> Float[Array, "n dim"]:
    """Return standard normal numbers whose mean is 0."""
    white = jax.random.normal(jax.random.key(0), (n, dim), dtype)
    return (white - jnp.mean(white, axis=0)[None]) * (n / max(n - 1, 1)) ** 0.5


def identified(method: SysID, setting: Setting, problem: Problem, key: PRNGKeyArray, particles: int) -> Identified:
    """Return the most probable parameters; those of a simulator without uncertain ones are none.

    Args:
        method: how it is identified.
        setting: with the prior.
        problem: with the data.
        key: of the starts.
        particles: number of particles that groups which were never seen are drawn for.
    """
    prior, _ = simulator_of(setting)
    dtype = problem.x.dtype
    if not prior.params:
        return Identified(jnp.zeros((0,), dtype), None)
    rule = method.bind(setting, problem)

    def body(_: Array, state: State) -> State:
        after: State = rule.step(key, state, None)[0]
        return after

    last: State = jax.lax.fori_loop(0, method.steps, body, rule.init(key))
    u = last.u[last.best]
    phi = physical(prior, u)
    if last.told is None:
        return Identified(phi, None)
    white = white_noise(particles, len(u), dtype)
    draws = Populations(prior.params).drawn(jnp.tile(u[None], (particles, 1)), last.told.gamma[last.best], white)
    return Identified(phi, jax.vmap(lambda u: physical(prior, u))(draws))


def simulator_of(setting: Setting) -> tuple[FunctionPrior, OneStep]:
    """Return the prior and its simulator, which has to be one in symbols.

    Raises:
        ConfigError: there is none.
    """
    prior = setting.prior
    if not isinstance(prior, FunctionPrior) or prior.step is None:
        raise ConfigError(
            "method: this one calibrates the simulator's parameters; it needs prior=simulator (or simulator_only) and a "
            "simulator declared in symbols, not a world."
        )
    return prior, prior.step


def bounds(prior: FunctionPrior) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest unit coordinates, (dp,)."""
    uniform = np.array([q.prior == "uniform" for q in prior.params], bool)
    return np.where(uniform, 0.0, -FAR), np.where(uniform, 1.0, FAR)


def physical(prior: FunctionPrior, u: Float[Array, " dp"]) -> Float[Array, " dp"]:
    """Return parameters at unit coordinates: shares of a uniform range, standard deviations of a normal prior."""
    values = []
    for i, q in enumerate(prior.params):
        low, high = (np.log([q.low, q.high]) if q.prior == "lognormal" else np.array([q.low, q.high])).tolist()
        at = low + (high - low) * u[i] if q.prior == "uniform" else (low + high) / 2 + (high - low) / 4 * u[i]
        values.append(jnp.exp(at) if q.prior == "lognormal" else at)
    return jnp.stack(values).astype(u.dtype)
