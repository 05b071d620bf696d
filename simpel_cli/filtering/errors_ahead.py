"""How far a model is off: one step, a horizon and a free run ahead, and how probable held-out rows are under it."""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.filtering.likelihood.coordinates import Coordinates
from simpel_cli.filtering.likelihood.filter import MOST_KEPT
from simpel_cli.filtering.likelihood.track import Filter, Track
from simpel_cli.filtering.measurements.windows import LEAST_EPISODES, Windows
from simpel_cli.filtering.setup import Setup
from simpel_cli.runs.programs import Program

BLOCKS = 10  # of a test window, where there are few episodes
RAN_AWAY = 1e3  # times the other model's error, where a model has none
SETTLE = 5  # rows after which the filter knows a state that it started without
LOG_2PI = float(np.log(2 * np.pi))


class Assessment(NamedTuple):
    """Errors of one model on windows; NaN where nothing was measured.

    Args:
        one_step: (W, T, ny) measured minus predicted from all rows before.
        variance: (W, T, ny) that the model claims for it.
        ahead: (W, T, ny) the same from the state `horizon` rows before, without looking at rows in between.
        free: (W, T, ny) the same from row SETTLE on without ever looking again, the simulation alone.
        log_likelihood: (W,) of the window's measurements.
        free_mean: (W, T, ny) the free run itself.
        track: of the filter.
    """

    one_step: np.ndarray
    variance: np.ndarray
    ahead: np.ndarray
    free: np.ndarray
    log_likelihood: np.ndarray
    free_mean: np.ndarray
    track: Track


class Assessor:
    """Runs one model over windows; one compiled program per shape of the windows."""

    def __init__(self, plan: Setup, horizon: int) -> None:
        self.plan, self.horizon = plan, horizon
        self._program = _program(plan.rule, plan.coordinates.layout, horizon)

    def __call__(self, z: np.ndarray, windows: Windows) -> Assessment:
        """Assess the model at unit coordinates z."""
        bounds = tuple(jnp.asarray(a) for a in self.plan.coordinates.bounds)
        count, batch = len(windows.episode), len(self.plan.windows.episode)
        # batches of one size: windows to learn from and to test on share a program
        parts = [
            self._program(bounds, jnp.asarray(z), *(a[np.arange(i, i + batch) % count] for a in windows.arrays))
            for i in range(0, count, batch)
        ]
        track, ahead, free = jax.tree.map(lambda *a: np.concatenate(a)[:count], *parts)
        ok = np.where(windows.ok > 0, 1.0, np.nan)
        e, s = track.innovation * ok, track.variance
        log_likelihood = -0.5 * np.nansum(np.log(s) * ok + e**2 / s + LOG_2PI * ok, axis=(1, 2))
        rows = np.arange(windows.y.shape[1])
        late = rows >= SETTLE
        wrap = self._wrapped(windows.y - free) * ok * np.where(late, 1.0, np.nan)[None, :, None]
        horizon = self._wrapped(windows.y - ahead) * ok
        horizon[:, : SETTLE + self.horizon] = np.nan
        e[:, :SETTLE] = np.nan
        return Assessment(e, s, horizon, wrap, log_likelihood, free, track)

    def free_runs(self, z: np.ndarray, windows: Windows) -> np.ndarray:
        """Return the errors of free runs of several models at once, (models, W, T, ny), as `free` of an assessment.

        Args:
            z: (models, n) unit coordinates.
            windows: of any shape.
        """
        bounds = tuple(jnp.asarray(a) for a in self.plan.coordinates.bounds)
        free = np.asarray(
            _free_program(self.plan.rule, self.plan.coordinates.layout)(bounds, jnp.asarray(z), *windows.arrays)
        )
        error = self._wrapped(windows.y - free) * np.where(windows.ok > 0, 1.0, np.nan)
        error[:, :, :SETTLE] = np.nan
        return error

    def track(self, z: np.ndarray, windows: Windows) -> Track:
        """Return the filter's track alone."""
        return self(z, windows).track

    def _wrapped(self, error: np.ndarray) -> np.ndarray:
        periodic = {q.name for q in self.plan.augmented.model.states if q.periodic}
        around = np.array([name in periodic for name in self.plan.augmented.measured])
        return np.where(around, (error + np.pi) % (2 * np.pi) - np.pi, error)


def rmse(error: np.ndarray) -> np.ndarray:
    """Root mean square over windows and rows, (ny,)."""
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.nanmean(error.reshape(-1, error.shape[-1]) ** 2, axis=0))


def reduction_interval(
    before: np.ndarray,
    after: np.ndarray,
    episode: np.ndarray,
    random: np.random.Generator,
    draws: int = 4000,
    level: float = 0.95,
) -> np.ndarray:
    """Return intervals of RMSE before / RMSE after, (2, ny), by resampling whole episodes.

    Reference: Efron and Tibshirani (1993), An introduction to the bootstrap, ch. 8.
    """
    before, after = with_lost(before, after)
    names = np.unique(episode)
    sums = [[np.nansum(e[episode == n] ** 2, axis=(0, 1)) for n in names] for e in (before, after)]
    first, second = (np.stack(s) for s in sums)
    chosen = random.integers(0, len(names), (draws, len(names)))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(first[chosen].sum(axis=1) / second[chosen].sum(axis=1))
    measured = np.isfinite(ratio).any(axis=0)  # a channel that nothing measured has no interval
    interval = np.full((2, ratio.shape[1]), np.nan)
    interval[:, measured] = np.nanquantile(ratio[:, measured], [(1 - level) / 2, (1 + level) / 2], axis=0)
    return interval


