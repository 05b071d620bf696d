"""Time-dependent disturbances: forces that no state and no input explains.

    force(t) = c cos(w t) + s sin(w t)

with its own c and s in every window, so that the rig's clock need not be known, N(0, a^2) of a few sizes a. What it would
earn in evidence is known to first order for every frequency w (`noise_profile`), all equally probable. White process noise,
which the model has, spreads over all frequencies what a periodic disturbance has at one. What wanders has several: where
another frequency is left beside the best, or less than a period fits into a window, there is no period to speak of.

Reference: Bretthorst (1988), Bayesian spectrum analysis and parameter estimation, ch. 3.
"""

from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.search.unexplained.noise_profile import Level, NoiseProfile
from simpel_cli.filtering.likelihood.sensitivity import shifts

SIZES = (1.0, 0.3, 0.1, 0.03)  # of the typical rate of the state
CERTAIN = (
    10.0  # nats that a disturbance has to earn: it is no candidate of the search, and no episode was held out for it
)
PER_PERIOD = 4  # rows, at least
STEP = 0.25  # of one period per window, from a frequency to the next
MOST_WINDOWS = 200  # for a second look: it is dense in the weights of all windows
APART = 1.5  # periods per window, from which on another frequency is another disturbance


class Disturbance(NamedTuple):
    """A force that goes with time.

    Args:
        acts_on: state whose rate it acts on.
        period: s; None: it wanders.
        rms: of the force, per second.
        gain: in evidence, nats.
    """

    acts_on: str
    period: float | None
    rms: float
    gain: float

    @property
    def how(self) -> str:
        """What it does, in words."""
        if self.period is None:
            return "wanders with time: it has no single period"
        return f"swings with time, with a period of about {self.period:.3g} s"


class Statistics(NamedTuple):
    """What the data tell of the weights c, s of W windows at F frequencies, at one level of the noise.

    Args:
        square: (F, W, 2, 2) of what the weights of a window do to its innovations.
        pull: (F, W, 2) of it and the innovations.
        shared: (F, n, W, 2) of it and the known unknowns, which tie the windows together.
    """

    square: np.ndarray
    pull: np.ndarray
    shared: np.ndarray


def time_dependent_disturbance(levels: NoiseProfile) -> Disturbance | None:
    """Return the force of time that the data ask for beside the chosen terms; None where there is none."""
    plan = levels.search.plan
    model, ok = plan.augmented.model, plan.windows.ok
    rows = float(np.median(ok.any(axis=2).sum(axis=1)))  # of a window
    cycles = np.arange(0.0, rows / PER_PERIOD, STEP)  # per window; below one a load that is another in every window
    found = []
    for row in plan.coordinates.driven if len(cycles) else ():
        here = levels(row)
        if not here:
            continue
        name = model.states[row].name
        sizes = np.array(SIZES) * plan.scales.rate[name]
        tried = [_columns(level, cycles / rows, row, model.dt) for level in here]
        statistics = [_statistics(level, columns) for level, columns in zip(here, tried, strict=True)]
        reached = np.array([level.reached + _evidence(t, sizes)[0] for level, t in zip(here, statistics, strict=True)])
        k, f, size = np.unravel_index(np.argmax(reached), reached.shape)
        penalty = np.log(len(SIZES) * len(cycles) * len(plan.coordinates.driven))
        gain = float(reached[k, f, size] - max(level.reached for level in here) - penalty)
        weights = _evidence(Statistics(*(a[[f]] for a in statistics[k])), sizes[[size]])[1]
        wanders = bool(cycles[f] < 1)
        others = np.abs(cycles - cycles[f]) > APART
        if len(ok) <= MOST_WINDOWS and others.any() and gain > CERTAIN:
            # what is left beside it, at the level of the noise where it does best
            beside = _statistics(_without(here[k], tried[k][..., f]), tried[k][..., others])
            wanders |= bool(_evidence(beside, sizes)[0].max() - penalty > CERTAIN)
        phase = 2 * np.pi * cycles[f] / rows * np.arange(ok.shape[1])
        force = weights[0] @ np.stack([np.cos(phase), np.sin(phase)])
        rms = float(np.sqrt(np.mean(force**2)))
        found.append(Disturbance(name, None if wanders else float(rows * model.dt / cycles[f]), rms, gain))
    best = max(found, key=lambda seen: seen.gain, default=None)
    return best if best is not None and best.gain > CERTAIN else None


