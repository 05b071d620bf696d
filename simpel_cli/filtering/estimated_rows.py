"""Rows in which not everything was measured, made whole: the filter of the calibrated simulator says what is missing.

A value that was measured stays as it is. One that was measured less than a row before its row is moved there by as much as
the smoothed state moves:

    y_k = y(t_k - d) + d/(t_k - t_{k-1}) (y^_k - y^_{k-1}),    y^: smoothed

Where the stamps of rows stray, values move to even rows (`even_rows`). One that is missing is the smoother's mean where it
is learned from. Where a posterior is tested it is the filter's, which has not seen what comes next. The variance v of an
estimate, over that of a measured value, says how much the changes count in which it has a part (`Episode.weight`): errors in
variables, by their size.

Reference: Sarkka (2013), Bayesian filtering and smoothing, ch. 8; Fuller (1987), Measurement error models, sec. 1.1.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.dynamics.arriving import acting
from simpel_cli.dynamics.late_readings import behind
from simpel_cli.errors import DataError
from simpel_cli.filtering.even_rows import even_times, inputs_at, moved, uneven
from simpel_cli.filtering.initial_states import begun
from simpel_cli.filtering.likelihood.fit import Fitter, Hypothesis
from simpel_cli.filtering.likelihood.latent_force import smooth
from simpel_cli.filtering.measurements.cleaning import cleaned
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import LEAST_ROWS, Setup, setup, whole_windows
from simpel_cli.filtering.tracks import Tracks
from simulators.model import Model

STARTS = 6  # of the calibration
MOST_ROWS = 3000  # that the calibration looks at
FEW = 0.05  # of the rows, that are nothing to look at
MOST_WEIGHT = 0.999  # of an estimate: below 1, which is what was measured
NOTHING = 1e-9  # weight of an output that is missing: the state says what the simulator reads there, no more


class _Found(NamedTuple):
    """What the filter says of one episode, (T, ...).

    Args:
        smooth, filtered: states, (T, nx).
        smooth_var, filtered_var: their variances, (T, nx).
    """

    smooth: np.ndarray
    smooth_var: np.ndarray
    filtered: np.ndarray
    filtered_var: np.ndarray


def whole(recording: Recording) -> bool:
    """Whether every value was measured at its row."""
    return all(
        e.late is None and np.isfinite(e.states).all() and np.isfinite(e.outputs).all()
        for e in (*recording.train, *recording.test)
    )


def needed(recording: Recording, model: Model) -> bool:
    """Whether rows are not whole, or not even, and there are enough to calibrate a filter by."""
    if not model.states or sum(len(e.time) for e in recording.train) < LEAST_ROWS:
        return False
    return not whole(recording) or uneven((*recording.train, *recording.test), model.dt)


def too_few(recording: Recording) -> bool:
    """Whether values are missing and there are too few rows to calibrate a filter by."""
    return not whole(recording) and sum(len(e.time) for e in recording.train) < LEAST_ROWS


def with_estimates(recording: Recording, model: Model, declared_noise: Sequence[str]) -> Recording:
    """Return a recording whose rows are whole.

    Args:
        recording: rows that may lack values, have values that were measured before their row, or stray from even ones.
        model: the simulator.
        declared_noise: names of the channels whose noise the user declared.

    Raises:
        DataError: too few rows, nothing but noise, or a simulator whose states run away.
    """
    words = zip(model.inputs, model.words_between_rows, strict=True)
    model = replace(
        model, between_rows={q.name: word for q, word in words}
    )  # where nothing is said, an input is held: `discover` asks, a fit does not
    plan = setup(model, cleaned(recording, model, declared_noise).recording, declared_noise, [], most_rows=MOST_ROWS)
    tracks = Tracks(plan)
    z = _calibrated(plan)
    parameters, level = plan.coordinates.physical(jnp.asarray(z))
    p, noise = np.asarray(parameters), np.asarray(level.r)
    every = (*recording.train, *recording.test)
    even = even_times([e.time for e in every]) if uneven(every, model.dt) else [None] * len(every)
    train = _of_episodes(plan, tracks, z, recording.train, recording.outputs)
    test = _of_episodes(plan, tracks, z, recording.test, recording.outputs) if recording.test else []
    typical = _typical(plan, noise, train)
    together = _measured_together(recording.test)
    made = [
        _made(plan, e, f, p, typical, kept=None, even=at)
        for e, f, at in zip(recording.train, train, even[: len(train)], strict=True)
    ]
    tested = [
        _once_known(_made(plan, e, f, p, typical, kept=together, even=at), e, together)
        for e, f, at in zip(recording.test, test, even[len(train) :], strict=True)
    ]
    good, left = [[e for e in part if np.isfinite(e.states).all()] for part in (made, tested)]
    if not good:
        raise DataError(
            f"sim: the filter of {model.name} lost the measurements in all of {len(made)} episodes, so that nothing tells the "
            "values that are missing. Give rows in which everything was measured, or narrow sim.parameters."
        )
    before = tuple(_moved_to_even(c) if even[0] is not None else c for c in recording.checks)
    checks = before if whole(recording) else (*before, _check(plan, recording, good, noise, typical, together))
    level_of = {q.name: float(np.sqrt(v)) for q, v in zip(plan.augmented.model.states, typical, strict=True)}
    level_of |= dict(zip(plan.augmented.measured, noise.tolist(), strict=True))
    level_of |= {name: std for name, std in recording.noise_std.items() if name in declared_noise}
    return recording._replace(
        train=tuple(good), test=tuple(left), checks=checks, noise_std=dict(recording.noise_std) | level_of
    )


def _calibrated(plan: Setup) -> np.ndarray:
    """Return unit coordinates of the simulator's parameters and of the noise."""
    n_p, n_r, n_q = plan.coordinates.sizes
    params = len(plan.augmented.model.params)
    free = (*range(params), *range(n_p, n_p + n_r + n_q))
    random = np.random.default_rng(0)
    starts = [plan.start.copy() for _ in range(STARTS)]
    for start in starts[1:]:
        start[:params] = random.uniform(0.1, 0.9, params)
    ones = np.ones(len(plan.windows.episode))
    windows = begun(Tracks(plan), plan.start, plan.windows)
    fitter = Fitter(plan.rule, plan.coordinates, windows, width=len(free))
    found = max(fitter([Hypothesis(start, free, ones) for start in starts]), key=lambda o: o.log_evidence)
    if not np.isfinite(found.log_evidence):
        raise DataError(
            f"sim: no parameters within the ranges of {plan.augmented.model.name} gave the measurements a finite likelihood "
            f"in {STARTS} tries, so that what is missing cannot be estimated. Narrow sim.parameters, or give rows in "
            "which everything was measured."
        )
    return found.z


