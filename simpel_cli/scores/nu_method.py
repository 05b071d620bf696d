"""Nonparametric score estimation in the space of a curl-free kernel: fields that are gradients, fitted by score matching.

    s = s_0 + d,    L d = -(zeta + L s_0),    zeta(h) = E[ div_x Gamma(x, h) ],    L f = E[ Gamma(., x) f(x) ]

with Gamma = -grad grad' f(|x - y|^2/s^2). The equation is ill posed, and solved by the nu-method, an accelerated gradient
descent that stops early, or by Tikhonov's. With s_0 the moment-matched Gaussian score (`baseline`) the fit holds only what is
not Gaussian; the published estimator has s_0 = 0.

Reference: Zhou, Shi and Zhu (2020), Nonparametric score estimators, secs. 3.2-3.4 and example 3.4; Engl, Hanke and
Neubauer (1996), Regularization of inverse problems, sec. 6.3 (the nu-method).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from simpel_cli.errors import ConfigError
from simpel_cli.scores import radial
from simpel_cli.scores.estimator import Estimator, Score
from simpel_cli.scores.gaussian import Gaussian

MOST_CONJUGATE = 2000  # steps of the linear solve of Tikhonov's variant
NEARLY = 1e-3  # of lambda: its relative residual


class Field(NamedTuple):
    """Curl-free kernel between two sets of points: Gamma = a I - b (x - y)(x - y)' and divergence c (x - y)."""

    a: Float[Array, "A B"]
    b: Float[Array, "A B"]
    c: Float[Array, "A B"]
    x: Float[Array, "A M"]
    y: Float[Array, "B M"]

    def apply(self, f: Float[Array, "B M"]) -> Float[Array, "A M"]:
        """Sum of Gamma(x, y) f(y) over y."""
        along = self.b * (self.x @ f.T - jnp.sum(self.y * f, axis=1)[None])
        return self.a @ f - jnp.sum(along, axis=1)[:, None] * self.x + along @ self.y

    def divergence(self) -> Float[Array, "A M"]:
        """Sum over y of the divergence of Gamma(y, x) in y."""
        return self.c @ self.y - jnp.sum(self.c, axis=1)[:, None] * self.x


