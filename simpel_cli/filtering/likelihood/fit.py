"""Maximum a posteriori by damped Fisher scoring, and Laplace evidence, for a batch of hypotheses in one program.

    f(z) = 1/2 sum_k [ log s_k + e_k^2 / s_k ] - log p(z),    I = sum_k [ e' e'^T / s + 1/2 s' s'^T / s^2 ] + prior
    log Z = -f + d/2 log 2 pi - 1/2 log|H|

In unit coordinates every eigenvalue of H is at least 12, the inverse variance of a uniform prior: a shape that the data
do not see earns nothing. An unknown at its bound loses log 2: half of its mass lies outside.

Reference: Kass and Raftery (1995), Bayes factors, eq. 5.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.filtering.likelihood.coordinates import Coordinates
from simpel_cli.filtering.likelihood.filter import MOST_KEPT
from simpel_cli.filtering.likelihood.steps import FIRST_DAMPING, LEAST_CURVATURE, REFUSED, Course, stepped
from simpel_cli.filtering.likelihood.track import Filter, Noise
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.runs.programs import Program

AT_BOUND = 1e-4
MOST = 40  # iterations
ROUND = 4  # iterations after which fits that have arrived make room for others
SLOW = 0.1  # nats: a round that gains less, with a step that helped at its end, ends a fit that crawls along a valley
STUCK = 1.0  # nats: a fit that ends where a Newton step promises more goes on once, as if it began there
POINTS = 16  # windows of all fits of one program: of more, what a row leaves behind does not stay in the cache


class Hypothesis(NamedTuple):
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
        centre: (d,) mean of the posterior as a Gaussian. A uniform prior enters with its mean and variance: in a
            direction that the data do not see, the optimum may lie anywhere.
        covariance: (d, d) of the free unknowns about it, unit coordinates.
        iterations: taken.
        converged: whether the last steps no longer helped.
        left: whether it was left on the way, where others were ahead.
    """

    z: np.ndarray
    free: tuple[int, ...]
    loss: float
    log_evidence: float
    gradient: np.ndarray
    fisher: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray
    iterations: int
    converged: bool
    left: bool = False

    @property
    def step(self) -> float:
        """What one Newton step promises from here, of unknowns at a bound only inwards, nats; inf where nothing is known."""
        if not np.isfinite(self.fisher).all() or not np.isfinite(self.loss):
            return np.inf
        at, g = self.z[list(self.free)], self.gradient
        inward = ~(((at <= 0) & (g >= 0)) | ((at >= 1) & (g <= 0)))
        try:
            values, axes = np.linalg.eigh(self.fisher[np.ix_(inward, inward)])
        except np.linalg.LinAlgError:  # from a start that is far off curvatures differ by more than numbers can tell
            return np.inf
        # with the prior's; rounding beside a very large curvature may have made others negative
        return float(0.5 * np.sum((axes.T @ g[inward]) ** 2 / (np.maximum(values, 0.0) + LEAST_CURVATURE)))


Watch = Callable[[int, int], None]
Hopes = Callable[[Sequence[Optimum]], Sequence[bool]]  # where fits stand -> which are worth going on with


