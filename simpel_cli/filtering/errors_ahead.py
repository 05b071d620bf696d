"""How far a model is off: one step, a horizon and a free run ahead, and how probable held-out rows are under it."""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.filtering.independent_parts import NO_PART, per_channel
from simpel_cli.filtering.likelihood.coordinates import Coordinates
from simpel_cli.filtering.likelihood.filter import MOST_KEPT
from simpel_cli.filtering.likelihood.sensor_delay import JUMPS, no_jumps
from simpel_cli.filtering.likelihood.track import Filter, Track
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import Setup
from simpel_cli.runs.programs import Program

RAN_AWAY = 1e3  # times the other model's error, where a model has none
SETTLE = 5  # rows after which the filter knows a state that it started without
FIRST = 6  # rows from which it is estimated where a free run begins
SHORT = 4  # times the rows that tell the first state: a window that is shorter begins sooner
LOG_2PI = float(np.log(2 * np.pi))


class Assessment(NamedTuple):
    """Errors of one model on windows; NaN where nothing was measured.

    Args:
        one_step: (W, T, ny) measured minus predicted from all rows before.
        variance: (W, T, ny) that the model claims for it.
        ahead: (W, T, ny) the same from the state `horizon` rows before, without looking at rows in between.
        free: (W, T, ny) the same after the first rows without ever looking again, the simulation alone.
        log_likelihood: (W,) of the window's measurements.
        free_mean: (W, T, ny) the free run itself.
        track: of the filter.
        first: rows from which the state is estimated with which the free run goes on.
    """

    one_step: np.ndarray
    variance: np.ndarray
    ahead: np.ndarray
    free: np.ndarray
    log_likelihood: np.ndarray
    free_mean: np.ndarray
    track: Track
    first: int = FIRST


