"""How many integration steps a row the effects of a model need.

A search takes as many as the simulator alone needs. A dry friction switches and a stop begins to push inside a row: what a
step misses there is no noise, and with quiet sensors it is worth tens of nats, which another effect, or one more, earns that
only makes up for the integrator. What is missed in a row counts as it shifts what the filter is sure of,

    1/2 sum_i log(1 + m_i^2 / P_ii),    m = state one row later with n steps less the same with very many, P as predicted there,

what a row loses to noise of the process that makes up for it, summed over the rows that are searched in.

Reference: Hairer, Norsett and Wanner (1993), Solving ordinary differential equations I, II.6 (jumps of the right-hand side);
Kullback and Leibler (1951) for the shift of a Gaussian, in nats.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from simpel_cli.discovery.search.again import Earlier
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.augmented import Augmented

MOST = 8  # steps a row, at which one that switches is integrated as well as it will be
VERY_MANY = 32
ROWS = 2000  # looked at


class Finer(NamedTuple):
    """A search worth making with more integration steps a row.

    Args:
        steps: a row.
        earlier: what was chosen with fewer.
    """

    steps: int
    earlier: Earlier | None = None


def too_coarse(search: Search, assessor: Assessor, trial: Trial, base: Trial) -> Finer | None:
    """Return how many steps a row the effects of a model ask for, where that is more than are made; None: they do not.

    What is missed has to be worth as much as an effect has to earn.

    Args:
        search: that it comes from.
        assessor: of its program.
        trial: the model.
        base: the simulator alone, which has the steps that it needs: what these miss is no matter of effects.
    """
    plan = search.plan
    steps = plan.substeps
    if steps >= MOST or not trial.terms:
        return None
    least = ACCEPT + _missed(search, assessor, base, (steps,))[0]
    tried = [n for n in (2 * steps, 4 * steps) if n < MOST]
    first, *others = _missed(search, assessor, trial, (steps, *tried))
    if not first > least:
        return None
    return Finer(next((n for n, cost in zip(tried, others, strict=True) if cost < least), MOST))


def _missed(search: Search, assessor: Assessor, trial: Trial, steps: tuple[int, ...]) -> list[float]:
    """Return what so many steps a row miss of a model in all rows, nats."""
    plan, windows = search.plan, search.plan.windows
    track, lead = assessor(trial.optimum.z, windows).track, windows.u.shape[1] - windows.y.shape[1]
    there = np.argwhere((windows.ok[:, 1:] > 0).any(axis=2))
    if not len(there):
        return [0.0] * len(steps)
    kept = there[np.unique(np.linspace(0, len(there) - 1, min(ROWS, len(there))).astype(int))]
    w, k = kept.T
    x, u = np.asarray(track.mean)[w, k], windows.u[w, lead + k, : len(plan.augmented.model.inputs)]
    p = np.asarray(plan.coordinates.physical(jnp.asarray(trial.optimum.z))[0])
    driven = list(plan.augmented.driven)
    sure = np.asarray(track.predicted_cov)[w, k + 1][:, driven, driven]
    finest = _moved(plan.augmented, p, x, u, VERY_MANY)[:, driven]
    found = []
    for n in steps:
        shift = _moved(plan.augmented, p, x, u, n)[:, driven] - finest
        with np.errstate(divide="ignore", invalid="ignore"):
            cost = 0.5 * np.sum(np.log1p(shift**2 / sure), axis=1)
        found.append(float(np.nan_to_num(cost, nan=0.0, posinf=0.0).mean()) * len(there))
    return found


def _moved(augmented: Augmented, p: np.ndarray, x: np.ndarray, u: np.ndarray, steps: int) -> np.ndarray:
    """Return states (N, nx) one row later, by the classical method of Runge and Kutta; p: (dp,), u: (N, nu), held."""
    h, now = augmented.model.dt / steps, x.T
    inputs, values = u.T, np.tile(p[:, None], len(x))

    def rate(at: np.ndarray) -> np.ndarray:
        return np.asarray(augmented.function(at, inputs, values)[0])

    for _ in range(steps):
        one = rate(now)
        two = rate(now + h / 2 * one)
        three = rate(now + h / 2 * two)
        now = now + h / 6 * (one + 2 * two + 2 * three + rate(now + h * three))
    return now.T