def _of_episodes(
    plan: Setup, tracks: Tracks, z: np.ndarray, episodes: Sequence[Episode], outputs: Sequence[str]
) -> list[_Found]:
    """Run filter and smoother along episodes; NaN where a piece is too short for a window."""
    windows: Windows = begun(tracks, z, whole_windows(plan, episodes, outputs))
    track = tracks.track(z, windows)
    smoothed = smooth(track)
    values = (smoothed.mean, _variances(smoothed.cov), np.asarray(track.mean), _variances(np.asarray(track.cov)))
    nx = smoothed.mean.shape[-1]
    found = [_Found(*[np.full((len(e.time), nx), np.nan) for _ in values]) for e in episodes]
    length = windows.y.shape[1]
    for w, (index, begin) in enumerate(zip(windows.episode.tolist(), windows.begin.tolist(), strict=True)):
        rows = slice(begin, min(begin + length, len(episodes[index].time)))
        for place, value in zip(found[index], values, strict=True):
            place[rows] = value[w, : rows.stop - rows.start]
    return found


def _variances(cov: np.ndarray) -> np.ndarray:
    return np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0)


def _typical(plan: Setup, noise: np.ndarray, found: Sequence[_Found]) -> np.ndarray:
    """Return the variance that counts as that of a measured value, per state: its noise, or of none the usual estimate's."""
    measured = dict(zip(plan.augmented.measured, noise, strict=True))
    every = np.concatenate([f.smooth_var for f in found])
    usual = np.nanmedian(every, axis=0)
    return np.array([
        measured[q.name] ** 2 if q.name in measured else float(usual[i]) for i, q in enumerate(plan.augmented.model.states)
    ])  # fmt: skip


