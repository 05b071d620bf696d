"""Forces that go with time and nothing else: a swing that no state and no input tells of.

    force(t) = c cos(w t) + s sin(w t)

with its own c and s in every window, so that the rig's clock need not be known, N(0, a^2) of a few sizes a. What it would
earn in evidence is told to first order for every frequency w from one period per window on (`levels`), all equally
probable. White process noise, which the model has, spreads over all frequencies what a swing has at one.

Reference: Bretthorst (1988), Bayesian spectrum analysis and parameter estimation, ch. 3.
"""

from typing import NamedTuple

import numpy as np

from simpel_cli.discovery.levels import Level, Levels, evidence
from simpel_cli.discovery.sensitivity import shifts

SIZES = (1.0, 0.3, 0.1, 0.03)  # of the typical rate of the state
CERTAIN = 10.0  # nats that a swing has to earn: it is no candidate of the search, and no episode was held out for it
PER_PERIOD = 4  # rows, at least
STEP = 0.25  # of one period per window, from a frequency to the next


class Swing(NamedTuple):
    """A force that swings with time.

    Args:
        acts_on: state whose rate it acts on.
        period: s.
        rms: of the force, per second.
        gain: in evidence, nats.
    """

    acts_on: str
    period: float
    rms: float
    gain: float


def swing(levels: Levels) -> Swing | None:
    """Return the swing that the data ask for beside the chosen terms; None where there is none."""
    plan = levels.search.plan
    model, rows = plan.augmented.model, plan.windows.ok.shape[1]
    cycles = np.arange(1.0, rows / PER_PERIOD, STEP)  # per window
    found = []
    for row in plan.coordinates.driven if len(cycles) else ():
        here = levels(row)
        if not here:
            continue
        name = model.states[row].name
        sizes = np.array(SIZES) * plan.scales.rate[name]
        told = [_told(level, cycles / rows, row, model.dt) for level in here]
        gains = np.array([[evidence(*seen, sizes) for seen in at] for at in told])  # (levels, frequencies, sizes)
        reached = gains + np.array([level.reached for level in here])[:, None, None]
        level, f, size = np.unravel_index(np.argmax(reached), reached.shape)
        gain = reached[level, f, size] - max(at.reached for at in here)
        gain -= np.log(len(SIZES) * len(cycles) * len(plan.coordinates.driven))
        matrix, pull = told[level][f]
        weights = np.linalg.solve(matrix + np.eye(len(pull)) / sizes[size] ** 2, pull)
        rms = float(np.sqrt(np.mean(weights**2)))  # of c and s, and so of the force
        found.append(Swing(name, float(rows * model.dt / cycles[f]), rms, float(gain)))
    best = max(found, key=lambda seen: seen.gain, default=None)
    return best if best is not None and best.gain > CERTAIN else None


def _told(level: Level, frequencies: np.ndarray, row: int, dt: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the data tell of the weights c, s of every window at one level of the noise: W' W (2W, 2W) and W' e (2W,).

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
    columns = shifts(level.track, level.per_std > 0, here, there, row, dt) * level.per_std[..., None]
    columns = columns.reshape(count, -1, 2, len(frequencies))
    known = level.known.reshape(count, columns.shape[1], -1)
    # a window's weights move its own innovations alone; only the known unknowns, taken out, tie the windows together
    square = np.einsum("wmaf,wmbf->fwab", columns, columns)
    pull = np.einsum("wmaf,wm->fwa", columns, level.error.reshape(count, -1))
    shared = np.einsum("wmn,wmaf->fnwa", known, columns).reshape(len(frequencies), known.shape[-1], 2 * count)
    found = []
    for f in range(len(frequencies)):
        matrix = np.zeros((count, 2, count, 2))
        matrix[np.arange(count), :, np.arange(count)] = square[f]
        found.append((matrix.reshape(2 * count, -1) - shared[f].T @ shared[f], pull[f].ravel()))
    return found