class Fitter:
    """Fits hypotheses; one compiled program for a batch of at most `side_by_side`, with up to `width` free unknowns each.

    Batches run on as many threads as there are cores. After a few iterations the fits that have arrived make room for
    those that wait, always in the same order: a result does not depend on the number of threads. `watch` is told before every
    round how many have ended, of how many, and 0 of 0 in the end.
    """

    watch: Watch | None = None

    def __init__(
        self, rule: Filter, coordinates: Coordinates, windows: Windows, *, side_by_side: int = 4, width: int = 16
    ) -> None:
        self.coordinates, self.windows, self.width = coordinates, windows, width
        self.side_by_side = max(1, min(side_by_side, POINTS // len(windows.episode)))
        self._data = tuple(jnp.moveaxis(a, 0, -1) for a in windows.arrays)
        self._program = _program(rule, coordinates.layout)
        self._bounds = tuple(jnp.asarray(a) for a in coordinates.bounds)
        self._threads = ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2)

    def __call__(self, hypotheses: Sequence[Hypothesis], most: int = MOST, hopes: Hopes | None = None) -> list[Optimum]:
        """Fit every hypothesis with `most` iterations; after every round those go on of which `hopes` says so."""
        if not hypotheses:
            return []
        state = self._begin(hypotheses)
        waiting = np.arange(len(hypotheses))
        left, anew, arrived = np.zeros((3, len(hypotheses)), bool)
        while waiting.size:
            if self.watch is not None:
                self.watch(len(hypotheses) - len(waiting), len(hypotheses))
            before = state.loss[waiting]
            chunks = [waiting[i : i + self.side_by_side] for i in range(0, len(waiting), self.side_by_side)]
            for chunk, ended in zip(
                chunks, self._threads.map(partial(self._advanced, state, most), chunks), strict=True
            ):
                for old, new in zip(state, ended, strict=True):
                    old[chunk] = new[: len(chunk)]
            both = np.isfinite(before) & np.isfinite(state.loss[waiting])
            gained = np.subtract(before, state.loss[waiting], where=both, out=np.full(len(waiting), np.inf))
            # a step that helped with the damping of a refusal is short, whatever is left to gain
            crawls = (gained < SLOW) & (state.rejected[waiting] == 0) & (state.damping[waiting] <= FIRST_DAMPING)
            over = state.done[waiting] | crawls
            # refusals damp steps until they promise nothing: once more from there, with a step of usual length
            once = waiting[over & ~anew[waiting] & (state.iteration[waiting] < most)].tolist()
            again = [i for i in once if STUCK < self._optimum(state, i, hypotheses[i].free).step < np.inf]
            arrived |= state.done
            state.done[again], state.rejected[again], anew[again] = False, 0, True
            state.trial[again], state.damping[again] = state.part[again], FIRST_DAMPING / REFUSED
            waiting = waiting[(~over | np.isin(waiting, again)) & (state.iteration[waiting] < most)]
            if hopes is not None and waiting.size:
                hopeful = hopes(self._optima(state, hypotheses))
                left[waiting] = [not hopeful[i] and i not in again for i in waiting]
                waiting = waiting[~left[waiting]]
        if self.watch is not None:
            self.watch(0, 0)
        state.done[:] |= arrived  # also where it went on once more, and was slow
        return [o._replace(left=bool(gone)) for o, gone in zip(self._optima(state, hypotheses), left, strict=True)]

    def _optima(self, state: Course, hypotheses: Sequence[Hypothesis]) -> list[Optimum]:
        return [self._optimum(state, i, hypothesis.free) for i, hypothesis in enumerate(hypotheses)]

    def on(self, windows: Windows) -> "Fitter":
        """Return the same fitter for windows of the same shape; it shares the compiled program."""
        return self._but(windows=windows, _data=tuple(jnp.moveaxis(a, 0, -1) for a in windows.arrays))

    def within(self, coordinates: Coordinates) -> "Fitter":
        """Return the same fitter with other bounds and priors of the same unknowns; it shares the compiled program."""
        return self._but(coordinates=coordinates, _bounds=tuple(jnp.asarray(a) for a in coordinates.bounds))

    def of_noise(self) -> "Fitter":
        """Return the same fitter with room for the levels of noise alone: a program of its own, which is quicker."""
        return self._but(width=len(self._noise) + 1)  # the last one never moves

    def _but(self, **changed: Any) -> "Fitter":
        vars(other := copy(self)).update(changed)
        return other

    def _begin(self, hypotheses: Sequence[Hypothesis]) -> Course:
        padding = len(self.coordinates.low) - 1
        noise = self._noise
        index = np.full((len(hypotheses), self.width), padding)
        index[:, : len(noise)] = noise
        moves = np.zeros(index.shape, bool)
        for i, hypothesis in enumerate(hypotheses):
            columns = self._columns(hypothesis.free)
            if max(columns, default=0) >= self.width:
                raise ValueError(
                    f"{len(hypothesis.free)} free unknowns, room for {self.width - len(noise)} beside the noise"
                )
            index[i, columns] = hypothesis.free
            moves[i, columns] = True
        z = np.stack([hypothesis.z for hypothesis in hypotheses])
        part = np.take_along_axis(z, index, axis=1)
        count, width = index.shape
        return Course(
            z, index, moves, np.stack([hypothesis.weight for hypothesis in hypotheses]), part.copy(), part,
            np.full(count, np.inf), np.zeros((count, width)), np.tile(np.eye(width), (count, 1, 1)),
            np.full(count, FIRST_DAMPING), np.zeros(count, int), np.zeros(count, bool), np.zeros(count, int),
        )  # fmt: skip

    @property
    def _noise(self) -> range:
        n_p, n_r, n_q = self.coordinates.sizes
        return range(n_p, n_p + n_r + n_q)

    def _columns(self, free: Sequence[int]) -> list[int]:
        """Columns of the program that free unknowns take: a level of noise its own, others the next one."""
        noise = self._noise
        others = iter(range(len(noise), len(noise) + len(free)))
        return [i - noise.start if i in noise else next(others) for i in free]

    def _advanced(self, state: Course, most: int, chunk: np.ndarray) -> list[np.ndarray]:
        filled = np.concatenate([chunk, np.repeat(chunk[:1], self.side_by_side - len(chunk))])
        course = Course(*(jnp.asarray(a[filled]) for a in state))
        with jax.enable_x64(True):
            ended = self._program(self._bounds, jnp.asarray(min(most, ROUND)), course, self._data)
        return [np.asarray(a) for a in ended]

    def _optimum(self, state: Course, i: int, free: tuple[int, ...]) -> Optimum:
        z = state.z[i].copy()
        columns = self._columns(free)
        z[list(free)] = state.part[i, columns]
        uniform = ~self.coordinates.normal[list(free)]
        return _optimum(
            z, free, uniform, float(state.loss[i]), state.gradient[i][columns], state.fisher[i][np.ix_(columns, columns)],
            int(state.iteration[i]), bool(state.done[i]),
        )  # fmt: skip


def _optimum(
    z: np.ndarray, free: tuple[int, ...], uniform: np.ndarray, loss: float, gradient: np.ndarray, fisher: np.ndarray,
    iterations: int, converged: bool,
) -> Optimum:  # fmt: skip
    d = len(free)
    if not np.isfinite(loss) or not np.isfinite(fisher).all():
        return Optimum(z, free, np.inf, -np.inf, 0 * gradient, np.eye(d), z[list(free)], np.eye(d), iterations, False)
    values = np.maximum(np.linalg.eigvalsh(fisher), LEAST_CURVATURE)
    at = z[list(free)]
    prior = np.where(uniform, LEAST_CURVATURE, 0.0)
    # with both priors no eigenvalue is less, but for rounding beside very large ones
    wide, axes = np.linalg.eigh(fisher + np.diag(prior))
    covariance = (axes / np.maximum(wide, LEAST_CURVATURE)) @ axes.T
    centre = at - covariance @ (prior * (at - 0.5))
    bounded = np.sum((at < AT_BOUND) | (at > 1 - AT_BOUND))
    evidence = -loss + d / 2 * np.log(2 * np.pi) - 0.5 * np.log(values).sum() - np.log(2) * bounded
    return Optimum(z, free, float(loss), float(evidence), gradient, fisher, centre, covariance, iterations, converged)


Evaluate = Callable[[Array], tuple[Array, Array, Array]]


@lru_cache(maxsize=MOST_KEPT)
def _program(rule: Filter, layout: tuple[Any, ...]) -> Program:
    return Program(partial(_advance, rule, layout), f"fit of {rule.name} {layout}", (Course,))


def _advance(
    rule: Filter, layout: tuple[Any, ...], bounds: tuple[Array, ...], most: Array, course: Course, data: Any
) -> Course:
    """Levenberg-Marquardt on Fisher information, inside the unit box: `most` iterations of every hypothesis."""
    coordinates = Coordinates.of(bounds, layout)
    evaluate = partial(_evaluate, rule, coordinates, course, data)

    def body(carry: tuple[Course, Array]) -> tuple[Course, Array]:
        now, count = carry
        found = evaluate(now.trial)
        return jax.vmap(stepped)(now, *found), count + 1

    def going(carry: tuple[Course, Array]) -> Array:
        return (carry[1] < most) & ~jnp.all(carry[0].done)

    return jax.lax.while_loop(going, body, (course, jnp.asarray(0)))[0]


def _evaluate(
    rule: Filter, coordinates: Coordinates, course: Course, data: Any, part: Array
) -> tuple[Array, Array, Array]:
    """Negative log posterior (L,), its gradient (L, width) and Fisher information (L, width, width)."""
    count = part.shape[0]
    y, ok, u, start, spread = data
    windows = start.shape[-1]
    # hypotheses times windows are the points of the filter, all windows of a hypothesis side by side
    tiled = [jnp.tile(a, (1,) * (a.ndim - 1) + (count,)) for a in (y, ok, u, start, spread)]
    z = jax.vmap(lambda z, i, v, m: z.at[i].set(jnp.where(m, v, z[i])))(course.z, course.index, part, course.moves)

    each = partial(jnp.repeat, repeats=windows, axis=-1)
    physical = jax.vmap(coordinates.physical, out_axes=-1)
    n_p, n_r, n_q = coordinates.sizes
    p, noise = physical(z)
    loud = Noise(*map(each, noise))
    track, held = rule.track(each(p), loud, *tiled)
    _, ok, u, _, spread = tiled
    index = course.index[:, n_r + n_q :].T
    rows = jnp.where(index < n_p, index, n_p)  # padding is no parameter of the model
    ways, pushes = rule.pushes(each(p), rows, track, held, u)

    def speed(i: Array) -> Array:
        """By how much a parameter moves with its unknown."""
        direction = jax.vmap(lambda i: jnp.zeros(z.shape[1]).at[i].set(1.0))(i)
        moved = jax.jvp(lambda z: physical(z)[0], (z,), (direction,))[1]
        return each(jnp.take_along_axis(moved, jnp.minimum(i, n_p - 1)[None], axis=0)[0])

    def louder(direction: Array) -> Noise:
        moved = jax.jvp(lambda z: physical(z)[1], (z,), (jnp.broadcast_to(direction, z.shape),))[1]
        return Noise(*map(each, moved))

    levels = jnp.zeros((n_r + n_q, z.shape[1])).at[jnp.arange(n_r + n_q), n_p + jnp.arange(n_r + n_q)].set(1.0)
    de, ds = rule.slopes(each(p), loud, jax.vmap(louder)(levels), track, held, ok, ways, pushes)
    moves = jnp.concatenate([jnp.ones((n_r + n_q, *spread.shape[1:])), jax.vmap(speed)(index)])[:, None, None]
    de, ds = de * moves, ds * moves
    ok = ok > 0
    s = jnp.where(ok, track.variance, 1.0)
    e = jnp.where(ok, track.innovation, 0.0)
    de, ds = (jnp.where(ok[None], a, 0.0) for a in (de, ds))
    weight = course.weight.reshape(-1)

    def per_hypothesis(a: Array) -> Array:
        """(..., T, ny, L W) -> (L, ..., T ny W)."""
        lead = a.shape[:-3]
        apart = a.reshape(*lead, -1, count, windows)
        return jnp.moveaxis(apart, -2, 0).reshape(count, *lead, -1)

    loss = jnp.sum(per_hypothesis(jnp.where(ok, 0.5 * weight[None, None] * (jnp.log(s) + e * e / s), 0.0)), axis=1)
    first = per_hypothesis(weight[None, None] * (e / s))
    second = per_hypothesis(0.5 * weight[None, None] * (1 / s - (e / s) ** 2))
    slopes, spreads = per_hypothesis(de), per_hypothesis(ds)
    gradient = jnp.einsum("ldk,lk->ld", slopes, first) + jnp.einsum("ldk,lk->ld", spreads, second)
    root = per_hypothesis(jnp.sqrt(weight[None, None] / s))[:, None]
    scaled = jnp.concatenate([slopes * root, spreads * root * per_hypothesis(jnp.sqrt(0.5 / s))[:, None]], axis=2)
    fisher = jnp.einsum("ldk,lek->lde", scaled, scaled)

    sd = coordinates.sd_of_prior()[course.index]
    normal = jnp.isfinite(sd) & course.moves
    inverse_variance = jnp.where(normal, 1 / sd**2, 0.0)
    log_norm = jnp.sum(jnp.where(normal, jnp.log(jnp.where(normal, sd, 1.0)) + 0.5 * np.log(2 * np.pi), 0.0), axis=1)
    away = part - 0.5
    loss = loss + 0.5 * jnp.sum(inverse_variance * away**2, axis=1) + log_norm
    gradient = jnp.where(course.moves, gradient + inverse_variance * away, 0.0)
    both_move = course.moves[:, :, None] & course.moves[:, None, :]
    fisher = jnp.where(both_move, fisher, 0.0) + jax.vmap(jnp.diag)(inverse_variance)
    finite = jnp.isfinite(loss) & jnp.isfinite(gradient).all(axis=1) & jnp.isfinite(fisher).all(axis=(1, 2))
    return jnp.where(finite, loss, jnp.inf), gradient, fisher