def _measured_together(episodes: Sequence[Episode]) -> np.ndarray:
    """Return whether estimates are told apart from measurements when a posterior is tested, per column.

    A column of which nothing was measured can only be compared with estimates; where no transition ends with every other state,
    and begins with every other output, all are.
    """
    if not episodes:
        return np.ones(0, bool)
    there = np.concatenate([np.isfinite(np.concatenate([e.states[1:], e.outputs[:-1]], axis=1)) for e in episodes])
    apart = np.asarray(there.any(axis=0))
    return apart if there[:, apart].all(axis=1).any() else np.zeros(len(apart), bool)


def _made(
    plan: Setup,
    episode: Episode,
    found: _Found,
    p: np.ndarray,
    typical: np.ndarray,
    kept: np.ndarray | None,
    *,
    even: np.ndarray | None,
) -> Episode:
    """Return the episode with every value at its row.

    Args:
        plan: of the filter.
        episode: rows as they were measured.
        found: what the filter says of it.
        p: parameters of the model, physical.
        typical: variance of a measured value, per state.
        kept: of an episode to test on, which columns tell estimates from measurements; None: of one to learn from.
        even: times of the even rows that those which stray move to, (T,) s; None: they stay.
    """
    model, n_states = plan.augmented.model, episode.states.shape[1]
    found = found._replace(smooth=_on_from_row_to_row(found.smooth, model))
    values = np.concatenate([episode.states, episode.outputs], axis=1)
    there = np.isfinite(values)
    smoothed = _shown(found.smooth, episode, p, plan)
    estimate, variance = smoothed.copy(), found.smooth_var
    if kept is not None and kept.any():
        # what comes next is what is tested: only what nothing measures looks back at it
        filtered = _shown(found.filtered, episode, p, plan)
        estimate = np.where(kept[None], filtered, smoothed)
        variance = np.where(kept[None, :n_states], found.filtered_var, found.smooth_var)
    for i, q in enumerate(model.states):
        if q.periodic:
            estimate[:, i] = _nearest_turn(estimate[:, i], values[:, i])
    if episode.late is not None:
        at_an_end = np.zeros(values.shape, bool) if episode.beyond is None else episode.beyond != 0
        values = values + np.where(at_an_end, 0.0, _moved(episode, smoothed))
    time, inputs = episode.time, episode.inputs
    if even is not None:
        time = even
        inputs = inputs_at(episode.time, time, episode.inputs, model.linear)
        rates = partial(_rates, model, p)
        felt = acting(model, np.nan_to_num(episode.inputs), p[: len(model.params)])
        there_then = found.smooth + moved(episode.time, time, found.smooth, felt, model.linear, rates)
        shift = np.nan_to_num(_shown(there_then, episode._replace(inputs=inputs), p, plan) - smoothed)
        at_an_end = np.zeros(values.shape, bool) if episode.beyond is None else episode.beyond != 0
        values, estimate = values + np.where(at_an_end, 0.0, shift), estimate + shift
    weight = np.full(values.shape, NOTHING)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight[:, :n_states] = np.minimum(typical[None] / variance, MOST_WEIGHT)
    weight = np.where(there, 1.0, weight)
    # estimates are all there is of a state that nothing measures: they count alike, and its noise is learned from them
    weight[:, [i for i, q in enumerate(model.states) if q.name not in plan.augmented.measured]] = 1.0
    if kept is not None:
        weight[:, ~kept] = 1.0
    filled = np.where(there, values, estimate)
    return episode._replace(
        time=time,
        inputs=inputs,
        states=filled[:, :n_states],
        outputs=filled[:, n_states:],
        late=None,
        weight=None if (weight == 1).all() else weight,
    )


def _moved_to_even(check: Check) -> Check:
    """Say of strayed stamps what was done."""
    if check.name != "jitter":
        return check
    said = check.detail.split("; data.resample")[0]
    return check._replace(ok=True, detail=f"{said}; values moved to even rows by what the simulator does there")


def _once_known(whole: Episode, measured: Episode, kept: np.ndarray) -> Episode:
    """Return an episode to test on from the row on by which every state has been measured once.

    Before that the filter knows no more than the range of a state, and an error ahead is that of the guess.
    """
    there = np.isfinite(measured.states) | ~kept[None, : measured.states.shape[1]]
    known = np.flatnonzero(there.cumsum(axis=0).all(axis=1))
    first = int(known[0]) if len(known) else 0
    return type(whole)(whole.name, *(a if a is None else a[first:] for a in whole[1:]))  # type: ignore[arg-type]