def with_lost(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of two models in which one that ran away where the other did not is far off, not without an error."""
    found = []
    for own, other in ((before, after), (after, before)):
        known = np.isfinite(other)
        size = np.sqrt(np.mean(other[known] ** 2)) if known.any() else 0.0
        found.append(np.where(~np.isfinite(own) & known, RAN_AWAY * size, own))
    return found[0], found[1]


def in_parts(errors: np.ndarray, episode: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (W, T, ny) of test windows with the number of the part that each is of, for intervals by resampling.

    Parts are episodes; of one or two of them, which have no interval, blocks of rows: (W BLOCKS, rows, ny), (W BLOCKS,).

    Reference: Kuensch (1989), The jackknife and the bootstrap for general stationary observations.
    """
    if len(np.unique(episode)) >= LEAST_EPISODES:
        return errors, np.unique(episode, return_inverse=True)[1]
    windows, rows, ny = errors.shape
    length = -(-rows // BLOCKS)
    padded = np.concatenate([errors, np.full((windows, BLOCKS * length - rows, ny), np.nan)], axis=1)
    return padded.reshape(windows * BLOCKS, length, ny), np.arange(windows * BLOCKS)


def gain_interval(gain: np.ndarray, random: np.random.Generator, draws: int = 4000) -> tuple[float, float]:
    """Return the 95 % interval of a sum over episodes, by resampling them; gain: (episodes,)."""
    chosen = random.integers(0, len(gain), (draws, len(gain)))
    low, high = np.quantile(gain[chosen].sum(axis=1), [0.025, 0.975])
    return float(low), float(high)


def results(assessment: Assessment, measured: tuple[str, ...], rows: float) -> dict[str, Any]:
    """Return the figures of a model as `verdict.json` has them."""
    return {
        name: dict(zip(measured, (float(v) for v in rmse(error)), strict=True))
        for name, error in (
            ("one_step", assessment.one_step), ("horizon", assessment.ahead), ("free_run", assessment.free),
        )
    } | {"log_likelihood_per_step": float(assessment.log_likelihood.sum() / rows)}  # fmt: skip


@lru_cache(maxsize=MOST_KEPT)
def _program(rule: Filter, layout: tuple[Any, ...], horizon: int) -> Program:
    every = jax.vmap(partial(_window, rule, layout, horizon), in_axes=(None, None, 0, 0, 0, 0, 0))
    return Program(every, f"errors {horizon} ahead of {rule.name} {layout}", (Track,))


@lru_cache(maxsize=MOST_KEPT)
def _free_program(rule: Filter, layout: tuple[Any, ...]) -> Program:
    # what is not returned is not computed
    one = lambda *given: _window(rule, layout, 1, *given)[2]  # noqa: E731
    per_window = jax.vmap(one, in_axes=(None, None, 0, 0, 0, 0, 0))
    return Program(jax.vmap(per_window, in_axes=(None, 0, *[None] * 5)), f"free runs of {rule.name} {layout}")


def _window(
    rule: Filter,
    layout: tuple[Any, ...],
    horizon: int,
    bounds: tuple[Array, ...],
    z: Array,
    y: Array,
    ok: Array,
    u: Array,
    start: Array,
    spread: Array,
) -> tuple[Track, Array, Array]:
    p, noise = Coordinates.of(bounds, layout).physical(z)
    track, _ = rule.track(p, noise, y, ok, u, start, spread)
    u_sub = rule.delayed_inputs(p, u)
    rows = y.shape[0]

    def following(x: Array, k: Array) -> Array:
        return rule.flow(p, x, u_sub[jnp.minimum(k, rows - 1)])

    def read(before: Array, x: Array, k: Array) -> Array:
        """Return what is read in row k, whose state is x."""
        last, now = jnp.minimum(k - 1, rows - 1), jnp.minimum(k, rows - 1)
        return rule.read(p, before, u_sub[last], x, u_sub[now])

    def step(carry: tuple[Array, Array], k: Array) -> tuple[tuple[Array, Array], None]:
        _, x = carry
        return (x, following(x, k)), None

    def from_row(x: Array, k: Array) -> Array:
        before, end = jax.lax.scan(step, (x, x), k + jnp.arange(horizon))[0]
        return read(before, end, k + horizon)

    reached = jax.vmap(from_row)(track.mean, jnp.arange(rows))
    ahead = jnp.concatenate([y[:horizon], reached])[:rows]

    alone = jnp.ones(len(start)).at[jnp.array(rule.remainders, int)].set(0.0)

    def run(carry: tuple[Array, Array], k: Array) -> tuple[tuple[Array, Array], Array]:
        before, x = carry
        # up to SETTLE the filter's state, from there on the model alone
        x = jnp.where(k <= SETTLE, track.mean[k], x) * alone
        return (x, following(x, k)), read(before, x, jnp.maximum(k, 1))

    free = jax.lax.scan(run, (start, start), jnp.arange(rows))[1]
    return track, ahead, free
