"""How many integration steps a row the effects of a model need.

A search takes as many as the simulator alone needs. A dry friction switches, a stop begins to push and a late input arrives
inside a row: what a step misses there is no noise, and with quiet sensors it is worth tens of nats, which another effect, or
one more, earns that only makes up for the integrator. What is missed in a row counts as it shifts what the filter is sure of,

    1/2 sum_i log(1 + m_i^2 / P_ii),    m = state one row later with n steps less the same with very many, P as predicted there,

what a row loses to noise of the process that makes up for it, summed over the rows that are searched in. No noise of the
process acts on a position: there it is what a sensor shows of it, and P is the variance of its innovation.

Reference: Hairer, Norsett and Wanner (1993), Solving ordinary differential equations I, II.6 (jumps of the right-hand side);
Kullback and Leibler (1951) for the shift of a Gaussian, in nats.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from simpel_cli.discovery.search.again import Earlier
from simpel_cli.discovery.search.trials import ACCEPT, Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.arriving import arriving_inputs, moving_of
from simpel_cli.filtering.likelihood.augmented import Augmented
from simulators.effects.term import ON_INPUT

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
    x, (p, noise) = np.asarray(track.mean)[w, k], plan.coordinates.physical(jnp.asarray(trial.optimum.z))
    at = np.asarray(p)
    row = plan.augmented.model.dt * (windows.clock[w, k, 0] if plan.clocked else np.ones(len(w)))
    names, measured, driven = plan.augmented.model.states, plan.augmented.measured, plan.augmented.driven
    looked = [i for i, q in enumerate(names) if i in driven or q.name in measured]
    shown = [0.0 if i in driven else noise.r[measured.index(names[i].name)] ** 2 for i in looked]
    sure = np.asarray(track.predicted_cov)[w, k + 1][:, looked, looked] + np.asarray(shown)
    finest, coarse = (
        _moved(plan.augmented, at, x, _arriving(search, at, n)[w, k], row)[:, looked] for n in (VERY_MANY, steps)
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        shift = np.where(coarse == finest, 0.0, (coarse - finest) ** 2 / sure)
    shift = np.minimum(np.nan_to_num(shift, nan=LOST, posinf=LOST), LOST)  # steps that run away miss everything
    counts = np.isfinite(finest).all(axis=1)
    return float(0.5 * np.log1p(shift[counts]).sum() * len(there) / max(counts.sum(), 1))


def _arriving(search: Search, p: np.ndarray, steps: int) -> np.ndarray:
    """Return what acts in so many steps of every row of every window, (W, T, steps, K, nu).

    K is 3, beginning, middle and end of a step, where inputs are not held between rows; else 1.
    """
    windows, augmented = search.plan.windows, search.plan.augmented
    u = windows.u[:, :, : len(augmented.model.inputs)]
    late = [p[row] for kind in ON_INPUT for _, row in augmented.operators[kind]]
    if not (any(late) or any(augmented.own_delay) or any(augmented.own_lag) or moving_of(augmented)):
        now = u[:, windows.lead :, None, None]
        return np.broadcast_to(now, (*now.shape[:2], steps, *now.shape[3:]))
    arriving = search.once(("arriving", steps), lambda: jax.jit(arriving_inputs(augmented, steps, windows.lead)))
    every = jnp.broadcast_to(jnp.asarray(p)[:, None], (len(p), len(u)))
    return np.moveaxis(np.asarray(arriving(every, jnp.moveaxis(jnp.asarray(u), 0, -1))), -1, 0)


def _moved(augmented: Augmented, p: np.ndarray, x: np.ndarray, u: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return states (N, nx) one row later, by the classical method of Runge and Kutta.

    Args:
        augmented: the model.
        p: (dp,) its parameters.
        x: (N, nx) states.
        u: (N, steps, K, nu) inputs, K = 1 held over a step, 3 at its beginning, middle and end.
        row: (N,) how long the row is, s.
    """
    h, now = row / u.shape[1], x.T
    everywhere = augmented.function.map("everywhere", "serial", len(x), [2], [])  # one p for all points

    def rate(at: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        return np.asarray(everywhere(at, inputs.T, p)[0])

    with np.errstate(invalid="ignore", over="ignore"):
        for step in np.moveaxis(u, 1, 0):
            begin, middle, end = (step[:, i] for i in (0, step.shape[1] // 2, -1))
            one = rate(now, begin)
            two = rate(now + h / 2 * one, middle)
            three = rate(now + h / 2 * two, middle)
            now = now + h / 6 * (one + 2 * two + 2 * three + rate(now + h * three, end))
    return now.T