def _shown(states: np.ndarray, episode: Episode, p: np.ndarray, plan: Setup) -> np.ndarray:
    """Return what the columns of states and measured outputs show at states, (T, nx + n_outputs)."""
    model = plan.augmented.model
    own = p[: len(model.params)]
    inputs = acting(model, np.nan_to_num(episode.inputs), own)
    names = [q.name for q in (*model.states, *model.outputs)]
    columns = [
        *range(len(model.states)),
        *(names.index(n) for n in plan.augmented.measured if n in names[len(model.states) :]),
    ]
    at = np.tile(own[:, None], (1, len(states)))
    read = np.asarray(model.function().map(len(states))(states.T, inputs.T, at)[1]).reshape(
        len(model.outputs), len(states)
    )
    return (np.concatenate([states, read.T], axis=1) + behind(model, states, inputs, own))[:, columns]


def _rates(model: Model, p: np.ndarray, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the rates of the states at rows, (T, nx)."""
    at = np.tile(p[: len(model.params), None], (1, len(states)))
    return np.asarray(model.function().map(len(states))(states.T, np.nan_to_num(inputs).T, at)[0]).T


def _moved(episode: Episode, smoothed: np.ndarray) -> np.ndarray:
    """Return how far a value moved from when it was measured to its row, 0 where it was measured there."""
    assert episode.late is not None
    step = np.diff(episode.time)
    rate = np.diff(smoothed, axis=0) / step[:, None]
    rate = np.concatenate([rate[:1], rate])
    return np.where(np.isfinite(rate), rate, 0.0) * episode.late


def _on_from_row_to_row(smoothed: np.ndarray, model: Model) -> np.ndarray:
    """Return smoothed states, (T, nx), whose angles go on from row to row: windows may begin on turns of their own."""
    on = smoothed.copy()
    for i, q in enumerate(model.states):
        there = np.isfinite(on[:, i])
        if q.periodic:
            on[there, i] = np.unwrap(on[there, i])
    return on


def _nearest_turn(angle: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return angles on the turn of the measured ones about them."""
    there = np.flatnonzero(np.isfinite(measured))
    if not len(there):
        return angle
    near = np.interp(np.arange(len(angle)), there, measured[there])
    turned: np.ndarray = angle + 2 * np.pi * np.round((near - angle) / (2 * np.pi))
    return turned


def _check(
    plan: Setup,
    recording: Recording,
    made: Sequence[Episode],
    noise: np.ndarray,
    typical: np.ndarray,
    together: np.ndarray,
) -> Check:
    """Say what was estimated, how well it is known, and what scores compare with; together: of `_measured_together`."""
    model, told, shares = plan.augmented.model, [], []
    names = [*(q.name for q in model.states), *recording.outputs]
    units = {q.name: q.unit for q in (*model.states, *model.outputs)}
    every = [np.concatenate([e.states, e.outputs], axis=1) for e in (*recording.train, *recording.test)]
    missing = 1 - np.isfinite(np.concatenate(every)).mean(axis=0)
    weights = np.concatenate([e.weight for e in made if e.weight is not None] or [np.ones((1, len(names)))])
    for i, name in enumerate(names):
        if not missing[i]:
            continue
        shares.append(missing[i])
        share = f"{name}: {100 * missing[i]:.3g} % of the rows"
        if i < len(model.states):
            own = weights[:, i][weights[:, i] < 1]
            if len(own):
                std = np.sqrt(typical[i] / np.median(own))
                known = dict(zip(plan.augmented.measured, noise, strict=True)).get(name)
                beside = f", noise {known:.3g}" if known is not None else ""
                share += f" (standard deviation {std:.3g}{beside} {units[name]})".replace(" )", ")")
        told.append(share)
    late = sum(int((e.late > 0).sum()) for e in (*recording.train, *recording.test) if e.late is not None)
    if late:
        told.append(f"{late} values moved to their rows by what the simulator does there")
    blind = [name for name, apart in zip(names, together, strict=False) if not apart]
    if len(blind) == len(names):
        told.append("test scores compare with estimates, since no transition ends with every value")
    elif blind:
        told.append(f"test scores of {', '.join(blind)} compare with estimates: nothing measured it")
    return Check("estimated by the simulator's filter", max(shares, default=0.0) <= FEW and not blind, "; ".join(told))
