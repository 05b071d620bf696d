"""Expected gain in log evidence between fitted models from an episode that was not yet run.

Each model j is linearised along the episode that it predicts, with mean m_j, process and measurement noise V_j, and the
derivative A_j of the mean along the principal directions of its parameters' posterior, in standard deviations. What j
gives the measurements y is its prior predictive density, for its parameters may still move within their posterior:

    p_j(y) = N(y; m_j, V_j + A_j A_j'),    D_ij = E[log p_i(y) - log p_j(y)],  y ~ N(m_i, V_i)

D_ij is by how much the log evidence of i over j is expected to change when i, as fitted, is true. Without A it is the
Kullback-Leibler divergence, and without noise that differs the squared distance of T-optimality. A model may also call
what it does not explain process noise: p_j is a mixture over louder levels of it, weighted by what the data so far gave
them, and the expectation of a mixture's logarithm is taken inside of it.

Part of D_ij is that i and j disturb themselves differently. That is only as good as the linearisation: at standstill a dry
friction is linearised as a stiff damper, whose noise differs from all others. So the distance of the means is given, too, by
how much less j thinks of the mean of i than of its own, with its own noise about both:

    d_ij = E[log p_j(m_j + v) - log p_j(m_i + v)],  v ~ N(0, V_j)    (1/2 (m_i - m_j)' (V_j + A_j A_j')^-1 (m_i - m_j))

Everything is exact for linear models: the parameters are constant states of a Kalman filter, and one recursion follows
mean and covariance of true state and filter together.

Reference: Box and Hill (1967), Discrimination among mechanistic models, eq. 11 (predictive variances); Atkinson and
Fedorov (1975), The design of experiments for discriminating between two rival models (T-optimality, maximin over pairs).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float

from simpel_cli.filtering.likelihood.track import Filter, Noise

LOG_2PI = float(np.log(2 * np.pi))
Carry = tuple[Array, Array, Array]
BATCH = 8  # episodes that are worked on at once: bounds the memory


class Path(NamedTuple):
    """A model linearised along the episode that it predicts."""

    mean: Float[Array, "T ny"]  # of the measurements
    moved: Float[Array, "T ny d"]  # the mean's derivative along each direction of the parameters, per sd
    jacobian: Float[Array, "T nx nx"]  # of the transition to the next row
    slope: Float[Array, "T ny nx"]  # of what the sensors read, in the state


class Members(NamedTuple):
    """M fitted models.

    Args:
        p: (M, 1 + 2 d, dp) parameters: fitted, then each direction of the posterior one sd up, then each one down.
        r: (M, ny) measurement noise.
        q: (M, L, nx) levels of process noise, the fitted one first.
        log_weight: (M, L) log probability of each level.
    """

    p: Float[Array, "M points dp"]
    r: Float[Array, "M ny"]
    q: Float[Array, "M L nx"]
    log_weight: Float[Array, "M L"]


class Forecast(NamedTuple):
    """What the members predict for N episodes.

    Args:
        ratio: (N, M, M) expected log-likelihood ratio D of the first over the second when the first is true, nats.
        distance: (N, M, M) the part d of it that the means have, nats.
        mean: (N, M, T, ny) measurements, periodic ones within -pi..pi.
        states: (N, M, T, nx).
        finite: (N,) whether everything is.
    """

    ratio: Float[Array, "N M M"]
    distance: Float[Array, "N M M"]
    mean: Float[Array, "N M T ny"]
    states: Float[Array, "N M T nx"]
    finite: Bool[Array, " N"]


def forecast(
    rule: Filter,
    members: Members,
    u: Float[Array, "N R nu"],
    start: Float[Array, "N nx"],
    spread: Float[Array, " nx"],
    placed: Float[Array, " nx"],
    wraps: Bool[Array, " ny"],
    *,
    rows: int,
    dt: float,
) -> Forecast:
    """Evaluate episodes.

    Args:
        rule: the filter of the augmented model.
        members: the models.
        u: inputs, the rows of the past in front.
        start: first states.
        spread: standard deviation of the first state, as the filter will take it to be known.
        placed: standard deviation with which the first state will differ from `start`.
        wraps: which measurements are periodic.
        rows: T, of an episode.
        dt: distance of the rows, s.
    """
    ny, nx = members.r.shape[1], start.shape[1]
    d = (members.p.shape[1] - 1) // 2
    nothing = jnp.zeros((rows, ny), start.dtype)
    silent = Noise(jnp.ones(ny, start.dtype), jnp.zeros(nx, start.dtype))

    def one(episode: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
        inputs, x = episode

        def run(p: Array) -> tuple[Array, Array, Array, Array]:
            # nothing is measured: what the filter predicts is the model alone, late sensors included
            track, _ = rule.track(p, silent, nothing, nothing, inputs, x, jnp.zeros_like(x))
            return -track.innovation, track.predicted, track.jacobian, track.slope

        mean, states, jacobian, slope = jax.vmap(jax.vmap(run))(members.p)
        up, down = mean[:, 1 : 1 + d], mean[:, 1 + d :]
        moved = jnp.moveaxis(wrapped(up - down, wraps) / 2, 1, -1)
        paths = Path(mean[:, 0], moved, jacobian[:, 0], slope[:, 0])

        def judge(true: Path, r: Array, q: Array, path: Path, own_r: Array, own_q: Array, weight: Array) -> Array:
            def level(value: Array) -> Array:
                noises = Noise(r, q), Noise(own_r, value)
                return expected_log_density((true, path), noises, spread, placed, wraps, dt)

            return logsumexp(weight + jax.vmap(level)(own_q))

        by_judge = jax.vmap(judge, in_axes=(None, None, None, 0, 0, 0, 0))
        density = jax.vmap(by_judge, in_axes=(0, 0, 0, None, None, None, None))(
            paths, members.r, members.q[:, 0], paths, members.r, members.q, members.log_weight
        )

        def shifted(true: Array, path: Path, r: Array, q: Array, weight: Array) -> Array:
            return judge(path._replace(mean=true), r, q[0], path, r, q, weight)

        by_shift = jax.vmap(shifted, in_axes=(None, 0, 0, 0, 0))
        aside = jax.vmap(by_shift, in_axes=(0, None, None, None, None))(
            paths.mean, paths, members.r, members.q, members.log_weight
        )
        own = jnp.diag(density)
        return own[:, None] - density, own[None, :] - aside, mean[:, 0], states[:, 0]

    ratio, distance, mean, states = jax.lax.map(one, (u, start), batch_size=BATCH)
    finite = jnp.isfinite(ratio).all((1, 2)) & jnp.isfinite(states).all((1, 2, 3)) & jnp.isfinite(mean).all((1, 2, 3))
    return Forecast(ratio, distance, mean, states, finite)


def expected_log_density(
    paths: tuple[Path, Path],
    noises: tuple[Noise, Noise],
    spread: Float[Array, " nx"],
    placed: Float[Array, " nx"],
    wraps: Bool[Array, " ny"],
    dt: float,
) -> Float[Array, ""]:
    """Return the expected log density of a second model for measurements that the first one makes, nats.

    Args:
        paths: of the true model and of the judge.
        noises: of both.
        spread: standard deviation of the first state, for the judge.
        placed: and in truth.
        wraps: which measurements are periodic.
        dt: distance of the rows, s.
    """
    true, judge = paths
    nx, d, ny = spread.shape[0], judge.moved.shape[-1], true.mean.shape[1]
    still = jnp.zeros(d, spread.dtype)
    half_true, half = jnp.diag(noises[0].q ** 2) * (dt / 2), jnp.diag(noises[1].q ** 2) * (dt / 2)
    apart = wrapped(true.mean - judge.mean, wraps)

    def row(carry: Carry, data: tuple[Array, Path, Path]) -> tuple[Carry, Array]:
        # estimate of (state, parameters), its covariance as claimed, covariance of (true state, estimate)
        estimate, claimed, joint = carry
        away, here, mine = data
        total = jnp.zeros((), spread.dtype)
        for j in range(ny):
            read = jnp.concatenate([mine.slope[j], mine.moved[j]])
            both = jnp.concatenate([here.slope[j], -read])
            gain = claimed @ read
            s = read @ gain + noises[1].r[j] ** 2
            e = away[j] - read @ estimate
            seen = joint @ both
            variance = both @ seen + noises[0].r[j] ** 2
            total = total - 0.5 * (LOG_2PI + jnp.log(s) + (e**2 + variance) / s)
            gain = gain / s
            push = jnp.concatenate([jnp.zeros(nx, spread.dtype), gain])
            joint = joint + _outer(push, seen) + _outer(seen, push) + variance * _outer(push, push)
            claimed = claimed - s * _outer(gain, gain)
            estimate = estimate + gain * e
        move = _block(mine.jacobian, jnp.eye(d, dtype=spread.dtype))
        quiet = jnp.zeros((d, d), spread.dtype)
        noise, noise_true = _block(half, quiet), _block(half_true, jnp.zeros_like(claimed))
        move_both = _block(here.jacobian, move)
        claimed = move @ (claimed + noise) @ move.T + noise
        joint = move_both @ (joint + noise_true) @ move_both.T + noise_true
        return (move @ estimate, claimed, joint), total

    first = jnp.diag(jnp.concatenate([spread**2, still + 1]))
    scatter = jnp.diag(jnp.concatenate([placed**2, jnp.zeros_like(spread), still]))
    begin = (jnp.concatenate([jnp.zeros_like(spread), still]), first, scatter)
    return jnp.sum(jax.lax.scan(row, begin, (apart, true, judge))[1])


def wrapped(difference: Float[Array, "*n ny"], wraps: Bool[Array, " ny"]) -> Float[Array, "*n ny"]:
    """Return differences of measurements, of periodic ones the short way round."""
    around = jnp.broadcast_to(wraps, difference.shape)
    return jnp.where(around, jnp.mod(difference + jnp.pi, 2 * jnp.pi) - jnp.pi, difference)


def _outer(a: Array, b: Array) -> Array:
    return a[:, None] * b[None, :]


def _block(a: Array, b: Array) -> Array:
    return jax.scipy.linalg.block_diag(a, b)