@dataclass(frozen=True)
class NuMethod(Estimator):
    """Curl-free score estimator.

    Args:
        kernel: `imq` or `squared_exponential`.
        bandwidth: of the kernel; `median`: `wider` times the median distance between draws.
        wider: see `bandwidth`.
        regularisation: `nu` or `tikhonov`.
        weight: lambda; the nu-method takes 1 + 1/sqrt(lambda) steps.
        nu: of the nu-method, its qualification.
        centres: draws that the field is built on, at most.
        baseline: `gaussian`, or `none`: as published.
    """

    kernel: str = "imq"
    bandwidth: float | str = "median"
    wider: float = 2.0
    regularisation: str = "nu"
    weight: float = 1e-3
    nu: float = 1.0
    centres: int = 256
    baseline: str = "gaussian"

    gap_draws = True

    def __post_init__(self) -> None:
        radial.check(self.kernel, self.bandwidth, self.baseline)
        for name in ("wider", "weight", "nu"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"score.{name}: got {getattr(self, name)}; it must be positive.")
        if self.regularisation not in ("nu", "tikhonov"):
            raise ConfigError(f"score.regularisation: got {self.regularisation!r}; allowed are nu and tikhonov.")
        if self.centres < 2:
            raise ConfigError(f"score.centres: got {self.centres}; it must be at least 2.")

    def fitted(
        self,
        samples: Float[Array, "N M"],
        covariance: Float[Array, "M M"],
        gap: Float[Array, "N M"] | None = None,
    ) -> Score:
        """Return the score; see `Estimator`."""
        draws = (samples if gap is None else samples + gap)[: self.centres]
        n, middle = draws.shape[0], jnp.mean(draws, axis=0)[None]
        s = radial.width(self.bandwidth, self.wider, draws - middle)
        x = (draws - middle) / s
        start = Gaussian().fitted(samples, covariance) if self.baseline == "gaussian" else None
        base = jnp.zeros_like(x) if start is None else s * start(draws)
        among = field(self.kernel, x, x)
        zeta = among.divergence() / n
        a, c = (self._descend if self.regularisation == "nu" else self._tikhonov)(among, zeta, base)
        return jax.tree_util.Partial(self._at, middle, s, x, a, c, start)

    def _at(
        self,
        middle: Float[Array, "1 M"],
        s: Float[Array, ""],
        x: Float[Array, "N M"],
        a: Float[Array, ""],
        c: Float[Array, "N M"],
        start: Score | None,
        h: Float[Array, "L M"],
    ) -> Float[Array, "L M"]:
        here = field(self.kernel, (h - middle) / s, x)
        found = (a * here.divergence() / x.shape[0] + here.apply(c)) / s
        return found if start is None else start(h) + found

    def _descend(self, among: Field, zeta: Array, base: Array) -> tuple[Array, Array]:
        """Return (a, c) of d = a zeta + sum_n Gamma(., x_n) c_n after the steps of the nu-method."""
        n, nu = zeta.shape[0], self.nu

        def step(carry: tuple[Array, Array, Array, Array], t: Array) -> tuple[tuple[Array, Array, Array, Array], None]:
            a, c, a_before, c_before = carry
            # of its first step the nu-method needs no step before, whatever nu
            below = (t + 2 * nu - 1) * (2 * t + 4 * nu - 1) * jnp.where(t > 1, 2 * t + 2 * nu - 3, 1.0)
            u = (t - 1) * (2 * t - 3) * (2 * t + 2 * nu - 1) / below
            w = 4 * (2 * t + 2 * nu - 1) * (t + nu - 1) / ((t + 2 * nu - 1) * (2 * t + 4 * nu - 1))
            after = a + u * (a - a_before) - w
            d_after = c + u * (c - c_before) - w * (a * zeta + among.apply(c) + base) / n
            return (after, d_after, a, c), None

        nothing = jnp.zeros((), zeta.dtype), jnp.zeros_like(zeta)
        steps = jnp.arange(1, self.steps + 1, dtype=zeta.dtype)
        a, c, *_ = jax.lax.scan(step, (*nothing, *nothing), steps)[0]
        return a, c

    def _tikhonov(self, among: Field, zeta: Array, base: Array) -> tuple[Array, Array]:
        """Return the same of (L + lambda) d = -(zeta + L s_0): a = -1/lambda, (Gamma + n lambda) c = zeta/lambda - s_0."""
        n, dtype = zeta.shape[0], zeta.dtype
        among, zeta, base = jax.tree.map(lambda a: a.astype(jnp.float64), (among, zeta, base))

        def operator(c: Array) -> Array:
            return among.apply(c) + n * self.weight * c

        # what is left over of the right-hand side, which has 1/lambda in it, is an error of the score itself
        c, _ = jax.scipy.sparse.linalg.cg(
            operator, zeta / self.weight - base, tol=NEARLY * self.weight, maxiter=MOST_CONJUGATE
        )
        return jnp.asarray(-1 / self.weight, dtype), c.astype(dtype)

    @property
    def steps(self) -> int:
        """Steps of the nu-method."""
        return 1 + round(self.weight**-0.5)


def field(kernel: str, x: Float[Array, "A M"], y: Float[Array, "B M"]) -> Field:
    """Return the curl-free kernel, scaled to Gamma(x, x) = I, so that no eigenvalue of L exceeds 1."""
    q, m = radial.squared_distances(x, y), x.shape[1]
    f = radial.profile(kernel, q)
    unit = -2 * radial.profile(kernel, jnp.zeros((1,), q.dtype)).f1[0]
    # div_y of Gamma(y, x), with d = y - x: -d (4 (m + 2) f'' + 8 q f''')
    c = -(4 * (m + 2) * f.f2 + 8 * q * f.f3)
    return Field(-2 * f.f1 / unit, 4 * f.f2 / unit, c / unit, x, y)
