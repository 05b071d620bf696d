"""The second objective: what a model is worth when it simulates, without looking at what was measured on the way.

Without process noise the filter's innovations are the errors of a free run from a start that the measurements tell: the
output-error method. A wrong model's errors then last, so that N rows are worth N/tau independent ones, tau the integrated
autocorrelation time of the errors: every window counts 1/tau. What acts slowly, or only together with something else, is seen
here; what changes from row to row is seen by the innovations.

Reference: Ljung (1999), System identification, 7.2 and 4.2; Geyer (1992), Practical Markov chain Monte Carlo, 3.3 (tau);
Pauli, Racugno and Ventura (2011), Bayesian composite marginal likelihoods (the exponent 1/tau).
"""

import numpy as np

from simpel_cli.discovery.search.selection import Selection, select
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.setup import Setup

LOUD = 0.9  # unit coordinate where the size of the errors begins: a fit that begins quiet creeps
LARGEST = 3.0  # of a channel's magnitude: errors of a free run are not bounded by the noise of a sensor
CORRELATED = 0.1  # autocorrelation below which errors are taken for independent


def simulating(search: Search, assessor: Assessor, base: Trial) -> tuple[Search, Trial]:
    """Return the search over the same effects by simulation error, and the simulator calibrated by it.

    Args:
        search: by innovations.
        assessor: of errors ahead.
        base: the simulator, calibrated by innovations.
    """
    plan = without_process_noise(search.plan, base.optimum.z)
    first = _search(search, plan, 1.0)
    found = first.base()
    tau = correlation_time(assessor(found.optimum.z, plan.windows).free)
    second = _search(search, plan._replace(optimum=found.optimum.z), 1 / tau)
    return second, second.base()


def simulated(search: Search, assessor: Assessor, base: Trial) -> tuple[Search, Selection]:
    """Choose effects by simulation error."""
    own, calibrated = simulating(search, assessor, base)
    return own, select(own, calibrated, 0)


def without_process_noise(plan: Setup, z: np.ndarray) -> Setup:
    """Return a setup whose models follow no measurement: process noise at its least, and errors as large as they come.

    Args:
        plan: in which it is free.
        z: unit coordinates to begin with.
    """
    n_p, n_r, n_q = plan.coordinates.sizes
    r, q = np.arange(n_p, n_p + n_r), np.arange(n_p + n_r, n_p + n_r + n_q)
    high, normal, low = (getattr(plan.coordinates, name).copy() for name in ("high", "normal", "low"))
    size = [plan.scales.size[name] for name in plan.augmented.measured]
    low[r] = np.log([plan.coordinates.value(int(i), 0.25 if normal[i] else 0.0) for i in r])
    high[r] = np.maximum(np.log(LARGEST * np.array(size)), low[r] + 1)
    normal[r] = False
    coordinates = plan.coordinates._replace(low=low, high=high, normal=normal)
    start, optimum = plan.start.copy(), z.copy()
    for at in (start, optimum):
        at[q], at[r] = 0.0, LOUD
    return plan._replace(coordinates=coordinates, start=start, optimum=optimum)


def correlation_time(errors: np.ndarray) -> float:
    """Return the mean over channels of the integrated autocorrelation time of errors (W, T, ny), rows, at least 1."""
    found = []
    for j in range(errors.shape[2]):
        e = np.where(np.isfinite(errors[..., j]), errors[..., j], 0.0)
        rows = e.shape[1]
        lags = np.array([np.sum(e[:, : rows - k] * e[:, k:]) for k in range(rows)])
        if not lags[0] > 0:
            continue
        r = lags / lags[0]
        end = int(np.argmax(r < CORRELATED)) or rows
        found.append(1 + 2 * float(r[1:end].sum()))
    return max(float(np.mean(found)), 1.0) if found else 1.0


def _search(search: Search, plan: Setup, weight: float) -> Search:
    n_p, n_r, n_q = plan.coordinates.sizes
    fitter = search.fitter.within(plan.coordinates).on(plan.windows)
    silent = range(n_p + n_r, n_p + n_r + n_q)
    return Search(plan, fitter, search.report, silent=silent, weight=weight)
