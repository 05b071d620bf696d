"""The last calibration: of the chosen model, for what it will be used for.

The innovations say which physics; a model that is still wrong somewhere has parameters that predict the next row best, and
others that simulate best. So with the effects settled the parameters are fitted once more, to the errors so far ahead as the
model will be used,

    1/2 sum_k e_k^2 / (sigma^2 tau) + 1/2 |(z - z_0) / s|^2,

sigma and tau the size (per episode) and the integrated autocorrelation time of the errors before, s the standard deviation of
the prior. The second term is that prior, about where the innovations put it: what these errors do not tell stays there.

Reference: Ljung (1999), System identification, 7.2 (output error); Geyer (1992), Practical Markov chain Monte Carlo, 3.3 (tau);
Nocedal and Wright (2006), Numerical optimization, 10.3.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from simpel_cli.data import Recording
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import SETTLE, Assessor, with_lost
from simpel_cli.filtering.independent_parts import correlation_time
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.likelihood.steps import LEAST_CURVATURE
from simpel_cli.filtering.measurements.windows import LEAST_EPISODES, Windows, thinned
from simpel_cli.filtering.setup import Setup, whole_windows
from simulators.effects.term import ON_SENSOR, SENSOR

ONE_STEP, FREE_RUN = "one_step", "free_run"
NUDGE = 1e-4  # of a range, for differences
MOST_TIMES = 3.0
HALF_TURN = 2.8  # rad: an error of an angle beyond may jump by a turn
LOST = 1e3  # standard deviations that an error counts where a model runs away
MOST = 15  # steps
MOST_ROWS = 20_000  # of a record, evenly spaced windows of a longer one
MOST_ROWS_OF_STEP = 4000  # for a model between the first and the last
MOST_OF_REACH = 4  # times the rows ahead that a window has
ENOUGH = 1e-4  # of the cost: about a tenth of a nat
MOST_FOLDS = 5

Errors = Callable[[np.ndarray], np.ndarray]  # (models, n) -> (models, W, T, ny)


def calibrated_for(search: Search, assessor: Assessor, trial: Trial, windows: Windows, use: str | float) -> Trial:
    """Return a model with the parameters that suit a use.

    Args:
        search: that it comes from.
        assessor: of its program.
        trial: the model as the innovations calibrated it.
        windows: of the training rows, each as long as its episode.
        use: ONE_STEP, FREE_RUN, or how far ahead, s.
    """
    # a sensor's parameters would move what the filter begins with, not what is simulated
    sensors = {
        i for t, term in enumerate(search.terms) if term.kind in (SENSOR, *ON_SENSOR) for i in search.all_rows(t)
    }
    rows = [i for i in trial.optimum.free if i not in search.noise and i not in sensors]
    if use == ONE_STEP or not rows:
        return trial
    errors = _errors_of(assessor, windows, use, search.plan.augmented.model.dt)
    z = trial.optimum.z
    before = errors(z[None])[0]
    tau = _memory(before)
    sigma = _sizes(before)
    there = np.isfinite(windows.y) & (windows.ok > 0) & np.isfinite(before) & (sigma > 0)
    sigma = np.where(sigma > 0, sigma, 1.0)
    periodic = {q.name for q in search.plan.augmented.model.states if q.periodic}
    turns = [name in periodic for name in search.plan.augmented.measured]
    there &= ~(np.array(turns) & (np.abs(np.nan_to_num(before)) > HALF_TURN))  # where an error jumps it has no slope
    if not there.any():
        return trial

    sd = np.asarray(search.plan.coordinates.sd_of_prior())[rows]
    prior = np.sqrt(np.where(np.isfinite(sd), 1 / sd**2, LEAST_CURVATURE))

    def residual(at: np.ndarray) -> np.ndarray:
        """Return what is squared, (models, residuals); at: (models, unknowns)."""
        moved = np.repeat(z[None], len(at), axis=0)
        moved[:, rows] = at
        e = (errors(moved) / (sigma * np.sqrt(tau)))[:, there]
        e = np.where(np.isfinite(e), np.clip(e, -LOST, LOST), LOST)
        return np.concatenate([e, prior * (at - z[rows])], axis=1)

    def slope(at: np.ndarray) -> np.ndarray:
        step = np.where(at > 0.5, -NUDGE, NUDGE)
        both = residual(np.concatenate([at[None], at + np.diag(step)]))
        return ((both[1:] - both[0]) / step[:, None]).T

    begin = np.clip(z[rows], NUDGE, 1 - NUDGE)

    def one(at: np.ndarray) -> np.ndarray:
        return residual(at[None])[0]

    found: Any = least_squares(one, begin, slope, bounds=(0.0, 1.0), max_nfev=MOST, ftol=ENOUGH)
    if not found.cost < 0.5 * float(np.sum(residual(z[rows][None]) ** 2)):
        return trial
    moved = z.copy()
    moved[rows] = found.x
    return Trial(trial.terms, _placed(trial, rows, moved, np.linalg.inv(found.jac.T @ found.jac)))


def windows_for(plan: Setup, recording: Recording, use: str | float, most: int = MOST_ROWS) -> Windows:
    """Return the training windows in which a model is calibrated for a use, evenly spaced ones of a long record.

    Args:
        plan: of the search.
        recording: the measurements.
        use: FREE_RUN: as long as their episodes; or how far ahead, s.
        most: rows of them, about.
    """
    longest = None
    if use != FREE_RUN:  # the first rows of a window, from which none is so far ahead, are a small part of it
        reach = SETTLE + rows_ahead(use, plan.augmented.model.dt)
        longest = max(plan.windows.y.shape[1], MOST_OF_REACH * reach)
    return thinned(whole_windows(plan, recording.train, recording.outputs, longest), most)[0]


def in_words(use: str | float, windows: Windows, dt: float, *, moved: bool) -> str:
    """Return what a calibration for a use in windows came to, in a line; moved: whether its parameters are others."""
    what = use if use == FREE_RUN else f"{use:g} s ahead"
    if use != FREE_RUN and windows.y.shape[1] <= SETTLE + rows_ahead(use, dt):
        return f"not calibrated for {what}: no training episode is so long"
    return f"calibrated for {what}{'' if moved else ': what the innovations say does as well'}"


def rows_ahead(use: str | float, dt: float) -> int:
    """Return how many rows ahead some seconds are."""
    return max(1, round(float(use) / dt))


def _sizes(errors: np.ndarray) -> np.ndarray:
    """Return the size of errors (W, T, ny) per window, (W, 1, ny): what is wrong grows with the motion.

    No window counts more than `MOST_TIMES` a typical one for having small errors.
    """
    count = np.maximum(np.isfinite(errors).sum(axis=1, keepdims=True), 1)
    own = np.sqrt(np.nansum(errors**2, axis=1, keepdims=True) / count)
    return np.maximum(own, np.median(own, axis=0) / MOST_TIMES)


def suited(search: Search, assessor: Assessor, trial: Trial, windows: Windows, use: str | float) -> Trial:
    """Return a model with the parameters that suit a use, where they do so on episodes that had no part in them, too.

    A model that is wrong where its errors are largest is bent to these, and may be worse everywhere else: what the innovations
    say stays then. Fewer than three episodes cannot tell.

    Args: as of `calibrated_for`.
    """
    groups = np.unique(windows.episode)
    if use == ONE_STEP or len(groups) < LEAST_EPISODES:
        return calibrated_for(search, assessor, trial, windows, use)
    folds = np.array_split(np.random.default_rng(0).permutation(groups), min(MOST_FOLDS, len(groups)))
    episode, dt = search.plan.windows.episode, search.plan.augmented.model.dt
    weights = [np.where(np.isin(episode, fold), 0.0, 1.0) for fold in folds]
    fits = search.fitter([Hypothesis(trial.optimum.z, trial.optimum.free, weight) for weight in weights])
    ratios = []
    for fold, optimum in zip(folds, fits, strict=True):
        out = np.isin(windows.episode, fold)
        rest, held = (Windows(*(a[part] for a in windows)) for part in (~out, out))
        own = Trial(trial.terms, optimum)
        both = np.stack([t.optimum.z for t in (own, calibrated_for(search, assessor, own, rest, use))])
        first, second = _errors_of(assessor, held, use, dt)(both)
        squares = np.stack([np.nansum(e**2, axis=(0, 1)) for e in with_lost(first, second)])
        seen = (squares > 0).all(axis=0)
        ratios.append(float(np.log(squares[1, seen] / squares[0, seen]).sum()))
    better = sum(ratios) < 0  # of every fold alike: the largest motions do not decide for all
    return calibrated_for(search, assessor, trial, windows, use) if better else trial


def _memory(errors: np.ndarray) -> float:
    """Return the mean over channels of the correlation time of errors (W, T, ny), rows, at least 1."""
    there = np.isfinite(errors) & (errors != 0)
    seen = [j for j in range(errors.shape[2]) if there[..., j].any()]
    return float(np.mean([correlation_time(errors[..., j]) for j in seen])) if seen else 1.0


def _placed(trial: Trial, rows: list[int], z: np.ndarray, covariance: np.ndarray) -> Any:
    """Return an optimum that lies elsewhere, as certain as the errors so far ahead make it."""
    optimum = trial.optimum
    at = [optimum.free.index(i) for i in rows]
    centre, wide = optimum.centre.copy(), optimum.covariance.copy()
    centre[at] = z[rows]
    wide[at, :], wide[:, at] = 0.0, 0.0
    wide[np.ix_(at, at)] = covariance
    return optimum._replace(z=z, centre=centre, covariance=wide)


def _errors_of(assessor: Assessor, windows: Windows, use: str | float, dt: float) -> Errors:
    if use == FREE_RUN:
        return lambda z: assessor.free_runs(z, windows)
    ahead = assessor.of(assessor.plan, rows_ahead(use, dt))
    return lambda z: np.stack([ahead(one, windows).ahead for one in z])