class Assessor:
    """Runs one model over windows; one compiled program per shape of the windows.

    Args:
        plan: whose models they are.
        horizon: rows ahead.
        first: rows of a window from which the state is estimated that a free run begins with.
    """

    def __init__(self, plan: Setup, horizon: int, first: int = FIRST) -> None:
        self.plan, self.horizon, self.first = plan, horizon, first

    def of(self, plan: Setup, horizon: int | None = None) -> "Assessor":
        """Return the same for models of another setup, or so many rows ahead."""
        return Assessor(plan, self.horizon if horizon is None else horizon, self.first)

    def first_of(self, windows: Windows) -> int:
        """Return the rows that tell a first state: of windows that are short for that, no more than a quarter."""
        return min(self.first, max(FIRST, windows.y.shape[1] // SHORT))

    def __call__(self, z: np.ndarray, windows: Windows) -> Assessment:
        """Assess the model at unit coordinates z."""
        first = self.first_of(windows)
        program = _program(self.plan.rule, self.plan.coordinates.layout, self.horizon, first)
        bounds = tuple(jnp.asarray(a) for a in self.plan.coordinates.bounds)
        count, batch = len(windows.episode), len(self.plan.windows.episode)
        if windows.y.shape[1] != self.plan.windows.y.shape[1]:
            batch = min(batch, count)
        # batches of one size: windows to learn from and to test on share a program where they are equally long
        parts = [
            program(bounds, jnp.asarray(z), *(a[np.arange(i, i + batch) % count] for a in windows.arrays))
            for i in range(0, count, batch)
        ]
        track, ahead, free = jax.tree.map(lambda *a: np.concatenate(a)[:count], *parts)
        ok = np.where(windows.ok > 0, 1.0, np.nan)
        e, s = track.innovation * ok, track.variance
        log_likelihood = -0.5 * np.nansum(np.log(s) * ok + e**2 / s + LOG_2PI * ok, axis=(1, 2))
        alone = self._wrapped(windows.y - free) * ok
        alone[:, :first] = np.nan
        horizon = self._wrapped(windows.y - ahead) * ok
        horizon[:, : SETTLE + self.horizon] = np.nan
        e[:, :SETTLE] = np.nan
        return Assessment(e, s, horizon, alone, log_likelihood, free, track, first)

    def free_runs(self, z: np.ndarray, windows: Windows) -> np.ndarray:
        """Return the errors of free runs of several models at once, (models, W, T, ny), as `free` of an assessment.

        Args:
            z: (models, n) unit coordinates.
            windows: of any shape.
        """
        bounds = tuple(jnp.asarray(a) for a in self.plan.coordinates.bounds)
        free = np.asarray(
            _free_program(self.plan.rule, self.plan.coordinates.layout, self.first_of(windows))(
                bounds, jnp.asarray(z), *windows.arrays
            )
        )
        error = self._wrapped(windows.y - free) * np.where(windows.ok > 0, 1.0, np.nan)
        error[:, :, : self.first_of(windows)] = np.nan
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
    parts: np.ndarray,
    random: np.random.Generator,
    draws: int = 4000,
    level: float = 0.95,
) -> np.ndarray:
    """Return intervals of RMSE before / RMSE after, (2, ny), by resampling whole parts; NaN: there is none.

    Args:
        before: errors of one model, (W, T, ny).
        after: of the other.
        parts: of which episode, say, each window is, (W,); or per channel, (W, ny), as of `independent_parts`.
        random: generator.
        draws: resampled sets.
        level: probability of the interval.

    Reference: Efron and Tibshirani (1993), An introduction to the bootstrap, ch. 8.
    """
    before, after = with_lost(before, after)
    interval = np.full((2, before.shape[2]), np.nan)
    for j, own in enumerate(per_channel(parts, before.shape[2])):
        names = np.unique(own[own != NO_PART])
        if not len(names):
            continue
        first, second = (np.array([np.nansum(e[own == n, :, j] ** 2) for n in names]) for e in (before, after))
        chosen = random.integers(0, len(names), (draws, len(names)))
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(first[chosen].sum(axis=1) / second[chosen].sum(axis=1))
        if np.isfinite(ratio).any():  # a channel that nothing measured has no interval
            interval[:, j] = np.nanquantile(ratio, [(1 - level) / 2, (1 + level) / 2])
    return interval


def with_lost(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of two models in which one that ran away where the other did not is far off, not without an error."""
    found = []
    for own, other in ((before, after), (after, before)):
        known = np.isfinite(other)
        size = np.sqrt(np.mean(other[known] ** 2)) if known.any() else 0.0
        found.append(np.where(~np.isfinite(own) & known, RAN_AWAY * size, own))
    return found[0], found[1]


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
def _program(rule: Filter, layout: tuple[Any, ...], horizon: int, first: int) -> Program:
    every = jax.vmap(partial(_window, rule, layout, horizon, first), in_axes=(None, None, 0, 0, 0, 0, 0))
    return Program(
        every, f"errors {horizon} ahead, and of free runs from {first} rows, of {rule.name} {layout}", (Track,)
    )


@lru_cache(maxsize=MOST_KEPT)
def _free_program(rule: Filter, layout: tuple[Any, ...], first: int) -> Program:
    per_window = jax.vmap(partial(_alone, rule, layout, first), in_axes=(None, None, 0, 0, 0, 0, 0))
    every = jax.vmap(per_window, in_axes=(None, 0, *[None] * 5))
    return Program(every, f"free runs from {first} rows of {rule.name} {layout}")


def _alone(
    rule: Filter, layout: tuple[Any, ...], first: int, bounds: tuple[Array, ...],
    z: Array, y: Array, ok: Array, u: Array, start: Array, spread: Array,
) -> Array:  # fmt: skip
    """Return the free run of a window, (T, ny): the filter sees no more than its first rows."""
    p, noise = Coordinates.of(bounds, layout).physical(z)
    lead, seen = len(u) - len(y), min(first, len(y))
    track, _ = rule.track(p, noise, y[:seen], ok[:seen], u[: lead + seen], start, spread)
    return _free(rule, p, rule.delayed_inputs(p, u), track.mean, start, seen, y.shape[1])


def _free(rule: Filter, p: Array, u_sub: Array, mean: Array, start: Array, first: int, ny: int) -> Array:
    """Return what is read along a simulation that begins with the filter's mean in the last of the first rows, (T, ny)."""
    rows, quiet = len(u_sub), no_jumps(ny, start, rule.jumps)
    simulated = jnp.ones(len(start)).at[jnp.array(rule.remainders, int)].set(0.0)

    def run(carry: tuple[Array, Array, Array], k: Array) -> tuple[tuple[Array, Array, Array], Array]:
        before, x, jumps = carry
        x = jnp.where(k < first, mean[jnp.minimum(k, first - 1)], x) * simulated
        last = jnp.maximum(k, 1) - 1
        read, jumps = rule.read(p, before, u_sub[last], x, u_sub[k], jumps)
        return (x, rule.flow(p, x, u_sub[k]), jumps), read

    return jax.lax.scan(run, (start, start, quiet), jnp.arange(rows))[1]


def _window(
    rule: Filter, layout: tuple[Any, ...], horizon: int, first: int, bounds: tuple[Array, ...],
    z: Array, y: Array, ok: Array, u: Array, start: Array, spread: Array,
) -> tuple[Track, Array, Array]:  # fmt: skip
    """Return the filter's track, what is read `horizon` rows ahead, and the free run."""
    p, noise = Coordinates.of(bounds, layout).physical(z)
    track, held = rule.track(p, noise, y, ok, u, start, spread)
    u_sub = rule.delayed_inputs(p, u)
    rows, ny = y.shape
    quiet = no_jumps(ny, start, rule.jumps)
    jumps = jnp.broadcast_to(quiet, (rows, *quiet.shape)) if held.jumps is None else held.jumps

    def step(carry: tuple[Array, Array, Array], k: Array) -> tuple[tuple[Array, Array, Array], None]:
        before, x, jumps = carry
        u_before, u_now = (u_sub[jnp.clip(k - back, 0, rows - 1)] for back in (1, 0))
        _, jumps = rule.read(p, before, u_before, x, u_now, jumps)
        return (x, rule.flow(p, x, u_now), jumps), None

    far = max(horizon - JUMPS, 0)  # what jumped so long before is shown no more

    def on(x: Array, k: Array) -> tuple[Array, None]:
        return rule.flow(p, x, u_sub[jnp.minimum(k, rows - 1)]), None

    def from_row(x: Array, before: Array, k: Array) -> Array:
        x = jax.lax.scan(on, x, k + jnp.arange(far))[0]
        begun, end, jumps = jax.lax.scan(step, (x, x, before), k + jnp.arange(far, horizon))[0]
        last, now = (jnp.minimum(k + horizon - back, rows - 1) for back in (1, 0))
        return rule.read(p, begun, u_sub[last], end, u_sub[now], jumps)[0]

    reached = jax.vmap(from_row)(track.mean, jumps, jnp.arange(rows))
    ahead = jnp.concatenate([y[:horizon], reached])[:rows]
    return track, ahead, _free(rule, p, u_sub, track.mean, start, min(first, rows), ny)
