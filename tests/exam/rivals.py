"""What others make of the same files: PySINDy's sequentially thresholded least squares, and a forward search by BIC.

Both regress differences over a few rows on the rig's own columns and the catalogue's shapes, `library`, averaged over the same
rows of the smoothed measurements; the parameters of the rig are free. What they keep beyond the rig's own columns is
the answer. Neither can abstain.

Reference: Brunton, Proctor, Kutz (2016), PNAS 113; Schwarz (1978); Savitzky and Golay (1964).
"""

import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.signal import savgol_filter

from tests.exam import score
from tests.exam.library import Column, candidates, known, merged
from tests.exam.plants import SYSTEMS

WINDOW, ORDER = 5, 3  # rows and degree of the smoothing polynomial
SPAN = (
    3  # rows of a finite difference; regressors are averaged over the same rows, so that jumps of a command are exact
)
MOST = 6  # terms of the forward search
THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.4)  # of the target's norm, with columns of norm 1
SINDY, BIC = "pysindy", "bic"

Problem = dict[str, tuple[np.ndarray, np.ndarray, list[Column]]]  # rate -> target, known columns, candidates


def installed() -> bool:
    """Whether PySINDy can be imported: `pip install pysindy`."""
    return importlib.util.find_spec("pysindy") is not None


def rivals(folder: Path, truth: Mapping[str, Any], thresholds: Mapping[str, float]) -> dict[str, Any]:
    """Return outcome and names of every rival on the files of a set."""
    made = problem(folder, truth["system"], truth["measured"])
    found: dict[str, Any] = {}
    ways: dict[str, Callable[[Problem], list[tuple[str, str]]]] = {BIC: forward}
    if installed():
        ways[SINDY] = lambda p: sparse(p, thresholds.get(SINDY, 0.1))
    for name, way in ways.items():
        chosen = way(made) if made else []
        found |= {name: graded(truth, chosen), f"{name}_names": "+".join(f"{e}@{p}" for e, p in chosen)}
    return found


def graded(truth: Mapping[str, Any], chosen: list[tuple[str, str]]) -> str:
    """Grade an answer as the tool's are; a twin counts as right, since a rival has no means to say so."""
    effects = [{"name": e, "acts_on": p, "class": [e], "same_as": []} for e, p in chosen]
    found = {"verdict": "effect" if effects else "none", "effects": effects, "remainder": None}
    result = score.outcome(truth, found)
    return score.RIGHT if result == score.TWIN else result


def problem(folder: Path, system: str, measured: list[str]) -> Problem:
    """Read the training episodes and set up the regression; empty where a state can be had neither way."""
    told = SYSTEMS[system]
    frame = pd.read_parquet(folder / "data" / "run.parquet")
    frame = frame[frame.split == "train"]
    rows = int(frame.groupby("episode").size().min())
    raw = {n: frame[n].to_numpy().reshape(-1, rows) for n in (*measured, *told.inputs)}

    def smooth(name: str, derivative: int = 0) -> np.ndarray:
        return savgol_filter(raw[name], WINDOW, ORDER, deriv=derivative, delta=told.dt, axis=1)

    x = {n: smooth(n) for n in measured} | {n: raw[n] for n in told.inputs}
    x |= {velocity: smooth(position, 1) for velocity, position in told.velocity.items() if velocity not in x}
    if system == "car" and "v" not in x:
        x["v"] = smooth("x", 1) * np.cos(x["theta"]) + smooth("y", 1) * np.sin(x["theta"])
    if set(told.states) - set(x):
        return {}
    left = {n: c[:, :-1] for n, c in x.items()}  # commands are held: those of a row act until the next one
    right = {n: c[:, :-1] if n in told.inputs else c[:, 1:] for n, c in x.items()}
    sides = [(known(system, x), candidates(system, x)) for x in (left, right)]
    found: Problem = {}
    for place in sides[0][0]:
        columns = _mean((sides[0][0][place] + sides[1][0][place]) / 2)
        pairs = zip(sides[0][1][place], sides[1][1][place], strict=True)
        more = [a._replace(values=_mean(((a.values + b.values) / 2)[..., None])[:, 0]) for a, b in pairs]
        ends = raw.get(place, x[place])  # smoothed, they would shift the jumps of a command
        change = ends[:, SPAN::SPAN] - ends[:, :-SPAN:SPAN]
        target = change[:, : (rows - 1) // SPAN].ravel() / (SPAN * told.dt)
        found[place] = (target, columns, [c for c in more if np.any(c.values)])
    return found


def _mean(columns: np.ndarray) -> np.ndarray:
    """Average columns (episodes, rows, n) over the rows between two ends of a difference, (N, n)."""
    count = columns.shape[1] // SPAN
    return (
        columns[:, : count * SPAN].reshape(len(columns), count, SPAN, -1).mean(axis=2).reshape(len(columns) * count, -1)
    )


def forward(made: Problem) -> list[tuple[str, str]]:
    """Add the column that lowers the Bayesian information criterion most, while one does."""
    chosen: list[tuple[str, int]] = []

    def criterion(place: str, extra: list[int]) -> float:
        target, columns, more = made[place]
        design = np.column_stack([columns, *(more[i].values for i in extra)])
        left = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
        return len(target) * np.log(left @ left / len(target)) + design.shape[1] * np.log(len(target))

    while len(chosen) < MOST:
        gains = {}
        for place, (_, _, more) in made.items():
            taken = [i for p, i in chosen if p == place]
            now = criterion(place, taken)
            gains |= {(place, i): now - criterion(place, [*taken, i]) for i in range(len(more)) if i not in taken}
        best = max(gains, key=lambda key: gains[key])
        if gains[best] <= 0:
            break
        chosen.append(best)
    return named(made, chosen)


def sparse(made: Problem, threshold: float) -> list[tuple[str, str]]:
    """Sequentially thresholded least squares of PySINDy on normalised columns."""
    import pysindy

    chosen = []
    for place, (target, columns, more) in made.items():
        design = np.column_stack([columns, *(c.values for c in more)])
        design = design / np.linalg.norm(design, axis=0)
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6, max_iter=50)
        optimizer.fit(design, (target / np.linalg.norm(target))[:, None])
        kept = np.flatnonzero(np.abs(optimizer.coef_[0]) > 0) - columns.shape[1]
        chosen += [(place, int(i)) for i in kept if i >= 0]
    return named(made, chosen)


def named(made: Problem, chosen: list[tuple[str, int]]) -> list[tuple[str, str]]:
    """Return the effects and places that columns stand for."""
    by_place: dict[str, set[str]] = {}
    for place, i in chosen:
        column = made[place][2][i]
        by_place.setdefault(column.acts_on, set()).add(column.effect)
    return sorted((effect, place) for place, effects in by_place.items() for effect in merged(effects))
