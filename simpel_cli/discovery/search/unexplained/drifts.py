"""A parameter of the simulator that is no constant: it drifts over every episode alike, or differs from one to the next.

    d(x)/dt = f(x, u, p + delta(t)),   delta(t) = c (t/T - 1/2)  over an episode of length T,   or  delta_e in episode e

To first order that is a force df/dp delta(t), so what it would earn in evidence is known without a fit (`noise_profile`), for a
few sizes of c, and of the spread of delta_e, all equally probable. A warming motor, a draining battery and a settling fluid
drift; payloads, tyres and subjects differ.

Reference: Ljung (1999), System identification, 11.2 (time-varying parameters); Bishop (2006), eq. 3.86.
"""

from collections.abc import Sequence
from typing import NamedTuple

import casadi
import numpy as np

from simpel_cli.discovery.search.trials import TIE, Trial
from simpel_cli.discovery.search.unexplained.noise_profile import Level, NoiseProfile, evidence
from simpel_cli.filtering.likelihood.augmented import Augmented
from simpel_cli.filtering.likelihood.sensitivity import shifts
from simpel_cli.filtering.measurements.windows import Windows
from simulators.groups import MEMBER, SPREAD

OVER, BETWEEN = "over an episode", "from episode to episode"
SIZES = (0.5, 0.15, 0.05, 0.015)  # of the parameter's range
CERTAIN = 10.0  # nats that it has to earn: no episode was held out for it
HALF = 0.5  # of what effects explain: fitted, what is no constant has explained twice what it promises to first order
LEAST_EPISODES = 3  # of which one can say that they differ


class Drift(NamedTuple):
    """A parameter that is no constant.

    Args:
        parameter: its name.
        how: OVER or BETWEEN.
        size: from the beginning of an episode to its end; or the standard deviation between episodes; in its unit.
        unit: of the parameter.
        acts_on: state whose rate it changes most.
        gain: in evidence, nats.
    """

    parameter: str
    how: str
    size: float
    unit: str
    acts_on: str
    gain: float

    @property
    def words(self) -> str:
        """What it does, in words."""
        by = f"by {self.size:+.3g}" if self.how == OVER else f"with a standard deviation of {self.size:.3g}"
        return f"{self.parameter} {'drifts' if self.how == OVER else 'differs'} {self.how}, {by} {self.unit}".rstrip()


def stands_for(drift: Drift | None, base: Trial, chosen: Trial, known: float = 0.0) -> bool:
    """Whether episodes that differ, in the simulator alone, explain as much as all that was chosen instead.

    What drifts over an episode is fitted beside the effects (`instead_of_drifts`). known: evidence of a function that was
    accepted beside the effects, nats.
    """
    effects = chosen.optimum.log_evidence - base.optimum.log_evidence + known
    return drift is not None and drift.how == BETWEEN and bool(chosen.terms) and drift.gain > effects - TIE


def may_stand_for(drift: Drift | None, base: Trial, chosen: Trial) -> bool:
    """Whether it may do so once it is fitted: to first order a drift promises half of what it then explains, or more."""
    effects = chosen.optimum.log_evidence - base.optimum.log_evidence
    return drift is not None and bool(chosen.terms) and drift.gain > HALF * effects


def drifting(levels: NoiseProfile, ways: Sequence[str] = (OVER, BETWEEN)) -> Drift | None:
    """Return the parameter that is no constant for which the data ask most; None where there is none.

    Args:
        levels: of a model.
        ways: in which it may be none.
    """
    key = "drifts", levels.chosen.terms, levels.chosen.optimum.z.tobytes()
    found = levels.search.once(key, lambda: _drifts(levels))
    return max((d for d in found if d.how in ways and d.gain > CERTAIN), key=lambda one: one.gain, default=None)


