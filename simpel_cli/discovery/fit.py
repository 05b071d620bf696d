"""Maximum a posteriori by damped Fisher scoring, and Laplace evidence, for a batch of hypotheses in one program.

    f(z) = 1/2 sum_k [ log s_k + e_k^2 / s_k ] - log p(z),    I = sum_k [ e' e'^T / s + 1/2 s' s'^T / s^2 ] + prior
    log Z = -f + d/2 log 2 pi - 1/2 log|H|

In unit coordinates every eigenvalue of H is at least 12, the inverse variance of a uniform prior: a shape that the data
do not see earns nothing. An unknown at its bound loses log 2: half of its mass lies outside.

Reference: Levenberg (1944), Marquardt (1963); Kass and Raftery (1995), Bayes factors, eq. 5.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.discovery.coordinates import Coordinates
from simpel_cli.discovery.filter import Filter
from simpel_cli.discovery.windows import Windows

LEAST_CURVATURE = 12.0
AT_BOUND = 1e-4
ENOUGH = 5e-3  # nats: a step that promises less ends a fit
MOST_REJECTED = 6  # steps in a row
MOST = 60  # iterations
FIRST_DAMPING = 1e-2


class Lane(NamedTuple):
    """One hypothesis: where to start, which unknowns move, and how much each window counts."""

    z: np.ndarray  # (n,) start of all unknowns
    free: tuple[int, ...]  # indices that move
    weight: np.ndarray  # (W,)


class Optimum(NamedTuple):
    """Where a hypothesis came to rest.

    Args:
        z: (n,) all unknowns.
        free: indices that moved.
        loss: negative log posterior.
        log_evidence: Laplace; -inf where the filter diverged.
        gradient: (d,) of the loss where it came to rest.
        fisher: (d, d) information with the prior's, unit coordinates.
        covariance: (d, d) of the free unknowns, unit coordinates.
        iterations: taken.
        converged: whether the last steps no longer helped.
    """

    z: np.ndarray
    free: tuple[int, ...]
    loss: float
    log_evidence: float
    gradient: np.ndarray
    fisher: np.ndarray
    covariance: np.ndarray
    iterations: int
    converged: bool


class Fitter:
    """Fits hypotheses; one compiled program for a batch of `lanes`, with up to `width` free unknowns each."""

    def __init__(
        self, rule: Filter, coordinates: Coordinates, windows: Windows, *, lanes: int = 8, width: int = 16
    ) -> None:
        self.coordinates, self.windows, self.lanes, self.width = coordinates, windows, lanes, width
        self._data = windows.arrays
        self._program = jax.jit(jax.vmap(partial(_fit, rule, coordinates), in_axes=(None, None, 0, 0, 0, 0, None)))

    def __call__(self, hypotheses: Sequence[Lane], most: int = MOST) -> list[Optimum]:
        """Fit every hypothesis, `lanes` at a time, with `most` iterations."""
        found: list[Optimum] = []
        for begin in range(0, len(hypotheses), self.lanes):
            chunk = list(hypotheses[begin : begin + self.lanes])
            padded = chunk + [chunk[0]] * (self.lanes - len(chunk))
            found += self._run(padded, most)[: len(chunk)]
        return found

    def _run(self, lanes: list[Lane], most: int) -> list[Optimum]:
        padding = len(self.coordinates.low) - 1
        index = np.full((len(lanes), self.width), padding)
        for i, lane in enumerate(lanes):
            if len(lane.free) > self.width:
                raise ValueError(f"{len(lane.free)} free unknowns, {self.width} at most")
            index[i, : len(lane.free)] = lane.free
        z = np.stack([lane.z for lane in lanes])
        weight = np.stack([lane.weight for lane in lanes])
        result = self._program(
            tuple(jnp.asarray(a) for a in self.coordinates.bounds),
            jnp.asarray(most),
            jnp.asarray(z),
            jnp.asarray(index),
            jnp.asarray(index != padding),
            jnp.asarray(weight),
            self._data,
        )
        z, loss, gradient, fisher, iterations, converged = (np.asarray(a) for a in result)
        return [
            _optimum(z[i], lane.free, loss[i], gradient[i], fisher[i], int(iterations[i]), bool(converged[i]))
            for i, lane in enumerate(lanes)
        ]


def _optimum(
    z: np.ndarray,
    free: tuple[int, ...],
    loss: float,
    gradient: np.ndarray,
    fisher: np.ndarray,
    iterations: int,
    converged: bool,
) -> Optimum:
    d = len(free)
    gradient, fisher = gradient[:d], fisher[:d, :d]
    if not np.isfinite(loss) or not np.isfinite(fisher).all():
        return Optimum(z, free, np.inf, -np.inf, 0 * gradient, np.eye(d), np.eye(d), iterations, False)
    values, vectors = np.linalg.eigh(fisher)
    values = np.maximum(values, LEAST_CURVATURE)
    at = z[list(free)]
    bounded = np.sum((at < AT_BOUND) | (at > 1 - AT_BOUND))
    evidence = -loss + d / 2 * np.log(2 * np.pi) - 0.5 * np.log(values).sum() - np.log(2) * bounded
    covariance = (vectors / values) @ vectors.T
    return Optimum(z, free, float(loss), float(evidence), gradient, fisher, covariance, iterations, converged)


def _fit(
    rule: Filter,
    coordinates: Coordinates,
    bounds: tuple[Array, ...],
    most: Array,
    z: Array,
    index: Array,
    moves: Array,
    weight: Array,
    data: Any,
) -> tuple[Array, ...]:
    """Levenberg-Marquardt on Fisher information, inside the unit box."""
    coordinates = coordinates.bounded(bounds)
    sd = coordinates.sd_of_prior()[index]
    normal = jnp.isfinite(sd) & moves
    inverse_variance = jnp.where(normal, 1 / sd**2, 0.0)
    log_norm = jnp.sum(jnp.where(normal, jnp.log(jnp.where(normal, sd, 1.0)) + 0.5 * np.log(2 * np.pi), 0.0))

    def innovations(part: Array, *window: Array) -> tuple[Array, Array]:
        p, noise = coordinates.physical(z.at[index].set(jnp.where(moves, part, z[index])))
        rows = jnp.where(index < p.shape[0], index, z.shape[0])  # a noise is no parameter of the model
        track = rule.track(p, rows, noise, *window)
        return track.innovation, track.variance

    def evaluate(part: Array) -> tuple[Array, Array, Array]:
        def window(y: Array, ok: Array, *rest: Array) -> tuple[Array, Array, Array]:
            def both(v: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
                out = innovations(v, y, ok, *rest)
                return out, out

            (de, ds), (e, s) = jax.jacfwd(both, has_aux=True)(part)
            e, s, ok_ = e.ravel(), s.ravel(), ok.ravel()
            de, ds = de.reshape(e.size, -1), ds.reshape(e.size, -1)
            s = jnp.where(ok_ > 0, s, 1.0)
            e = jnp.where(ok_ > 0, e, 0.0)
            de, ds = (jnp.where(ok_[:, None] > 0, a, 0.0) for a in (de, ds))
            loss = 0.5 * jnp.sum(ok_ * (jnp.log(s) + e * e / s))
            gradient = (e / s) @ de + 0.5 * ((1 / s - (e / s) ** 2) @ ds)
            fisher = (de / s[:, None]).T @ de + 0.5 * (ds / s[:, None] ** 2).T @ ds
            return loss, gradient, fisher

        losses, gradients, fishers = jax.vmap(window)(*data)
        away = part - 0.5
        loss = weight @ losses + 0.5 * jnp.sum(inverse_variance * away**2) + log_norm
        gradient = jnp.where(moves, weight @ gradients + inverse_variance * away, 0.0)
        both_move = moves[:, None] & moves[None, :]
        fisher = jnp.where(both_move, jnp.einsum("w,wij->ij", weight, fishers), 0.0) + jnp.diag(inverse_variance)
        finite = jnp.isfinite(loss) & jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(fisher))
        return jnp.where(finite, loss, jnp.inf), gradient, fisher

    def propose(part: Array, gradient: Array, fisher: Array, damping: Array) -> tuple[Array, Array]:
        """Return the next trial and the gain that the quadratic model promises."""
        out = ((part <= 0) & (gradient > 0)) | ((part >= 1) & (gradient < 0)) | ~moves
        free = ~out
        matrix = jnp.where(free[:, None] & free[None, :], fisher, 0.0)
        scale = jnp.maximum(jnp.diag(matrix), LEAST_CURVATURE)
        matrix = matrix + jnp.diag(jnp.where(free, (damping + 1e-9) * scale, 1.0))
        step = -jnp.linalg.solve(matrix, jnp.where(free, gradient, 0.0))
        longest = jnp.max(jnp.abs(step))
        step = step * jnp.minimum(1.0, 0.3 / jnp.maximum(longest, 1e-12))  # a third of the prior's range at most
        following = jnp.clip(part + step, 0.0, 1.0)
        step = following - part
        return following, -(gradient @ step) - 0.5 * step @ fisher @ step

    def body(carry: tuple) -> tuple:
        trial, part, loss, gradient, fisher, damping, iteration, _, rejected = carry
        new_loss, new_gradient, new_fisher = evaluate(trial)
        better = new_loss < loss
        keep = lambda a, b: jnp.where(better, a, b)  # noqa: E731
        part, loss = keep(trial, part), keep(new_loss, loss)
        gradient, fisher = keep(new_gradient, gradient), keep(new_fisher, fisher)
        damping = jnp.where(better, jnp.maximum(damping / 5, 1e-6), jnp.minimum(damping * 8, 1e8))
        rejected = jnp.where(better, 0, rejected + 1)
        following, promised = propose(part, gradient, fisher, damping)
        done = (promised < ENOUGH) | (rejected >= MOST_REJECTED)
        return following, part, loss, gradient, fisher, damping, iteration + 1, done, rejected

    def going(carry: tuple) -> Array:
        return (carry[6] < most) & ~carry[7]

    # the first pass takes the start for a trial, so that the filter is compiled once
    part, width = z[index], index.shape[0]
    begin = (
        part, part, jnp.asarray(jnp.inf), jnp.zeros(width), jnp.eye(width), jnp.asarray(FIRST_DAMPING),
        jnp.asarray(0), jnp.asarray(False), jnp.asarray(0),
    )  # fmt: skip
    _, part, loss, gradient, fisher, _, iteration, done, _ = jax.lax.while_loop(going, body, begin)
    return z.at[index].set(jnp.where(moves, part, z[index])), loss, gradient, fisher, iteration, done
