"""Pathwise conditioning: networks learn sample paths of the posterior, drawn in closed form, by regression.

    h_l(x) = f_l(x) + c(x, X) (C + (w + sigma^2) I)^-1 (y + e_l - f_l(X)),    e_l ~ N(0, (w + sigma^2) I)

per output, where f_l = g(., phi_l) + h~_l is a draw of the prior and c its covariance: that of draws of the simulator plus the
gap's kernel. Where the prior is Gaussian h_l is a draw of the posterior, up to the number of draws and of features; where it is
not, the best update of a draw that is linear in the data. Function-space inference under the `gaussian` score converges to
that, too, but nothing here is stiff: a network regresses on one function, whatever the eigenvalues of C. sigma is that of the
largest penalised marginal likelihood, on a grid, of no more than 512 rows; what is reported as noise is the root of
sigma^2 + w, since the white model error w is no part of a path.

Reference: Wilson et al. (2020), Efficiently sampling functions from Gaussian process posteriors, eqs. 8-13; Matheron's rule in
Journel and Huijbregts (1978); Rahimi and Recht (2007), Random features for large-scale kernel machines (the gap's paths);
Evensen (1994) for draws of a simulator.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from simpel_cli.errors import ConfigError, check_at_least_one
from simpel_cli.inference.networks import MLP
from simpel_cli.inference.noise import NoiseModel, Numbers
from simpel_cli.inference.protocols import Inference, Info, Problem, Setting
from simpel_cli.methods import particle_networks as nets
from simpel_cli.methods.particle_networks import Networks, refuse_rates
from simpel_cli.priors.function_prior import FunctionPrior
from simpel_cli.priors.gaussian_process import Spectral
from simpel_cli.priors.marginal_likelihood import MOST_ROWS, Spectrum, best_scales, evenly

LEAST_DRAWS = 64  # that a covariance is worth taking of


class Paths(NamedTuple):
    """Sample paths of the posterior, float64.

    Args:
        key: data of the key that the prior's draws come from; with another version of JAX, which may draw others from it, a run
            cannot be resumed.
        along: coefficients of the simulator's draws, about their mean.
        at: coefficients of the kernel at the rows that are conditioned on.
        known: values at these rows: y + e - (w + sigma^2) (C + (w + sigma^2) I)^-1 (y + e - f(X)), normalised.
    """

    key: Int[Array, " words"]
    along: Float[Array, "dy N L"]
    at: Float[Array, "dy c L"]
    known: Float[Array, "dy c L"]


class State(NamedTuple):
    """What the data say, and the networks that learn it."""

    paths: Paths
    networks: nets.State


class Targets(NamedTuple):
    """Values of the paths at points of a stretch: the domain's, then the data's.

    Args:
        x: normalised.
        h: normalised.
    """

    x: Float[Array, "n dx"]
    h: Float[Array, "L n dy"]


@dataclass(frozen=True)
class Pathwise:
    """Networks that regress on sample paths of the posterior.

    Args:
        steps: of the regression.
        particles: paths and networks, L.
        network: architecture.
        learning_rate: of Adam, at the start.
        final_learning_rate: fraction of it that is left at the last step, along a cosine.
        batch: points per step, of the domain and of the data.
        pool: points of the domain that a stretch of steps chooses from.
        features: of a path of the gap.
        most_rows: training rows that are conditioned on, at most, evenly chosen; the others are not looked at. Time grows as
            their third power.
        noise: observation noise; learned: that of the largest marginal likelihood, so that `rate` plays no part.
    """

    steps: int = 5000
    particles: int = 20
    network: MLP = MLP(activation="silu")
    learning_rate: float = 1e-2
    final_learning_rate: float = 0.01
    batch: int = 96
    pool: int = 1024
    features: int = 2000
    most_rows: int = 2048
    noise: NoiseModel = NoiseModel()

    uses_score = False  # not a field: the law of Gaussian values is known

    def __post_init__(self) -> None:
        check_at_least_one("method", self, ("steps", "particles", "batch", "pool", "features", "most_rows"))
        refuse_rates(self.learning_rate, self.final_learning_rate)

    def bind(self, setting: Setting, problem: Problem) -> Inference:
        """Return the rule for this problem (see `simpel_cli.inference.protocols.Inference`).

        Raises:
            ConfigError: the prior has too few draws, or a kernel whose paths cannot be drawn.
        """
        prior = self._prior_of(setting, brings_draws=problem.bank is not None)
        scale, dtype = problem.normaliser, problem.x.dtype
        n_rows, dim_y = problem.y.shape
        kappa = jnp.asarray(problem.gap_scale).astype(jnp.float64)
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps, alpha=self.final_learning_rate)
        fixed = replace(self.noise, learn=False)  # by marginal likelihood, before the first step
        networks = Networks(self.particles, self.network, fixed, optax.adam(rate), problem)

        rows, count = evenly(n_rows, jnp.asarray(problem.m), self.most_rows)
        counts = (jnp.arange(len(rows), dtype=jnp.int32) < count).astype(jnp.float64)
        known = scale.x(jnp.asarray(problem.x)[rows])
        weights, white = jnp.ones((len(rows), dim_y), jnp.float64), prior.white_variance
        if problem.tail is not None:
            white = 0.0  # Student's t holds the white model error (`priors.noise_law`)
        if problem.weights is not None:  # a Gaussian whose variance differs from row to row
            weights = jnp.asarray(problem.weights)[rows].astype(jnp.float64)
        tells = jnp.ones_like(weights) if problem.tells is None else jnp.asarray(problem.tells)[rows]

        def simulated(key: PRNGKeyArray, x: Float[Numbers, "n dx"], at: Int[Array, " n"]) -> Float[Array, "n dy N"]:
            """Draws at inputs in data units, which are these rows of a bank, normalised; those of the paths first."""
            if problem.bank is not None:
                draws = jnp.asarray(problem.bank.samples)[at]
            elif prior.simulates:
                draws = jnp.moveaxis(prior.simulate(key, jnp.asarray(x), prior.draws), 0, -1)
            else:
                return jnp.zeros((len(x), dim_y, self.particles + 2), dtype)
            return (draws - scale.y_mean[None, :, None]) / scale.y_std[None, :, None]

        shared = problem.gap_relevance is None  # features and kernel of all outputs are one: a share 1/dy of the work
        relevance = jnp.asarray(prior.input_scale)[None] if shared else jnp.asarray(problem.gap_relevance)
        of_each = jnp.broadcast_to(relevance, (dim_y, relevance.shape[1]))

        def prior_paths(
            key: PRNGKeyArray, x: Float[Array, "n dx"], draws: Float[Array, "n dy N"]
        ) -> Float[Array, "n dy L"]:
            """Paths of the prior at normalised inputs."""
            own = draws[:, :, : self.particles].astype(jnp.float64)
            if prior.kernel is None:
                return own
            key_frequency, key_phase, key_weight = jax.random.split(key, 3)
            assert isinstance(prior.kernel, Spectral)
            frequency = prior.kernel.frequencies(key_frequency, self.features, x.shape[1])
            phase = jax.random.uniform(key_phase, (self.features,), jnp.float64, 0, 2 * jnp.pi)
            weights = self._paired(key_weight, (self.features, dim_y))

            def paths(relevance: Float[Array, " dx"], weights: Float[Array, "L f *d"]) -> Float[Array, "n *d L"]:
                at = (x * relevance.astype(dtype)[None]).astype(jnp.float64)
                wave = jnp.sqrt(2 / self.features) * jnp.cos(at @ frequency.T + phase[None])
                # the one large product of a stretch: single precision is enough for a path
                return jnp.moveaxis(jnp.tensordot(wave.astype(dtype), weights.astype(dtype), ((1,), (1,))), 1, -1)

            if shared:
                gap = paths(relevance[0], weights)
            else:
                each = jax.lax.map(lambda own: paths(*own), (relevance, jnp.moveaxis(weights, -1, 0)))
                gap = jnp.moveaxis(each, 0, 1)
            return own + kappa[None, :, None] * gap.astype(jnp.float64)

        def centred(draws: Float[Array, "n dy N"]) -> Float[Array, "dy n R"]:
            """Draws that the covariance is taken of, over the root of their number less one."""
            rest = jnp.moveaxis(draws[:, :, self.particles :].astype(jnp.float64), 1, 0)
            return (rest - jnp.mean(rest, axis=2, keepdims=True)) / (rest.shape[2] - 1) ** 0.5

        def noise_by_marginal_likelihood(
            draws: Float[Array, "dy c N"], mean: Float[Array, "c dy"]
        ) -> Float[Array, " dy"]:
            """Noise of the largest marginal likelihood, normalised."""
            few, _ = evenly(len(rows), count, MOST_ROWS)
            left = (jnp.asarray(problem.y)[rows].astype(jnp.float64) - mean)[few]

            def of_output(
                given: tuple[
                    Float[Array, "c N"],
                    Float[Array, " c"],
                    Float[Array, ""],
                    Float[Array, ""],
                    Float[Array, ""],
                    Float[Array, " c"],
                    Float[Array, " dx"],
                ],
            ) -> Float[Array, ""]:
                own, left, kappa, floor, typical, root, relevance = given
                correlation = correlations(known[few], known[few], relevance)
                # rows count by their weights; those that tell nothing of the noise are left out, as padding is
                real, left = root * counts[few], root * left
                function = own @ own.T + kappa**2 * correlation + white * jnp.eye(len(left), dtype=jnp.float64)
                law = function * real[:, None] * real[None]
                values, vectors = jnp.linalg.eigh(law)
                turned = vectors.T @ (left * counts[few])[:, None]
                silent = jnp.sum(jnp.where(real > 0, 0.0, 1.0))
                spectrum = Spectrum(jnp.maximum(values, 0.0), vectors, turned, silent)
                one = jnp.ones((1,), jnp.float64)
                prior_std = self.noise.prior_std if self.noise.learn else None
                return best_scales(spectrum, one, 0.0, prior_std, floor[None], typical[None]).noise[0]

            floor, typical = (jnp.asarray(a).astype(jnp.float64) for a in (problem.noise_floor, problem.noise_init))
            found: Array = jax.lax.map(
                of_output,
                (
                    draws[:, few],
                    left.T,
                    kappa,
                    floor,
                    typical,
                    (jnp.sqrt(weights) * tells.astype(jnp.float64))[few].T,
                    of_each,
                ),
            )
            return found

        def correlations(
            x: Float[Array, "n dx"], other: Float[Array, "c dx"], relevance: Float[Numbers, " dx"]
        ) -> Float[Array, "n c"]:
            if prior.kernel is None:
                return jnp.zeros((len(x), len(other)), jnp.float64)
            return prior.correlation(x.astype(jnp.float64), other.astype(jnp.float64), relevance[None])[0]

        def init(key: PRNGKeyArray) -> State:
            key_paths, key_noise, key_networks = jax.random.split(key, 3)
            key_draws, key_gap = jax.random.split(key_paths)
            draws = simulated(key_draws, jnp.asarray(problem.x)[rows], rows)
            before = prior_paths(key_gap, known, draws)
            own = centred(draws)
            mean = jnp.mean(draws[:, :, self.particles :].astype(jnp.float64), axis=2)
            sigma = noise_by_marginal_likelihood(own, mean)
            common = sigma**2 + white
            variance = sigma[None] ** 2 / weights + white  # of every row: of one that is far off, it is large
            measured = jnp.asarray(problem.y)[rows].astype(jnp.float64)
            noise = self._paired(key_noise, (len(rows), dim_y)) * jnp.sqrt(variance)[None]
            seen = measured[:, :, None] + jnp.moveaxis(noise, 0, -1)
            left = (seen - before) * counts[:, None, None]

            def of_output(
                given: tuple[
                    Float[Array, "c N"],
                    Float[Array, "c L"],
                    Float[Array, "c L"],
                    Float[Array, ""],
                    Float[Array, " c"],
                    Float[Array, " dx"],
                ],
            ) -> tuple[Float[Array, "N L"], Float[Array, "c L"], Float[Array, "c L"]]:
                own, seen, left, kappa, variance, relevance = given
                correlation = correlations(known, known, relevance)
                own = own * counts[:, None]
                law = own @ own.T + kappa**2 * correlation * counts[:, None] * counts[None]
                factor = jnp.linalg.cholesky(law + jnp.diag(variance))
                solved = jax.scipy.linalg.cho_solve((factor, True), left)
                return own.T @ solved, kappa**2 * solved, seen - variance[:, None] * solved

            seen, left = jnp.moveaxis(seen, 1, 0), jnp.moveaxis(left, 1, 0)
            along, at, values = jax.lax.map(of_output, (own, seen, left, kappa, variance.T, of_each))
            total = jnp.sqrt(common).astype(dtype)
            rho = self.noise.init(total, problem.noise_floor)
            first = networks.init(key_networks)._replace(noise=rho)
            return State(Paths(jax.random.key_data(key_paths), along, at, values), first)

        def draw(key: PRNGKeyArray, state: State) -> Targets:
            paths = state.paths
            key_draws, key_gap = jax.random.split(jax.random.wrap_key_data(paths.key))
            if problem.bank is None:
                points = setting.sample_inputs(key, self.pool)
            else:
                points = jnp.asarray(problem.bank.x)[n_rows:]
            draws = simulated(key_draws, points, n_rows + jnp.arange(len(points), dtype=rows.dtype))
            fresh = scale.x(points)
            moved = jnp.einsum("dnj,djl->ndl", centred(draws), paths.along)
            if shared:
                by_gap = jnp.einsum("nc,dcl->dnl", correlations(fresh, known, relevance[0]), paths.at)
            else:
                by_gap = jax.lax.map(lambda own: correlations(fresh, known, own[0]) @ own[1], (of_each, paths.at))
            moved = moved + jnp.moveaxis(by_gap, 0, 1)
            elsewhere = prior_paths(key_gap, fresh, draws) + moved
            h = jnp.concatenate([elsewhere, jnp.moveaxis(paths.known, 0, 1)])
            return Targets(jnp.concatenate([fresh, known]), jnp.moveaxis(h, -1, 0).astype(dtype))

        def step(key: PRNGKeyArray, state: State, targets: Targets) -> tuple[State, Info]:
            fresh = len(targets.x) - len(rows)
            chosen = jax.random.randint(key, (self.batch,), 0, fresh + count, jnp.int32)
            h, pull_back = jax.vjp(lambda p: self.network.apply_all(p, targets.x[chosen]), state.networks.particles)
            sigma = networks.noise_scale(state.networks.noise)
            off = (targets.h[:, chosen] - h) / sigma[None, None]
            (ascent,) = pull_back(off / sigma[None, None])
            after = networks.ascended(state.networks, ascent, jnp.zeros_like(sigma))
            return state._replace(networks=after), Info(
                0.5 * jnp.mean(off**2), networks.noise_std(state.networks.noise), jnp.zeros((), dtype)
            )

        return Inference(
            init, draw, step,
            lambda state, x: networks.predict(state.networks, x), lambda state, x: networks.members(state.networks, x),
        )  # fmt: skip

    def _prior_of(self, setting: Setting, *, brings_draws: bool) -> FunctionPrior:
        prior = setting.prior
        if not isinstance(prior, FunctionPrior):
            raise ConfigError(
                f"prior: got a {type(prior).__name__}; method=pathwise needs prior=simulator, simulator_only or gp."
            )
        least = self.particles + LEAST_DRAWS
        if (prior.simulates or brings_draws) and prior.draws < least:
            raise ConfigError(
                f"prior.draws: got {prior.draws}; method=pathwise needs {least} or more: method.particles "
                f"({self.particles}) for its paths, and {LEAST_DRAWS} for their covariance."
            )
        if prior.kernel is not None and not isinstance(prior.kernel, Spectral):
            raise ConfigError(
                f"prior: its kernel {type(prior.kernel).__name__} has no `frequencies`, which paths are drawn from; give it "
                "that method (see simpel_cli/priors/gaussian_process.py), or use SquaredExponential, Matern32 or Matern52."
            )
        return prior

    def _paired(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "L *shape"]:
        """Standard normal numbers for every path, in pairs of opposite sign, which cancel in the mean of the paths."""
        half = jax.random.normal(key, (-(-self.particles // 2), *shape), jnp.float64)
        return jnp.concatenate([half, -half])[: self.particles]