def _drifts(levels: NoiseProfile) -> list[Drift]:
    """Return what every parameter earns as no constant, either way, at every level of the noise."""
    plan, chosen = levels.search.plan, levels.chosen
    model = plan.augmented.model
    names = [i for i, q in enumerate(model.params) if q.role not in (SPREAD, MEMBER) and i in chosen.optimum.free]
    if not names or not model.states:
        return []
    z = chosen.optimum.z
    p = np.array([plan.coordinates.value(i, float(z[i])) for i in range(plan.coordinates.sizes[0])])
    slopes = _slopes(plan.augmented, names)
    progress, own = _progress(plan.windows), _indicators(plan.windows.episode)
    ways = [OVER] + ([BETWEEN] if own.shape[1] >= LEAST_EPISODES else [])
    penalty = np.log(len(SIZES) * len(names) * len(ways))
    found = []
    for row in plan.coordinates.driven:
        here = levels(row)
        if not here:
            continue
        base = max(level.reached for level in here) + penalty
        for level in here:
            moves = _moves(level, plan.augmented, slopes, p, progress, model.dt)  # (names, W, T, ny, 2)
            for k, i in enumerate(names):
                q = model.params[i]
                span = plan.coordinates.span(i, float(z[i]))
                over, alike = moves[k, ..., 1], moves[k, ..., 0]
                for how in ways:
                    columns = over[..., None] if how == OVER else alike[..., None] * own[:, None, None]
                    gain, weights = _earned(level, columns * span)
                    size = float(weights[0] * span if how == OVER else np.std(weights) * span)
                    acts_on = model.states[row].name
                    found.append(Drift(q.name, how, size, q.unit, acts_on, float(level.reached + gain - base)))
    return found


def _earned(level: Level, columns: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the most evidence that weights of columns (W, T, ny, n) earn, of all sizes, and where they come to lie."""
    flat, known = columns.reshape(level.error.size, -1), level.known.reshape(level.error.size, -1)
    flat = flat - known @ (known.T @ flat)
    matrix, pull = flat.T @ flat, flat.T @ level.error.ravel()
    gains = evidence(matrix, pull, np.array(SIZES))
    best = int(np.argmax(gains))
    if not np.isfinite(gains[best]):
        return -np.inf, np.zeros(len(pull))
    # columns say what a force does to the innovations of a model that has it: this one lacks it
    return float(gains[best]), -np.linalg.solve(matrix + np.eye(len(pull)) / SIZES[best] ** 2, pull)


def _progress(windows: Windows) -> np.ndarray:
    """Return how far every row is in its episode, from -1/2 to 1/2, (W, T)."""
    rows = np.arange(windows.ok.shape[1])
    there = np.any(windows.ok > 0, axis=2)
    last = windows.begin + np.max(np.where(there, rows, 0), axis=1)
    ends = {e: max(last[windows.episode == e].max(), 1) for e in np.unique(windows.episode)}
    length = np.array([ends[e] for e in windows.episode])
    return (windows.begin[:, None] + rows) / length[:, None] - 0.5


def _indicators(episode: np.ndarray) -> np.ndarray:
    """Return whether each window is of each episode, (W, E)."""
    return np.equal(episode[:, None], np.unique(episode)[None]).astype(float)


def _slopes(augmented: Augmented, names: Sequence[int]) -> casadi.Function:
    """Return (x, u, p) -> what each parameter does to the rates, (nx, names) in one column."""
    function = augmented.function
    x, u, p = (augmented.model.symbol.sym(n, function.size1_in(i)) for i, n in enumerate("xup"))
    slope = casadi.jacobian(function(x, u, p)[0], p)[:, list(names)]
    return casadi.Function("slopes", [x, u, p], [casadi.vec(casadi.densify(slope))])


def _moves(
    level: Level, augmented: Augmented, slopes: casadi.Function, p: np.ndarray, progress: np.ndarray, dt: float
) -> np.ndarray:
    """Return what each parameter does to the innovations, as a constant and as a drift, in sd, (names, W, T, ny, 2)."""
    mean, following = np.asarray(level.track.mean), np.roll(level.track.predicted, -1, axis=1)
    count, rows, nx = mean.shape

    def at(states: np.ndarray) -> np.ndarray:
        flat = (states.reshape(-1, nx).T, level.inputs.reshape(count * rows, -1).T)
        value = np.nan_to_num(np.asarray(slopes(*flat, np.tile(p[:, None], count * rows))), posinf=0.0, neginf=0.0)
        return value.reshape(-1, nx, count, rows)  # (names, nx, W, T)

    here, there = at(mean), at(following)
    later = progress + (progress[:, 1:2] - progress[:, :1])
    forces = {}
    for i in range(nx):
        if here[:, i].any() or there[:, i].any():
            force, after = (
                np.concatenate([np.moveaxis(f[:, i], 0, -1), np.moveaxis(f[:, i] * w, 0, -1)], axis=-1)
                for f, w in ((here, progress), (there, later))
            )  # (W, T, 2 names)
            forces[i] = force, after
    if not forces:
        return np.zeros((len(here), count, rows, level.error.shape[2], 2))
    moved = shifts(level.track, level.per_std > 0, forces, dt)
    return np.moveaxis(moved.reshape(*moved.shape[:3], 2, -1), (3, 4), (4, 0)) * level.per_std[None, ..., None]
