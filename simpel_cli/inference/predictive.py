"""The predictive distribution: an equal-weight mixture of one law of noise per particle.

p(y | x) = 1/L sum_l prod_i p_i((y_i - h_li(x)) / sigma_i) / sigma_i,    p_i Gaussian or Student's t (`student_t`)

Of a sensor that saturates a value at an end has the mass there or beyond in place of the density (`sensor_ends`).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.inference import sensor_ends, student_t
from simpel_cli.inference.noise import Numbers


class Predictive(NamedTuple):
    """Predictions of L particles at n inputs, in data units.

    Args:
        particles: function values.
        noise_scale: scale of the observation noise, shared by the particles: of a Gaussian its standard deviation. (dy,), the
            same in every row, or (n, dy), one of every row.
        tail: 1/nu of Student's t, positive; None: the noise is Gaussian.
        limits: lowest and highest reading of every output's sensor, infinite where there is no end; None: no sensor saturates.
            `log_prob`, `cdf`, `pit`, `within` and `crps` are those of the reading; mean, standard deviation and `mahalanobis`
            are those of the quantity with its noise.
    """

    particles: Float[Array, "L n dy"]
    noise_scale: Float[Array, "*rows dy"]
    tail: Float[Array, " dy"] | None = None
    limits: Float[Numbers, "dy 2"] | None = None

    @property
    def noise_std(self) -> Float[Array, "*rows dy"]:
        """Standard deviation of the observation noise, of the shape of its scale."""
        scale = jnp.asarray(self.noise_scale)
        tail = self.tail if self.tail is None or scale.ndim == 1 else self.tail[None]
        return student_t.standard_deviation(scale, tail)

    @property
    def _scales(self) -> Float[Array, "rows dy"]:
        """Scale of the noise row by row; one row where it is the same in all."""
        scale = jnp.asarray(self.noise_scale)
        return scale if scale.ndim == 2 else scale[None]

    @property
    def _noise_variance(self) -> Float[Array, "rows dy"]:
        """Variance of the noise row by row; one row where it is the same in all."""
        std = self.noise_std
        return (std if std.ndim == 2 else std[None]) ** 2

    def counting(self, precision: Float[Array, "n dy"]) -> "Predictive":
        """Return the predictive of targets whose noise has a variance so many times smaller."""
        return self._replace(noise_scale=self._scales / jnp.sqrt(precision))

    @property
    def mean(self) -> Float[Array, "n dy"]:
        """Mean of the mixture."""
        return jnp.mean(self.particles, axis=0)

    @property
    def epistemic_std(self) -> Float[Array, "n dy"]:
        """Standard deviation between the particles: what more data would remove."""
        return jnp.std(self.particles, axis=0)

    @property
    def std(self) -> Float[Array, "n dy"]:
        """Standard deviation of the mixture: epistemic and noise."""
        return jnp.sqrt(jnp.var(self.particles, axis=0) + self._noise_variance)

    def log_prob(self, y: Float[Array, "n dy"]) -> Float[Array, " n"]:
        """Log density of the mixture, joint over outputs."""
        return _mixture(jnp.sum(self._log_readings(y), axis=-1))

    def log_prob_per_output(self, y: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
        """Log density of each output's marginal mixture."""
        return _mixture(self._log_readings(y))

    def _log_readings(self, y: Float[Array, "n dy"]) -> Float[Array, "L n dy"]:
        """Log density of what a sensor reads, at an end of it the log of the mass there or beyond."""
        within = self._log_densities(y)
        if self.limits is None:
            return within
        tail = None if self.tail is None else self.tail[None, None]
        at_low, at_high = sensor_ends.ends(jnp.asarray(self.limits), y)
        below, above = (sensor_ends.log_cdf(side * self._standardised(y), tail) for side in (1, -1))
        return jnp.where(at_low[None], below, jnp.where(at_high[None], above, within))

    def _log_densities(self, y: Float[Array, "n dy"]) -> Float[Array, "L n dy"]:
        z = self._standardised(y)
        if self.tail is None:
            return -0.5 * z * z - jnp.log(self._scales)[None] - 0.5 * jnp.log(2 * jnp.pi).astype(z.dtype)
        return student_t.log_density(z, self.tail[None, None]) - jnp.log(self._scales)[None]

    def _standardised(self, y: Float[Array, "n dy"]) -> Float[Array, "L n dy"]:
        return (y[None] - self.particles) / self._scales[None]

    def cdf(self, y: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
        """Cumulative distribution of each output's reading at y; of the mixture itself, where no sensor saturates."""
        found = self._cdf(y)
        if self.limits is None:
            return found
        _, at_high = sensor_ends.ends(jnp.asarray(self.limits), y)
        under = y < jnp.asarray(self.limits)[None, :, 0].astype(y.dtype)
        return jnp.where(at_high, 1.0, jnp.where(under, 0.0, found))

    def _cdf(self, y: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
        z = self._standardised(y)
        below = jax.scipy.stats.norm.cdf(z) if self.tail is None else student_t.cdf_of_outputs(z, self.tail)
        return jnp.mean(below, axis=0)

    def pit(self, y: Float[Array, "n dy"]) -> tuple[Float[Array, "n dy"], Float[Array, "n dy"]]:
        """Probability integral transforms of y, from F(y-) to F(y): `cdf`, and at an end of a sensor all of the mass there."""
        found = self._cdf(y)
        if self.limits is None:
            return found, found
        at_low, at_high = sensor_ends.ends(jnp.asarray(self.limits), y)
        return jnp.where(at_low, 0.0, found), jnp.where(at_high, 1.0, found)

    def within(self, y: Float[Array, "n dy"], levels: Float[Array, " k"]) -> Float[Array, "n k"]:
        """Return whether y lies in the region of the smallest Mahalanobis distances that holds these shares of the mass.

        A reading at an end counts by the share of what it may hide that lies there: of every particle, by the likelihood that
        it gives to y, what is beyond the end. The share of a distance is that of a chi-squared variable, or `share_within`.
        """
        share = self._chi_squared_share if self.tail is None else self._share_of(512)

        def inside(y: Float[Array, "n dy"]) -> Float[Array, "n k"]:
            return (share(y)[:, None] <= levels[None]).astype(y.dtype)

        if self.limits is None:
            return inside(y)
        scale = jnp.broadcast_to(self._scales, y.shape)
        values = sensor_ends.hidden(self.particles, scale, self.tail, jnp.asarray(self.limits), y)
        belief = jax.nn.softmax(jnp.sum(self._log_readings(y), axis=-1), axis=0)
        of_particles = jax.lax.map(lambda own: jnp.mean(jax.lax.map(inside, own), axis=0), values)
        return jnp.sum(belief[:, :, None] * of_particles, axis=0)

    def reading(self, value: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
        """Return what sensors make of a value."""
        if self.limits is None:
            return value
        low, high = jnp.asarray(self.limits).astype(value.dtype).T
        return jnp.clip(value, low[None], high[None])

    def crps(self, y: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
        """Continuous ranked probability score of each output, in its unit; lower is better.

        Reference: Grimit, Gneiting, Berrocal and Johnson (2006), the closed form for Gaussian mixtures; for those of
        Student's t the same difference of expectations.
        """
        sigma = self._scales
        if self.tail is None:

            def spread(member: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
                return jnp.mean(_expected_abs(member[None] - self.particles, 2**0.5 * sigma[None]), axis=0)

            to_data = jnp.mean(_expected_abs(y[None] - self.particles, sigma[None]), axis=0)
        else:
            grid, table = student_t.distance_table(self.tail)

            def spread(member: Float[Array, "n dy"]) -> Float[Array, "n dy"]:
                apart = jnp.abs(member[None] - self.particles) / sigma[None]
                near = jax.vmap(lambda a, t: jnp.interp(a, grid, t), in_axes=(2, 0), out_axes=2)(apart, table)
                return jnp.mean(jnp.where(apart < grid[-1], near, apart), axis=0) * sigma

            distance = student_t.expected_distance(self._standardised(y), self.tail)
            to_data = jnp.mean(distance, axis=0) * sigma
        between = jnp.mean(jax.lax.map(spread, self.particles), axis=0)
        found = to_data - 0.5 * between
        if self.limits is None:
            return found
        limits, scale = jnp.asarray(self.limits), jnp.broadcast_to(jnp.asarray(self.noise_scale), y.shape)
        clipped = sensor_ends.crps(self.particles, scale, self.tail, limits, y)
        return jnp.where(jnp.isfinite(limits).any(axis=1)[None], clipped, found)

    def mahalanobis(self, y: Float[Array, "n dy"]) -> Float[Array, " n"]:
        """Squared Mahalanobis distance of y under the mixture's mean and covariance (chi-squared with dy if Gaussian)."""
        return self._distance()(y)

    def _chi_squared_share(self, y: Float[Array, "n dy"]) -> Float[Array, " n"]:
        """Share of a chi-squared variable's mass below the Mahalanobis distance of y."""
        distance = self.mahalanobis(y)
        found: Array = jax.scipy.special.gammainc(jnp.full_like(distance, y.shape[1] / 2), distance / 2)
        return found

    def share_within(self, y: Float[Array, "n dy"], draws: int = 512) -> Float[Array, " n"]:
        """Share of the mixture's mass with a smaller Mahalanobis distance than y, strictly between 0 and 1.

        Where the noise has heavy tails that distance has no law in closed form: it is compared with those of draws.
        """
        return self._share_of(draws)(y)

    def _share_of(self, draws: int) -> Callable[[Float[Array, "n dy"]], Float[Array, " n"]]:
        key_particle, key_noise = jax.random.split(jax.random.key(0))
        _, n, dy = self.particles.shape
        dtype, distance = self.particles.dtype, self._distance()
        chosen = jax.random.randint(key_particle, (draws, n), 0, self.particles.shape[0], jnp.int32)
        centres = jnp.take_along_axis(self.particles, chosen[:, :, None], axis=0)
        if self.tail is None:
            noise = jax.random.normal(key_noise, (draws, n, dy), dtype)
        else:
            noise = student_t.draws(key_noise, (draws, n), self.tail.astype(dtype))
        others = distance(centres + self._scales[None] * noise)

        def share(y: Float[Array, "n dy"]) -> Float[Array, " n"]:
            nearer = jnp.sum((others < distance(y)[None]).astype(y.dtype), axis=0)
            return (nearer + 0.5) / (draws + 1)

        return share

    def _distance(self) -> Callable[[Float[Array, "*k n dy"]], Float[Array, "*k n"]]:
        """Return squared distances from the mixture's mean, in units of its covariance; that is factored once."""
        centred = self.particles - self.mean[None]
        covariance = jnp.einsum("lni,lnj->nij", centred, centred) / self.particles.shape[0]
        covariance = (
            covariance + self._noise_variance[:, :, None] * jnp.eye(centred.shape[2], dtype=centred.dtype)[None]
        )
        factor = jnp.linalg.cholesky(covariance)
        eye = jnp.broadcast_to(jnp.eye(factor.shape[1], dtype=factor.dtype)[None], factor.shape)
        root = jax.scipy.linalg.solve_triangular(factor, eye, lower=True)

        def squared(y: Float[Array, "*k n dy"]) -> Float[Array, "*k n"]:
            mean = self.mean.reshape((1,) * (y.ndim - 2) + self.mean.shape)
            white = jnp.einsum("nij,...nj->...ni", root, y - mean, precision=jax.lax.Precision.HIGHEST)
            return jnp.sum(white**2, axis=-1)

        return squared


def _mixture(log_densities: Float[Array, "L *n"]) -> Float[Array, "*n"]:
    return jax.scipy.special.logsumexp(log_densities, axis=0) - jnp.log(float(log_densities.shape[0])).astype(
        log_densities.dtype
    )


def _expected_abs(mu: Float[Array, "*n"], sigma: Float[Array, "*m"]) -> Float[Array, "*n"]:
    """E|X| for X ~ N(mu, sigma^2)."""
    z = mu / sigma
    density = jnp.exp(-0.5 * z * z) / (2 * jnp.pi) ** 0.5
    return 2 * sigma * density + mu * (2 * jax.scipy.special.ndtr(z) - 1)
