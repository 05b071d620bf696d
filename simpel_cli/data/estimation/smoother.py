"""Speeds that were not measured, from a smoothing spline through the measured position.

    minimise  sum_i (p_i - f(t_i))^2 + lam * integral f''(t)^2 dt,     v = f'

Time is counted in rows, so that lam means the same at any sampling rate. lam minimises generalised cross-validation,

    GCV(lam) = (RSS / n) / (1 - tr H / n)^2,

over all episodes of the sensor at once. The search is ours, since scipy's looks in [0, n] with an absolute tolerance
and so differentiates noise where data are oversampled. tr H follows from the spline's eigenvalues on an even grid.

References: Craven and Wahba (1979); Reinsch (1967) for the matrices behind `_penalty`.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import casadi
import numpy as np

from simpel_cli.data.estimation.hidden_states import Drive, drive, solve
from simpel_cli.data.recording import Check, Episode, Source
from simpel_cli.errors import DataError
from simulators.model import Model

MIN_ROWS = 5  # a cubic smoothing spline needs so many
SEARCH_ROWS = 4000  # rows that the choice of lam looks at: it is the cost of the search, and more tells little
LOG_LAM = (
    -3.0,
    10.0,
)  # from interpolation to a window of about 1000 rows; beyond, the linear system is ill-conditioned


class Smoothed(NamedTuple):
    """Episodes with every state filled in."""

    episodes: tuple[Episode, ...]
    noise: dict[str, tuple[str, float]]  # estimated state -> its position, and std of its noise over the position's
    check: Check


def speeds(model: Source) -> dict[str, list[str]]:
    """States v with d(p)/dt = v exactly, whatever the inputs and parameters: v -> its positions p.

    Nothing is known of a world, which shows no equations.
    """
    n_states = len(model.states)
    if n_states == 0 or not isinstance(model, Model):
        return {}
    function = model.function()
    rng = np.random.default_rng(0)
    points = [
        np.array([rng.uniform(q.low, q.high) for q in group]) for group in (model.states, model.inputs, model.params)
    ]
    on_states, *on_others = (function.jac_sparsity(0, argument) for argument in range(3))
    rows, columns = (np.array(index) for index in on_states.get_triplet())
    foreign = {row for sparsity in on_others for row in sparsity.get_triplet()[0]}
    found: dict[str, list[str]] = {}
    for p in range(n_states):
        reads = columns[rows == p]
        if p in foreign or len(reads) != 1 or reads[0] == p:
            continue
        v = int(reads[0])
        # the row reads v alone; it is linear with slope 1 through 0 if it returns v at points of very different size
        if all(np.isclose(_rate(function, points, p, v, value), value, rtol=1e-9) for value in (0.0, 1.7, -31.0)):
            found.setdefault(model.states[v].name, []).append(model.states[p].name)
    return found


def estimate_speeds(
    model: Source, episodes: Sequence[Episode], unmeasured: tuple[str, ...], raw: float, *, required: bool = True
) -> Smoothed:
    """Fill in the states that were not measured: speeds first, then what drives a measured state (`hidden`).

    Args:
        model: tells which state is the speed of which.
        episodes: contiguous rows, angles unwrapped; training first.
        unmeasured: names of states, NaN in the episodes.
        raw: dt of the data, s.
        required: refuse a state that cannot be estimated, else leave it NaN.

    Returns:
        Episodes of at least `MIN_ROWS` rows, and what was done.

    Raises:
        DataError: a state is neither the speed of a measured one nor alone in driving one.
    """
    names = [q.name for q in model.states]
    relations = speeds(model)
    source = {
        name: measured[0]
        for name in unmeasured
        if (measured := [p for p in relations.get(name, []) if p not in unmeasured])
    }
    drives: dict[str, Drive] = {}
    left = []
    for name in [name for name in unmeasured if name not in source]:
        try:
            drives[name] = _driven(model, name, unmeasured, relations, source)
        except DataError:
            if required:
                raise
            left.append(name)
    long = [episode for episode in episodes if len(episode.time) >= MIN_ROWS]
    if not long:
        raise DataError(f"too few rows: {', '.join(unmeasured)} cannot be estimated, no segment has {MIN_ROWS} rows.")
    noise: dict[str, tuple[str, float]] = {}
    done = []
    for name, position in source.items():
        p, v = names.index(position), names.index(name)
        lam = choose_smoothing([episode.states[:, p] for episode in long])
        for episode in long:
            episode.states[:, v] = _slope(episode.time, episode.states[:, p], lam, raw)
        noise[name] = (position, slope_noise(lam) / raw)
        done.append(f"{name} = d({position})/dt of a smoothing spline (window about {lam**0.25 * raw:.2g} s, by GCV)")
    done += [f"{name} left open: no measured state has it as its time derivative" for name in left]
    leans = False
    for name, found in drives.items():
        assert isinstance(model, Model)  # of a world nothing is known that could be solved
        lam = choose_smoothing([episode.states[:, found.seen] for episode in long])
        solved = []
        for episode in long:
            rate = _slope(episode.time, episode.states[:, found.seen], lam, raw)
            solved.append(solve(model, found, episode.states, episode.inputs, rate))
            episode.states[:, found.hidden] = solved[-1].values
        noise[name] = (names[found.seen], slope_noise(lam) / raw / float(np.median([s.sensitivity for s in solved])))
        at_an_end = float(np.average([s.at_an_end for s in solved], weights=[len(e.time) for e in long]))
        done.append(
            f"{name} from d({names[found.seen]})/dt, by the simulator with its parameters in the middle of their ranges"
            + (f" ({at_an_end:.1%} of the rows at an end of its range)" if at_an_end else "")
        )
        leans = True
    short = len(episodes) - len(long)
    if short:
        done.append(f"{short} segments shorter than {MIN_ROWS} rows dropped")
    return Smoothed(tuple(long), noise, Check("estimated", short == 0 and not leans, "; ".join(done)))


def choose_smoothing(signals: Sequence[np.ndarray]) -> float:
    """Minimise generalised cross-validation over half decades of lam (13 % in the width of the window).

    Args:
        signals: of one sensor, each (T,) with T >= 5, equal steps.

    Returns:
        lam for time counted in rows.
    """
    chosen, room = [], SEARCH_ROWS
    for signal in signals:
        if room >= MIN_ROWS:
            chosen.append(signal[:room])
            room -= len(signal)
    grid = 10.0 ** np.arange(LOG_LAM[0], LOG_LAM[1] + 0.1, 0.5)
    return float(min(grid, key=lambda lam: _gcv(chosen, lam)))


def slope_noise(lam: float) -> float:
    """Standard deviation of the slope per row, for white noise of unit variance, far from the ends."""
    w = (np.arange(4096) + 0.5) * np.pi / 4096
    gain = 3 * np.sin(w) / (2 + np.cos(w)) / (1 + lam * _penalty(w))
    return float(np.sqrt(np.mean(gain**2)))


def _gcv(signals: Sequence[np.ndarray], lam: float) -> float:
    from scipy.interpolate import make_smoothing_spline  # here, since its import takes long

    n, misfit, trace = 0, 0.0, 0.0
    for signal in signals:
        x = np.arange(len(signal), dtype=float)
        misfit += float(np.sum((signal - make_smoothing_spline(x, signal, lam=lam)(x)) ** 2))
        # constants and straight lines pass; the k-th eigenvector of a free end swings (k - 1.5)/2 times
        trace += 2 + float(np.sum(1 / (1 + lam * _penalty(np.pi * (np.arange(3, len(x) + 1) - 1.5) / len(x)))))
        n += len(x)
    return (misfit / n) / (1 - trace / n) ** 2


def _penalty(w: np.ndarray) -> np.ndarray:
    """Integral of f''^2 per unit of sum f^2, for the cubic spline through a wave of w rad per row."""
    return 3 * (2 - 2 * np.cos(w)) ** 2 / (2 + np.cos(w))


def _slope(time: np.ndarray, position: np.ndarray, lam: float, raw: float) -> np.ndarray:
    from scipy.interpolate import make_smoothing_spline

    x = (time - time[0]) / raw
    return np.asarray(make_smoothing_spline(x, position, lam=lam).derivative()(x)) / raw


def _driven(
    model: Source, name: str, unmeasured: tuple[str, ...], relations: dict[str, list[str]], source: Mapping[str, str]
) -> Drive:
    """How a state that is no speed shows in a measured one; speeds count as measured by now."""
    found = drive(model, name, [other for other in unmeasured if other not in source])
    if found is not None:
        return found
    able = [f"{v} from {p}" for v, positions in relations.items() for p in positions if p not in unmeasured]
    can = f"Of '{model.name}' can be estimated: {', '.join(able)}." if able else "None of its states can be estimated."
    raise DataError(
        f"data.columns.{name}: null, but no measured state has '{name}' as its time derivative or a rate that tells "
        f"it, so it cannot be estimated here. {can} Measure it, or use a simulator without it."
    )


def _rate(function: casadi.Function, points: list[np.ndarray], row: int, state: int, value: float) -> float:
    """Time derivative of state `row` where `state` has the value and everything else is as in `points`."""
    x = points[0].copy()
    x[state] = value
    return float(function(x, *points[1:])[0][row])
