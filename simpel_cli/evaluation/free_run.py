"""Free runs: the posterior runs on its own predictions along measured inputs."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from simpel_cli.data.recording import Episode
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.evaluation.bootstrap import Blocks, Estimate, bootstrap, interval_rows
from simpel_cli.evaluation.posterior import Posterior, noise_of
from simpel_cli.inference.protocols import padded_length

UNKNOWN = Estimate(np.nan, np.nan, np.nan)


class FreeRun(NamedTuple):
    """Roll-outs of the posterior along measured inputs, from W windows of test episodes, in physical units."""

    measured: np.ndarray  # (W, H + 1, ds), estimated where `known` is False
    mean: np.ndarray  # (W, H + 1, ds)
    std: np.ndarray  # (W, H + 1, ds), between particles and with observation noise
    episode: np.ndarray  # (W,)
    row: np.ndarray  # (W,) first row in the episode
    error: np.ndarray  # (W, H + 1, ds), angles wrapped
    known: np.ndarray  # (W, H + 1, ds), whether the state was measured there


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
    inputs = np.stack([_stacked(episodes[e].inputs, s, horizon, encoding) for e, s in starts])
    particles, noise = rollout(posterior, encoding, measured[:, 0], inputs)  # (H + 1, L, W, ds)
    mean, spread = _circular_moments(particles, encoding)
    std = np.sqrt(spread**2 + noise**2)
    mean, std = np.moveaxis(mean, 0, 1), np.moveaxis(std, 0, 1)
    error = mean - measured
    periodic = np.array([q.periodic for q in encoding.states])
    error = np.where(periodic, (error + np.pi) % (2 * np.pi) - np.pi, error)
    first = np.array(starts)
    known = np.stack([_known(episodes[e])[s : s + horizon + 1] for e, s in starts])
    return FreeRun(measured, mean, std, first[:, 0], first[:, 1], error, known)


def _known(episode: Episode) -> np.ndarray:
    """Return which states were measured, (T, ds)."""
    ds = episode.states.shape[1]
    return np.ones(episode.states.shape, bool) if episode.weight is None else episode.weight[:, :ds] == 1


def rollout(
    posterior: Posterior, encoding: Encoding, states: np.ndarray, inputs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Roll every particle out along measured inputs.

    Args:
        posterior: the fitted posterior.
        encoding: coordinates.
        states: initial states, shape (W, ds).
        inputs: stacked inputs, shape (W, H, dim_inputs).

    Returns:
        States of every particle (H + 1, L, W, ds), physical units, and the noise per state: (ds,), or of every row along the
        mean of the particles (H + 1, W, ds).
    """
    w = len(states)
    noise = noise_of(posterior, encoding)
    encoded = np.broadcast_to(encoding.encode(states)[None], (posterior.particles, w, encoding.dim_state))
    path, outputs = [encoded], []
    for h in range(inputs.shape[1]):
        along = np.broadcast_to(inputs[None, :, h], (posterior.particles, w, inputs.shape[2]))
        x = np.concatenate([encoded, along], axis=-1)
        pad = padded_length(w) - w  # test sets of similar size share a program
        y = np.asarray(posterior.members(np.pad(x, [(0, 0), (0, pad), (0, 0)], mode="edge")), dtype=float)[:, :w]
        encoded = encoding.advance(encoded, y)
        path.append(encoded)
        outputs.append(y[..., encoding.dim_state :].mean(axis=0))
    if posterior.relative is not None:
        noise = noise * _relative_noise(posterior.relative, encoding, path, inputs, outputs)
    per_state, i = [], 0
    for q in encoding.states:
        # an angle's variance is the sum of those of its sine, s^2 cos^2, and cosine, s^2 sin^2
        per_state.append(np.hypot(noise[..., i], noise[..., i + 1]) if q.periodic else noise[..., i])
        i += 2 if q.periodic else 1
    return encoding.decode(np.stack(path)), np.stack(per_state, axis=-1)


def _relative_noise(
    relative: Callable[[np.ndarray, np.ndarray], np.ndarray],
    encoding: Encoding,
    path: list[np.ndarray],
    inputs: np.ndarray,
    outputs: list[np.ndarray],
) -> np.ndarray:
    """Return the noise of one measurement in every row of a run over the typical one, (H + 1, W, dy).

    Inputs and outputs of the last row are not known: they stay.
    """
    found = []
    for h, encoded in enumerate(path):
        k = min(h, len(outputs) - 1)
        # a measurement has the inputs of its row alone
        held = encoding.stacked(encoding.input_rows(inputs[:, k])[:, [*range(encoding.stack + 1), encoding.stack]])
        x = np.concatenate([encoding.encode(encoding.decode(encoded.mean(axis=0))), held], axis=-1)
        still = np.zeros((len(x), encoding.dim_state))
        found.append(relative(x, np.concatenate([still, outputs[k]], axis=-1)))
    return np.stack(found)


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


def _stacked(inputs: np.ndarray, start: int, horizon: int, encoding: Encoding) -> np.ndarray:
    first = start - encoding.stack
    rows = range(first, first + encoding.stack + 1 + bool(encoding.linear))
    return np.asarray(encoding.stacked(np.stack([inputs[row : row + horizon] for row in rows], axis=1)))


def free_run_table(run: FreeRun, blocks: Blocks, encoding: Encoding, dt: float) -> list[dict[str, object]]:
    """Return metric rows `free_run_rmse@<horizon>s` per state at a quarter, half and the whole of the horizon.

    Where a state was measured at few rows, those runs count whose last row is one of them; of none NaN.
    """
    horizon = run.error.shape[1] - 1
    rows: list[dict[str, object]] = []
    for h in sorted({max(1, horizon // 4), max(1, horizon // 2), horizon}):
        for i, q in enumerate(encoding.states):
            there = run.known[:, h, i]
            estimate = UNKNOWN
            if there.any():
                estimate = bootstrap(run.error[there, h, i] ** 2, blocks.take(there), np.sqrt)
            rows += interval_rows(f"free_run_rmse@{h * dt:g}s", q.name, q.unit, estimate)
    return rows
