"""What others make of the same files: PySINDy's sequentially thresholded least squares, and a forward search by BIC.

Both regress differences between rows on the rig's own columns and the catalogue's shapes, `library`, averaged over the two
rows; the parameters of the rig are free, and its own columns are always kept. What they keep beyond these is the answer; that
something is left which they cannot name, neither can say. A polynomial is fitted only for the rate of what nobody measured:
on the measurements themselves it would shift the jumps of a command. PySINDy is given, per rig and noise, the threshold (and
what it is relative to) that makes it right most often on sets which are not of the exam, and of an effect's columns those
that fit best.

Reference: Brunton, Proctor, Kutz (2016), PNAS 113; Schwarz (1978); Savitzky and Golay (1964).
"""

import importlib.util
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.signal import savgol_filter

from tests.exam import score
from tests.exam.library import Column, candidates, known, merged
from tests.exam.plants import SYSTEMS

WINDOW, ORDER = 5, 3  # rows and degree of the polynomial whose derivative stands in for a speed that is not measured
MOST = 6  # terms of the forward search
SINDY, BIC = "pysindy", "bic"
WHOLE, LEFT = "whole", "left"  # columns of norm 1 before, or after the rig's own columns are taken out of them
LEVELS = (0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8)  # of coefficients; the target has norm 1
OPTIONS = [(threshold, size) for size in (WHOLE, LEFT) for threshold in LEVELS]
SPANNED = 1e-6  # of a column's norm: what is left of it when the rig's own columns say all that it says

Problem = dict[str, tuple[np.ndarray, np.ndarray, list[Column]]]  # rate -> target, known columns, candidates


def installed() -> bool:
    """Whether PySINDy can be imported: `make exam` installs it, `uv sync --group exam` too."""
    return importlib.util.find_spec("pysindy") is not None


def alike(system: str, noise: float) -> str:
    """Name of the sets that share a threshold."""
    return f"{system} {noise}"


def rivals(folder: Path, truth: Mapping[str, Any], tuned: Mapping[str, Sequence[Any]]) -> dict[str, Any]:
    """Return outcome, names and seconds of every rival on the files of a set; PySINDy only with its options `tuned`."""
    made = problem(folder, truth["system"], truth["measured"])
    found: dict[str, Any] = {}
    ways: dict[str, Callable[[Problem], list[tuple[str, str]]]] = {BIC: forward}
    if installed() and alike(truth["system"], truth["noise"]) in tuned:
        threshold, size = tuned[alike(truth["system"], truth["noise"])]
        ways[SINDY] = lambda p: sparse(p, threshold, size)
    for name, way in ways.items():
        began = time.perf_counter()
        chosen = way(made) if made else []
        found |= {f"{name}_seconds": time.perf_counter() - began}
        found |= {name: graded(truth, chosen), f"{name}_names": "+".join(f"{e}@{p}" for e, p in chosen)}
    return found


def graded(truth: Mapping[str, Any], chosen: list[tuple[str, str]]) -> str:
    """Grade an answer as the tool's are; a twin counts as right, since a rival has no means to say so."""
    effects = [{"name": e, "acts_on": p, "class": [e], "same_as": [], "same_as_two": []} for e, p in chosen]
    found = {"verdict": "effect" if effects else "none", "effects": effects, "remainder": None}
    result = score.outcome(truth, found)
    return score.RIGHT if result == score.TWIN else result


def problem(folder: Path, system: str, measured: list[str]) -> Problem:
    """Read the training episodes and set up the regression; empty where a state can be had neither way."""
    rig = SYSTEMS[system]
    frame = pd.read_parquet(folder / "data" / "run.parquet")
    frame = frame[frame.split == "train"]
    rows = int(frame.groupby("episode").size().min())
    x = {n: frame[n].to_numpy().reshape(-1, rows) for n in (*measured, *rig.inputs)}

    def slope(name: str) -> np.ndarray:
        return savgol_filter(x[name], WINDOW, ORDER, deriv=1, delta=rig.dt, axis=1)

    x |= {velocity: slope(position) for velocity, position in rig.velocity.items() if velocity not in x}
    if system == "car" and "v" not in x:
        x["v"] = slope("x") * np.cos(x["theta"]) + slope("y") * np.sin(x["theta"])
    if set(rig.states) - set(x):
        return {}
    left = {n: c[:, :-1] for n, c in x.items()}  # commands are held: those of a row act until the next one
    right = {n: c[:, :-1] if n in rig.inputs else c[:, 1:] for n, c in x.items()}
    sides = [(known(system, x), candidates(system, x)) for x in (left, right)]
    found: Problem = {}
    for place, own in sides[0][0].items():
        pairs = zip(sides[0][1][place], sides[1][1][place], strict=True)
        more = [a._replace(values=((a.values + b.values) / 2).ravel()) for a, b in pairs]
        target = (np.diff(x[place], axis=1) / rig.dt).ravel()
        columns = ((own + sides[1][0][place]) / 2).reshape(len(target), -1)
        found[place] = (target, columns, [c for c in more if np.any(c.values)])
    return found


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


def sparse(made: Problem, threshold: float, size: str = WHOLE) -> list[tuple[str, str]]:
    """Sequentially thresholded least squares of PySINDy on normalised columns, the rig's own ones exempt.

    Args:
        made: of `problem`.
        threshold: least coefficient, of the target's norm.
        size: whose norm is 1: WHOLE columns, or what is LEFT of them beside the rig's own.
    """
    import pysindy

    chosen = []
    for place, (target, columns, more) in made.items():
        whole = np.stack([c.values for c in more], -1)
        left, aim = (a - columns @ np.linalg.lstsq(columns, a, rcond=None)[0] for a in (whole, target))
        kept = _one_shape_each(more, whole, left, aim)
        scale = np.linalg.norm((whole if size == WHOLE else left)[:, kept], axis=0)
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6, max_iter=50)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparsity parameter is too big")  # an answer as well: nothing is missing
            optimizer.fit(left[:, kept] / scale, (aim / np.linalg.norm(target))[:, None])
        chosen += [(place, kept[i]) for i in np.flatnonzero(optimizer.coef_[0])]
    return named(made, chosen)


def _one_shape_each(more: list[Column], whole: np.ndarray, left: np.ndarray, aim: np.ndarray) -> list[int]:
    """Return, per effect and place, the columns of the one grid point that alone fits best."""
    groups: dict[tuple[str, str], dict[float, list[int]]] = {}
    for i, column in enumerate(more):
        if np.linalg.norm(left[:, i]) > SPANNED * np.linalg.norm(whole[:, i]):
            groups.setdefault((column.effect, column.acts_on), {}).setdefault(column.at, []).append(i)

    def misfit(chosen: list[int]) -> float:
        rest = aim - left[:, chosen] @ np.linalg.lstsq(left[:, chosen], aim, rcond=None)[0]
        return float(rest @ rest)

    return sorted(i for grid in groups.values() for i in min(grid.values(), key=misfit))


def named(made: Problem, chosen: list[tuple[str, int]]) -> list[tuple[str, str]]:
    """Return the effects and places that columns stand for."""
    by_place: dict[str, set[str]] = {}
    for place, i in chosen:
        column = made[place][2][i]
        by_place.setdefault(column.acts_on, set()).add(column.effect)
    return sorted((effect, place) for place, effects in by_place.items() for effect in merged(effects))
