"""How many integration steps a row the effects of a model need.

A search takes as many as the simulator alone needs. A dry friction switches and a stop begins to push inside a row: what a
step misses there is no noise, and with quiet sensors it is worth tens of nats, which another effect, or one more, earns that
only makes up for the integrator. What is missed in a row counts as it shifts what the filter is sure of,

    1/2 sum_i log(1 + m_i^2 / P_ii),    m = state one row later with n steps less the same with very many, P as predicted there,

what a row loses to noise of the process that makes up for it, summed over the rows that are searched in.

Reference: Hairer, Norsett and Wanner (1993), Solving ordinary differential equations I, II.6 (jumps of the right-hand side);
Kullback and Leibler (1951) for the shift of a Gaussian, in nats.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from simpel_cli.discovery.search.again import Earlier
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.augmented import Augmented

MOST = 8  # steps a row, at which one that switches is integrated as well as it will be
NOTHING = 0.1  # of what an effect has to earn: what is missed then is left
FALLS = 50.0  # times what is missed falls with twice as many steps where all is smooth; 256 in the end, of one that switches 16
VERY_MANY = 32
ROWS = 1000  # looked at
LOST = 1e6  # variances that a row counts at most


class Finer(NamedTuple):
    """A search worth making with more integration steps a row.

    They are as many as miss nothing where the effect is smooth, so that errors fall with the fourth power; else `MOST` at once:
    beside noise of the process that makes up for coarse steps, a little finer ones look fine.

    Args:
        earlier: what was chosen with fewer.
        steps: a row.
    """

    earlier: Earlier | None = None
    steps: int = MOST


def too_coarse(search: Search, assessor: Assessor, trial: Trial, base: Trial) -> Finer | None:
    """Return that the effects of a model ask for more steps a row than are made; None: they do not.

    What is missed has to be worth as much as an effect has to earn.

    Args:
        search: that it comes from.
        assessor: of its program.
        trial: the model.
        base: the simulator alone, which has the steps that it needs: what these miss is no matter of effects.
    """
    steps = search.plan.substeps
    if steps >= MOST or not trial.terms:
        return None

    def missed(trial: Trial, steps: int) -> float:
        key = ("missed", trial.terms, trial.optimum.z.tobytes(), steps)
        return search.once(key, partial(_missed, search, assessor, trial, steps))

    if missed(trial, steps) <= ACCEPT + missed(base, steps):
        return None
    more = steps
    while (more := 2 * more) < MOST:
        left = missed(trial, more)
        if left * FALLS > missed(trial, more // 2):
            break
        if left < NOTHING * ACCEPT:
            return Finer(steps=more)
    return Finer()


def _missed(search: Search, assessor: Assessor, trial: Trial, steps: int) -> float:
    """Return what so many steps a row miss of a model in all rows, nats."""
    plan, windows = search.plan, search.plan.windows
    track = assessor(trial.optimum.z, windows).track
    there = np.argwhere((windows.ok[:, 1:] > 0).any(axis=2))
    if not len(there):
        return 0.0
    kept = there[np.unique(np.linspace(0, len(there) - 1, min(ROWS, len(there))).astype(int))]
    w, k = kept.T
    x, u = np.asarray(track.mean)[w, k], windows.u[w, windows.lead + k, : len(plan.augmented.model.inputs)]
    p = np.asarray(plan.coordinates.physical(jnp.asarray(trial.optimum.z))[0])
    row = plan.augmented.model.dt * (windows.clock[w, k, 0] if plan.clocked else np.ones(len(w)))
    driven = list(plan.augmented.driven)
    sure = np.asarray(track.predicted_cov)[w, k + 1][:, driven, driven]
    finest, coarse = (_moved(plan.augmented, p, x, u, row, n)[:, driven] for n in (VERY_MANY, steps))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        shift = np.where(coarse == finest, 0.0, (coarse - finest) ** 2 / sure)
    shift = np.minimum(np.nan_to_num(shift, nan=LOST, posinf=LOST), LOST)  # steps that run away miss everything
    counts = np.isfinite(finest).all(axis=1)
    return float(0.5 * np.log1p(shift[counts]).sum() * len(there) / max(counts.sum(), 1))


def _moved(
    augmented: Augmented, p: np.ndarray, x: np.ndarray, u: np.ndarray, row: np.ndarray, steps: int
) -> np.ndarray:
    """Return states (N, nx) one row later, by the classical method of Runge and Kutta.

    Args:
        augmented: the model.
        p: (dp,) its parameters.
        x: (N, nx) states.
        u: (N, nu) inputs, which are held here: when one arrives within the row does not matter.
        row: (N,) how long the row is, s.
        steps: that it is cut into.
    """
    h, now = row / steps, x.T
    inputs, everywhere = u.T, augmented.function.map("everywhere", "serial", len(x), [2], [])  # one p for all points

    def rate(at: np.ndarray) -> np.ndarray:
        return np.asarray(everywhere(at, inputs, p)[0])

    with np.errstate(invalid="ignore", over="ignore"):
        for _ in range(steps):
            one = rate(now)
            two = rate(now + h / 2 * one)
            three = rate(now + h / 2 * two)
            now = now + h / 6 * (one + 2 * two + 2 * three + rate(now + h * three))
    return now.T
