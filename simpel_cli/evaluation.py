"""How good a posterior is on held-out episodes: one step ahead and in free run, with bootstrap intervals.

Every metric is a function of means of per-point quantities, so that one resampling of blocks serves them all.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammaincinv  # scipy.stats takes seconds to import

from simpel_cli.data.recording import Episode, Transitions
from simpel_cli.encoding import Encoding
from simpel_cli.inference import padded_length
from simpel_cli.predictive import Predictive

LEVELS = np.arange(0.05, 0.951, 0.05)
CHUNK = 512  # test inputs per call: one compiled program serves every test set


class Posterior(NamedTuple):
    """A fitted posterior of one seed, as functions of arrays in data units.

    Args:
        predict: inputs (n, dx) to their predictive.
        members: inputs of every particle (L, n, dx) to its targets (L, n, dy).
        particles: L.
    """

    predict: Callable[[np.ndarray], Predictive]
    members: Callable[[np.ndarray], jax.Array]
    particles: int


class OneStep(NamedTuple):
    """Per-point quantities of one-step prediction at n test transitions; outputs (dy) then the joint, in data units."""

    nll: np.ndarray  # (n, dy + 1)
    squared: np.ndarray  # (n, dy + 1), joint = sum over outputs
    absolute: np.ndarray  # (n, dy + 1)
    crps: np.ndarray  # (n, dy + 1)
    inside: np.ndarray  # (n, dy + 1), 1 within the central 90 % region
    below: np.ndarray  # (n, dy + 1, levels), 1 where r <= chi-squared quantile
    mean: np.ndarray  # (n, dy)
    std: np.ndarray  # (n, dy)
    epistemic_std: np.ndarray  # (n, dy)


def one_step(posterior: Posterior, x: np.ndarray, y: np.ndarray) -> OneStep:
    """Compare one-step predictions with targets.

    The joint columns: NLL of the joint mixture; squared, absolute error and CRPS summed over outputs; coverage and
    calibration of the Mahalanobis distance against chi-squared with dy degrees of freedom.

    Args:
        posterior: the fitted posterior.
        x: test inputs, shape (n, dx).
        y: targets, shape (n, dy).
    """
    parts = [_one_chunk(posterior, x[i : i + CHUNK], y[i : i + CHUNK]) for i in range(0, len(x), CHUNK)]
    return OneStep(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@jax.jit
def _measure(p: Predictive, y: jax.Array) -> tuple[jax.Array, ...]:
    r = ((y - p.mean) / p.std) ** 2
    columns = (
        -p.log_prob_per_output(y), -p.log_prob(y), p.crps(y), p.cdf(y), r, p.mahalanobis(y), p.mean, p.std, p.epistemic_std,
    )  # fmt: skip
    return columns


def _one_chunk(posterior: Posterior, x: np.ndarray, y: np.ndarray) -> OneStep:
    n, dy = y.shape
    pad = [(0, CHUNK - n), (0, 0)]
    p = posterior.predict(np.pad(x, pad, mode="edge"))
    p = Predictive(*(a.astype(jnp.float64) for a in p))
    columns = [np.asarray(a)[:n] for a in _measure(p, jnp.asarray(np.pad(y, pad, mode="edge")))]
    nll, joint, crps, pit, r, distance, mean, std, epistemic = columns
    error = y - mean
    quantiles = np.stack([chi_squared_quantile(LEVELS, 1)] * dy + [chi_squared_quantile(LEVELS, dy)])
    r_all = np.column_stack([r, distance])
    inside = np.column_stack([np.abs(pit - 0.5) <= 0.45, distance <= chi_squared_quantile(0.9, dy)])
    return OneStep(
        nll=np.column_stack([nll, joint]),
        squared=_with_sum(error**2),
        absolute=_with_sum(np.abs(error)),
        crps=_with_sum(crps),
        inside=inside.astype(float),
        below=(r_all[:, :, None] <= quantiles[None]).astype(float),
        mean=mean,
        std=std,
        epistemic_std=epistemic,
    )


def chi_squared_quantile(level: np.ndarray | float, degrees: int) -> np.ndarray:
    """Quantile of the chi-squared distribution."""
    return np.asarray(2 * gammaincinv(degrees / 2, level))


def _with_sum(a: np.ndarray) -> np.ndarray:
    return np.column_stack([a, a.sum(axis=1)])


class Blocks(NamedTuple):
    """Resampling units: whole episodes where there are enough, else contiguous pieces of them."""

    of_point: np.ndarray  # (n,) block of every point
    kind: str


def blocks_of(episode: np.ndarray, row: np.ndarray, length: int) -> Blocks:
    """Assign points to blocks for the bootstrap.

    Args:
        episode: episode index per point, shape (n,).
        row: row in the episode per point, shape (n,).
        length: rows per block where there are fewer than 10 episodes.

    Reference: Kuensch (1989), The jackknife and the bootstrap for general stationary observations.
    """
    if len(np.unique(episode)) >= 10:
        return Blocks(np.unique(episode, return_inverse=True)[1], "episodes")
    pairs = np.stack([episode, row // max(length, 1)], axis=1)
    return Blocks(np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1), f"blocks of {length} rows")


class Estimate(NamedTuple):
    """A metric with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