def _columns(level: Level, frequencies: np.ndarray, row: int, dt: float) -> np.ndarray:
    """Return what c and s of every window do to its innovations, in standard deviations, (W, T ny, 2, F).

    Args:
        level: of the model.
        frequencies: in cycles per row.
        row: of the state.
        dt: s.
    """
    count, rows = level.error.shape[:2]
    phase = 2 * np.pi * frequencies * np.arange(rows + 1)[:, None]
    force = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)  # (T + 1, 2F)
    here, there = (np.broadcast_to(f, (count, *f.shape)) for f in (force[:-1], force[1:]))
    columns = shifts(level.track, level.per_std > 0, {row: (here, there)}, dt) * level.per_std[..., None]
    # the force is taken for a straight line within a row, of which the mean is smaller than that of the wave
    straight = np.cos(np.pi * frequencies) / np.sinc(frequencies)
    return columns.reshape(count, -1, 2, len(frequencies)) / straight


def _statistics(level: Level, columns: np.ndarray) -> Statistics:
    count = len(columns)
    known = level.known.reshape(count, columns.shape[1], -1)
    error = level.error.reshape(count, -1)
    # a window's weights move its own innovations alone; only the known unknowns, taken out, tie the windows together
    return Statistics(
        np.einsum("wmaf,wmbf->fwab", columns, columns, optimize=True),
        np.einsum("wmaf,wm->fwa", columns, error),
        np.einsum("wmn,wmaf->fnwa", known, columns, optimize=True),
    )


def _evidence(statistics: Statistics, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence that the weights earn, nats, (F, sizes), and their posterior means at the last size, (F, W, 2).

    As `noise_profile.evidence` with W' W = square - shared' shared, by the matrix inversion and determinant lemmas.
    """
    found = []
    weights = np.zeros_like(statistics.pull)
    for a2 in np.square(sizes):
        inverse = np.linalg.inv(np.eye(2) + a2 * statistics.square)
        turned = np.einsum("fwab,fnwb->fnwa", inverse, statistics.shared)
        inner = np.eye(statistics.shared.shape[1]) - a2 * np.einsum("fnwa,fmwa->fnm", statistics.shared, turned)
        own = np.einsum("fwab,fwb->fwa", inverse, statistics.pull)
        tie = np.einsum("fnwa,fwa->fn", statistics.shared, own)
        weights = a2 * (own + a2 * np.einsum("fnwa,fn->fwa", turned, np.linalg.solve(inner, tie[..., None])[..., 0]))
        size = -np.log(np.linalg.det(inverse)).sum(axis=1) + np.linalg.slogdet(inner)[1]
        found.append(np.einsum("fwa,fwa->f", statistics.pull, weights) / 2 - size / 2)
    value = np.stack(found, axis=1)
    return np.where(np.isfinite(value), value, -np.inf), weights


def _without(level: Level, columns: np.ndarray) -> Level:
    """Return a level whose known unknowns hold the weights of one frequency, (W, T ny, 2), of every window, too."""
    count, length = columns.shape[:2]
    block = np.zeros((count, length, count, 2))
    block[np.arange(count), :, np.arange(count)] = columns
    flat = block.reshape(count * length, -1)
    known = level.known.reshape(count * length, -1)
    u, size, _ = np.linalg.svd(flat - known @ (known.T @ flat), full_matrices=False)
    known = np.concatenate([known, u[:, size > 1e-6 * size.max(initial=1e-300)]], axis=1)
    error = level.error.ravel() - known @ (known.T @ level.error.ravel())
    return level._replace(error=error.reshape(level.error.shape), known=known.reshape(*level.error.shape, -1))
