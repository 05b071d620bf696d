"""How many Runge-Kutta steps a row needs, so that the integrator errs less than the sensors do."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from simpel_cli.data.recording import Episode
from simulators.effects import Scales, structure
from simulators.model import Model
from simulators.worlds.rk4 import RK4

TOLERANCE = 0.05  # of the measurement noise, in one row of a smooth model
MOST = 8
MOST_OF_SWITCHES = 2  # a friction that changes sign within a row would ask for ever more
ROWS = 300  # looked at
SWITCH = 0.1  # a force that changes sign within a row, in typical rates: a step misses up to a sixth of twice it


def substeps_needed(
    model: Model, episodes: Sequence[Episode], noise_std: dict[str, float], scales: Scales, at: np.ndarray
) -> int:
    """Return the least number of steps per row at which neither the model nor a switching force is integrated too coarsely.

    Args:
        model: the simulator.
        episodes: its measurements; what is not measured lies in the middle of its range.
        noise_std: measured name -> standard deviation.
        scales: magnitudes in the measurements.
        at: (dp,) parameters.
    """
    states = np.concatenate([e.states for e in episodes])
    middle = np.array([(q.low + q.high) / 2 for q in model.states])
    kept = np.unique(np.linspace(0, len(states) - 1, min(ROWS, len(states))).astype(int))
    x = np.where(np.isfinite(states), states, middle)[kept]
    u = np.nan_to_num(np.concatenate([e.inputs for e in episodes])[kept])
    p = np.tile(np.asarray(at, float), (len(kept), 1))

    def moved(steps: int) -> np.ndarray:
        # when an input arrives does not matter here
        return RK4(replace(model, substeps=steps, delay={}, lag={})).step(x, u, p)

    names = [q.name for q in model.states]
    finest = moved(4 * MOST)
    least = min(MOST_OF_SWITCHES, int(np.ceil(_of_switches(model, noise_std, scales))))
    for steps in range(max(least, 1), MOST):
        missed = np.abs(moved(steps) - finest)
        smooth = all(
            np.nanquantile(missed[:, names.index(name)], 0.99) < TOLERANCE * std
            for name, std in noise_std.items()
            if name in names
        )
        if smooth:
            return steps
    return MOST


def _of_switches(model: Model, noise_std: dict[str, float], scales: Scales) -> float:
    """Return how many steps keep what a dry friction misses at a reversal below the noise of the speed."""
    needed = 0.0
    for velocity, position in structure(model).velocity.items():
        known = noise_std.get(velocity) or (noise_std.get(position or "", 0.0) / model.dt)
        if known > 0:
            needed = max(needed, SWITCH * scales.rate[velocity] * model.dt / known)
    return needed
