"""Inference in function space: particles are networks, moved by what their function values should do.

On a measurement set X of k points (a data batch and fresh points of the domain), a rule (`fsvgd`, `fmap`, `repulsive`) turns
function values h_l in R^(k dy) and scores into velocities of function values,

    s_l = grad_{h_l} { (m/b) sum_batch log N(y; h_l(x), sigma^2) + log p(h_l^X) },

and the weights follow by the vector-Jacobian product. The score is that of the joint log posterior: the same prior weighs
the same under every estimator and rule. No function value has a part in what an estimator makes of the prior on X: a stretch of
steps chooses among a number of sets, and the estimators are fitted once to each.

Reference: Wang, Ren, Zhu and Zhang (2019), Function space particle optimization for Bayesian neural networks, eq. 5; Treven et
al., Simulation priors (SimPEL).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from simpel_cli.errors import ConfigError, check_at_least_one
from simpel_cli.inference import student_t
from simpel_cli.inference.networks import MLP
from simpel_cli.inference.noise import NoiseModel, Numbers
from simpel_cli.inference.protocols import Counted, Inference, Info, Problem, Setting
from simpel_cli.methods.particle_networks import Networks, State, refuse_rates
from simpel_cli.methods.preconditioner import Basis, basis, preconditioned
from simpel_cli.scores.estimator import Score, fitted
from simpel_cli.scores.gaussian import moments

MOST_SETS = 256  # of a stretch, where there are many data: an estimate that keeps its draws takes a megabyte per set
LEAST_DRAWS = 256  # that an estimator gets which works on draws of the whole prior


class Sets(NamedTuple):
    """Measurement sets that a stretch of steps chooses from; the leaves of one have no S.

    Args:
        x: normalised points, the batch first.
        batch: training rows of the batch.
        is_data: which of them count.
        score: of the prior, fitted per output; leaves (S, dy, ...).
        basis: of the prior's covariance; None where it is not needed.
    """

    x: Float[Array, "*S k dx"]
    batch: Int[Array, "*S b"]
    is_data: Bool[Array, "*S b"]
    score: Score
    basis: Basis | None


@dataclass(frozen=True)
class FunctionSpace(ABC):
    """Particles in function space, with AdamW; a rule is a subclass with a velocity.

    Args:
        steps: number of SVGD steps.
        particles: number of networks, L.
        network: architecture.
        learning_rate: of AdamW, at the start.
        final_learning_rate: fraction of it that is left at the last step, along a cosine; 1 = constant. A constant rate
            leaves the particles jittering about the posterior, which the learned noise then takes for noise.
        weight_decay: of AdamW, on network weights only.
        batch: training points per step, at most; drawn without replacement.
        fresh_points: points of the domain per step.
        pool: points of the domain that a stretch of steps chooses from; a power of two.
        sets: measurement sets that a stretch of steps chooses from, at least; more, up to 256, where so many batches are not
            as many as the data.
        prior_weight: exponent of the prior; 1 is Bayes.
        precondition: go in Newton's direction of the function values (`preconditioner.py`): for rules whose particles climb
            on their own, which else need many times the steps where data are few.
        noise: observation noise.
    """

    steps: int = 5000
    particles: int = 20
    network: MLP = MLP(activation="silu")
    learning_rate: float = 3e-3
    final_learning_rate: float = 0.03
    weight_decay: float = 1e-3
    batch: int = 24
    fresh_points: int = 16
    pool: int = 1024
    sets: int = 128
    prior_weight: float = 1.0
    precondition: bool = False
    noise: NoiseModel = NoiseModel()

    uses_score = True  # not a field

    def __post_init__(self) -> None:
        check_at_least_one("method", self, ("steps", "particles", "batch", "fresh_points", "pool", "sets"))
        points = self.batch + self.fresh_points  # fresh ones fill the batch where data are fewer
        if self.pool & (self.pool - 1) or self.pool < points:
            raise ConfigError(
                f"method.pool: got {self.pool}; it must be a power of two and at least batch + fresh_points ({points})."
            )
        if self.precondition and not self.prior_weight > 0:
            raise ConfigError(f"method.precondition: it needs a prior, and method.prior_weight is {self.prior_weight}.")
        refuse_rates(self.learning_rate, self.final_learning_rate)

    @abstractmethod
    def velocity(
        self, h: Float[Array, "L *d"], score: Float[Array, "L *d"]
    ) -> tuple[Float[Array, "L *d"], Float[Array, ""]]:
        """Return where function values of L particles go, and how near the particles are: the mean kernel between two."""

    def bind(self, setting: Setting, problem: Problem) -> Inference:
        """Return the rule for this problem (see `simpel_cli.inference.protocols.Inference`)."""
        to_normalised = problem.normaliser
        dtype = problem.x.dtype
        n_rows = problem.x.shape[0]
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps, alpha=self.final_learning_rate)
        optimiser = optax.adamw(rate, weight_decay=self.weight_decay, mask=(True, False))

        count = max(self.sets, min(-(-n_rows // self.batch), MOST_SETS))
        networks = Networks(self.particles, self.network, self.noise, optimiser, problem)

        def draw(key: PRNGKeyArray, state: State) -> Sets:
            key_bank, key_sets = jax.random.split(key)
            x, samples = bank(key_bank)

            def one(key: PRNGKeyArray) -> Sets:
                key_points, key_gap = jax.random.split(key)
                batch, is_data, rows = measurement_set(key_points)
                return Sets(x[rows], batch, is_data, *of_prior(key_gap, x[rows], samples[rows]))

            return jax.lax.map(one, jax.random.split(key_sets, count))

        def bank(key: PRNGKeyArray) -> tuple[Float[Array, "B dx"], Float[Array, "B dy N"]]:
            """Training inputs, points of the domain and prior draws at them, normalised."""
            if problem.bank is not None:
                x, samples = jnp.asarray(problem.bank.x), jnp.asarray(problem.bank.samples)
            else:
                key_x, key_phi = jax.random.split(key)
                fresh = setting.sample_inputs(key_x, self.pool)
                x = jnp.concatenate([jnp.asarray(problem.x), fresh])
                samples = jnp.moveaxis(setting.prior.simulate(key_phi, x, setting.prior.draws), 0, -1)
                if not setting.prior.simulates:
                    return to_normalised.x(x), samples
            scaled = (samples - to_normalised.y_mean[None, :, None]) / to_normalised.y_std[None, :, None]
            return to_normalised.x(x), scaled

        def measurement_set(key: PRNGKeyArray) -> tuple[Int[Array, " b"], Bool[Array, " b"], Int[Array, " k"]]:
            """Rows of the batch, which of them are data, and rows of the bank: the batch and distinct fresh points."""
            key_batch, key_offset, key_stride = jax.random.split(key, 3)
            batch, is_data = distinct_rows(key_batch, min(self.batch, n_rows), jnp.asarray(problem.m))
            # an odd stride visits a power of two of rows without repeats: distinct points without a sort
            b, kind = batch.shape[0], batch.dtype
            offset = jax.random.randint(key_offset, (), 0, self.pool, kind)
            stride = 2 * jax.random.randint(key_stride, (), 0, max(self.pool // 2, 1), kind) + 1
            fresh = n_rows + (offset + stride * jnp.arange(b + self.fresh_points, dtype=kind)) % self.pool
            # fresh points fill the batch where there are fewer data than it has room for
            return batch, is_data, fresh.at[:b].set(jnp.where(is_data, batch, fresh[:b]))

        def of_prior(
            key: PRNGKeyArray, x: Float[Array, "k dx"], samples: Float[Array, "k dy N"]
        ) -> tuple[Score, Basis | None]:
            """Score of the prior on a set, and the basis of its covariance, per output."""
            covariance = setting.prior.covariance(x, problem.gap_scale, problem.gap_relevance)
            whole = None
            if self.precondition:
                drawn = jnp.transpose(samples, (1, 2, 0))
                whole = basis(jax.vmap(lambda s: moments(s)[1])(drawn) + covariance.astype(jnp.float64), dtype)
            gap = None
            if setting.score.gap_draws:
                # a prior without a simulator brings two draws, both zero: enough for moments, not for an estimate
                samples = jnp.tile(samples, (1, 1, -(-LEAST_DRAWS // samples.shape[2])))
                factor = jnp.linalg.cholesky(covariance.astype(jnp.float64)).astype(dtype)
                gap = jnp.einsum("dkj,jdn->dnk", factor, jax.random.normal(key, samples.shape, dtype))
            by_output = jnp.transpose(samples, (1, 2, 0))
            return jax.vmap(lambda s, c, g: fitted(setting.score, s, c, g))(by_output, covariance, gap), whole

        def step(key: PRNGKeyArray, state: State, sets: Sets) -> tuple[State, Info]:
            chosen = jax.random.randint(key, (), 0, count)
            x, batch, is_data, scores, prior_basis = jax.tree.map(lambda a: a[chosen], sets)
            b, counted = batch.shape[0], is_data.astype(dtype)
            y = problem.y[batch]
            h, pull_back = jax.vjp(lambda p: self.network.apply_all(p, x), state.particles)

            weight = problem.m.astype(dtype) / at_least_one(counted)
            fit, (score_data, score_noise) = jax.value_and_grad(
                lambda h, rho: log_likelihood(
                    h, networks.noise_scale(rho), y, counted, problem.tails, problem.counted(batch)
                ),
                argnums=(0, 1),
            )(h[:, :b], state.noise)
            prior_score = jax.vmap(lambda score, h: score(h), in_axes=(0, 2), out_axes=2)(scores, h)
            score = (self.prior_weight * prior_score).at[:, :b].add(weight * score_data)
            velocity, mean_kernel = self.velocity(h, score)
            if prior_basis is not None:
                evenly = networks.noise_scale(state.noise) ** 2 * h.shape[1] / jnp.maximum(problem.m, 1).astype(dtype)
                if problem.tails is not None:
                    evenly = evenly / student_t.information(problem.tails)[0]
                velocity = preconditioned(velocity, prior_basis, evenly, self.prior_weight)

            (ascent,) = pull_back(velocity)
            after = networks.ascended(state, ascent, weight * score_noise)
            info = Info(-fit / (at_least_one(counted) * self.particles), networks.noise_std(state.noise), mean_kernel)
            return after, info

        return Inference(networks.init, draw, step, networks.predict, networks.members)


def at_least_one(counted: Float[Array, " b"]) -> Float[Array, ""]:
    """Return how many rows count; of none, 1, so that what is divided by it is 0: the posterior of no data is the prior."""
    return jnp.maximum(jnp.sum(counted), 1)


def distinct_rows(key: PRNGKeyArray, size: int, m: Int[Array, ""]) -> tuple[Int[Array, " size"], Bool[Array, " size"]]:
    """Draw `size` distinct rows out of m, without a sort; of fewer rows than that, all of them once.

    Returns:
        Rows, and which of them count: where m < size, entry i is row i and counts if i < m.

    Reference: Floyd's algorithm, in Bentley and Floyd (1987), A sample of brilliance.
    """
    entry = jnp.arange(size, dtype=m.dtype)
    last = jnp.maximum(m - size, 0) + entry  # entry i is drawn from the rows up to this one
    drawn = jax.random.randint(key, (size,), 0, last + 1, m.dtype)

    def choose(i: Int[Array, ""], rows: Int[Array, " size"]) -> Int[Array, " size"]:
        return rows.at[i].set(jnp.where(jnp.any(rows == drawn[i]), last[i], drawn[i]))

    rows = jax.lax.fori_loop(0, size, choose, jnp.full(size, -1, m.dtype))
    enough = m >= size
    return jnp.where(enough, rows, entry), enough | (entry < m)


def log_likelihood(
    h: Float[Array, "L b dy"],
    sigma: Float[Array, " dy"],
    y: Float[Array, "b dy"],
    counted: Float[Array, " b"],
    tail: Float[Numbers, " dy"] | None = None,
    rows: Counted | None = None,
) -> Float[Array, ""]:
    """Return the sum over particles, counted points and outputs of the log density of the noise, up to a constant.

    Args:
        h: function values.
        sigma: scale of the noise.
        y: measured targets.
        counted: 1 for data, 0 for what fills the batch.
        tail: of Student's t, which keeps a row that is far off from dragging a sharp posterior; None: Gaussian.
        rows: how much each target counts; None: all count alike.
    """

    def law(z: Float[Array, "L b dy"]) -> Float[Array, "L b dy"]:
        return 0.5 * z * z if tail is None else -student_t.log_density(z, jnp.asarray(tail)[None, None])

    if rows is None:
        misfit = law((y[None] - h) / sigma[None, None]) + jnp.log(sigma)[None, None]
    else:
        misfit = rows.misfit(y[None] - h, sigma, law)
    return -jnp.sum(misfit * counted[None, :, None])