def bootstrap(
    points: np.ndarray, blocks: Blocks, statistic: Callable[[np.ndarray], np.ndarray], resamples: int = 1000
) -> Estimate:
    """Estimate statistic(mean over points) with a percentile interval over resampled blocks.

    Args:
        points: per-point quantities, shape (n, ...).
        blocks: block of every point.
        statistic: maps means (..., k) over the trailing axes to a number, vectorised over the leading axis.
        resamples: number of bootstrap samples.

    Reference: Efron and Tibshirani (1993), section 13.3.
    """
    n_blocks = int(blocks.of_point.max()) + 1
    flat = points.reshape(len(points), -1)
    sums = np.zeros((n_blocks, flat.shape[1]))
    np.add.at(sums, blocks.of_point, flat)
    sizes = np.bincount(blocks.of_point, minlength=n_blocks).astype(float)
    rng = np.random.default_rng(0)  # resampling noise is no part of an experiment's seed
    counts = rng.multinomial(n_blocks, np.full(n_blocks, 1 / n_blocks), size=resamples).astype(float)
    means = (counts @ sums) / (counts @ sizes)[:, None]
    shape = (-1, *points.shape[1:])
    value = float(statistic(flat.mean(axis=0).reshape(1, *points.shape[1:]))[0])
    if n_blocks == 1:
        return Estimate(value, np.nan, np.nan)  # one block says nothing of the spread between blocks
    low, high = np.quantile(statistic(means.reshape(shape)), [0.025, 0.975])
    return Estimate(value, float(low), float(high))


STATISTICS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "nll": ("nll", lambda m: m),
    "rmse": ("squared", np.sqrt),
    "mae": ("absolute", lambda m: m),
    "crps": ("crps", lambda m: m),
    "coverage_90": ("inside", lambda m: m),
    "calibration_error": ("below", lambda m: np.abs(m - LEVELS).mean(axis=-1)),
}


def one_step_table(result: OneStep, blocks: Blocks, encoding: Encoding) -> list[dict[str, object]]:
    """Return metric rows (metric, output, unit, value) with their interval ends as `<metric>_low`, `<metric>_high`."""
    names, units = [*encoding.y_names, "joint"], [*encoding.y_units, "mixed"]
    rows: list[dict[str, object]] = []
    for metric, (field, statistic) in STATISTICS.items():
        points = getattr(result, field)
        for i, (name, unit) in enumerate(zip(names, units, strict=True)):
            shown = unit if metric in ("rmse", "mae", "crps") else "nat" if metric == "nll" else "1"
            estimate = bootstrap(points[:, i], blocks, statistic)
            rows += interval_rows(metric, name, shown, estimate)
    return rows


def interval_rows(metric: str, output: str, unit: str, estimate: Estimate) -> list[dict[str, object]]:
    """Return the three metric rows of an estimate."""
    values = {metric: estimate.value, f"{metric}_low": estimate.low, f"{metric}_high": estimate.high}
    return [{"metric": m, "output": output, "unit": unit, "value": v} for m, v in values.items()]


class FreeRun(NamedTuple):
    """Roll-outs of the posterior along measured inputs, from W windows of test episodes, in physical units."""

    measured: np.ndarray  # (W, H + 1, ds)
    mean: np.ndarray  # (W, H + 1, ds)
    std: np.ndarray  # (W, H + 1, ds), between particles and with observation noise
    episode: np.ndarray  # (W,)
    row: np.ndarray  # (W,) first row in the episode
    error: np.ndarray  # (W, H + 1, ds), angles wrapped


def windows(episodes: tuple[Episode, ...], horizon: int, first: int) -> list[tuple[int, int]]:
    """Return (episode, first row) of roll-out windows, half overlapping; `first` rows of history come before each."""
    starts = []
    for i, episode in enumerate(episodes):
        starts += [(i, s) for s in range(first, len(episode.states) - horizon, max(horizon // 2, 1))]
    return starts


def free_run(posterior: Posterior, encoding: Encoding, episodes: tuple[Episode, ...], horizon: int) -> FreeRun | None:
    """Roll the posterior out from measured states; each particle follows its own path (trajectory sampling TS-infinity).

    Reference: Chua, Calandra, McAllister and Levine (2018), Deep reinforcement learning in a handful of trials.

    Args:
        posterior: the fitted posterior.
        encoding: coordinates.
        episodes: measured test episodes.
        horizon: steps of a roll-out.

    Returns:
        None if no episode is long enough.
    """
    k = encoding.stack
    starts = windows(episodes, horizon, k)
    if not starts or not encoding.states:
        return None
    measured = np.stack([episodes[e].states[s : s + horizon + 1] for e, s in starts])
    inputs = np.stack([_stacked(episodes[e].inputs, s, horizon, k) for e, s in starts])  # (W, H, (k+1) du)
    particles, noise = rollout(posterior, encoding, measured[:, 0], inputs)  # (H + 1, L, W, ds)
    mean, spread = _circular_moments(particles, encoding)
    std = np.sqrt(spread**2 + noise**2)
    mean, std = np.moveaxis(mean, 0, 1), np.moveaxis(std, 0, 1)
    error = mean - measured
    periodic = np.array([q.periodic for q in encoding.states])
    error = np.where(periodic, (error + np.pi) % (2 * np.pi) - np.pi, error)
    first = np.array(starts)
    return FreeRun(measured, mean, std, first[:, 0], first[:, 1], error)


def rollout(
    posterior: Posterior, encoding: Encoding, states: np.ndarray, inputs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Roll every particle out along measured inputs.

    Args:
        posterior: the fitted posterior.
        encoding: coordinates.
        states: initial states, shape (W, ds).
        inputs: stacked inputs, shape (W, H, (stack + 1) du).

    Returns:
        States of every particle (H + 1, L, W, ds), physical units, and the noise per state (ds,).
    """
    w = len(states)
    noise = np.asarray(posterior.predict(np.zeros((CHUNK, encoding.dim_x))).noise_std, dtype=float)
    encoded = np.broadcast_to(encoding.encode(states)[None], (posterior.particles, w, encoding.dim_state))
    path = [encoded]
    for h in range(inputs.shape[1]):
        along = np.broadcast_to(inputs[None, :, h], (posterior.particles, w, inputs.shape[2]))
        x = np.concatenate([encoded, along], axis=-1)
        pad = padded_length(w) - w  # test sets of similar size share a program
        y = np.asarray(posterior.members(np.pad(x, [(0, 0), (0, pad), (0, 0)], mode="edge")), dtype=float)[:, :w]
        encoded = encoding.advance(encoded, y)
        path.append(encoded)
    per_state, i = [], 0
    for q in encoding.states:
        # an angle's variance is the sum of those of its sine, s^2 cos^2, and cosine, s^2 sin^2
        per_state.append(np.hypot(noise[i], noise[i + 1]) if q.periodic else noise[i])
        i += 2 if q.periodic else 1
    return encoding.decode(np.stack(path)), np.array(per_state)


def _circular_moments(particles: np.ndarray, encoding: Encoding) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over particles (axis 1); directions are averaged on the circle."""
    mean, std = particles.mean(axis=1), particles.std(axis=1)
    for i, q in enumerate(encoding.states):
        if q.periodic:
            angle = particles[..., i]
            middle = np.arctan2(np.sin(angle).mean(axis=1), np.cos(angle).mean(axis=1))
            off = (angle - middle[:, None] + np.pi) % (2 * np.pi) - np.pi
            mean[..., i], std[..., i] = middle, np.sqrt((off**2).mean(axis=1))
    return mean, std


def _stacked(inputs: np.ndarray, start: int, horizon: int, k: int) -> np.ndarray:
    return np.concatenate([inputs[start - k + j : start - k + j + horizon] for j in range(k + 1)], axis=1)


def free_run_table(run: FreeRun, encoding: Encoding, dt: float) -> list[dict[str, object]]:
    """Return metric rows `free_run_rmse@<horizon>s` per state at a quarter, half and the whole of the horizon."""
    horizon = run.error.shape[1] - 1
    blocks = blocks_of(run.episode, run.row, horizon)
    rows: list[dict[str, object]] = []
    for h in sorted({max(1, horizon // 4), max(1, horizon // 2), horizon}):
        for i, q in enumerate(encoding.states):
            estimate = bootstrap(run.error[:, h, i] ** 2, blocks, np.sqrt)
            rows += interval_rows(f"free_run_rmse@{h * dt:g}s", q.name, q.unit, estimate)
    return rows


def test_arrays(transitions: Transitions, encoding: Encoding) -> tuple[np.ndarray, np.ndarray]:
    """Return network inputs (n, dx) and targets (n, dy) of measured transitions, data units."""
    x = encoding.to_x(transitions.states, transitions.inputs)
    return x, encoding.to_y(transitions.states, transitions.next_states, transitions.outputs)
