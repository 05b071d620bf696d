"""Tables of a search, from which the figures and tables of its report are made."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from simpel_cli.data.recording import Episode
from simpel_cli.discovery.search.sets.selection import Selection, steps
from simpel_cli.discovery.search.trials import Search, asked
from simpel_cli.discovery.verdict.verdict import before_of, interval_of
from simpel_cli.filtering.errors_ahead import Assessment
from simpel_cli.filtering.independent_parts import NO_PART, independent_parts
from simpel_cli.filtering.likelihood.latent_force import Force
from simpel_cli.filtering.measurements.windows import Windows, pieces
from simulators.groups import MEMBER, SPREAD

DRAWS = 2000  # of a bootstrap
HORIZONS = ("one_step", "horizon", "free_run")
Columns = dict[str, np.ndarray]


def joined(parts: Sequence[Columns]) -> Columns:
    """Stack tables with the same columns."""
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]} if parts else {}


def residual_columns(
    model: str,
    split: str,
    found: Force,
    effect: np.ndarray,
    windows: Windows,
    episodes: Sequence[Episode],
    driven: Mapping[int, tuple[str, str]],
    arguments: tuple[Sequence[str], Sequence[str]],
) -> Columns:
    """Return the latent force of one model, a row per row of an episode and driven state.

    Args:
        model: before, without (the corrected parameters, effects switched off) or after.
        split: train or test.
        found: force and smoothed states, angles between -pi and pi.
        effect: (W, T - 1, nx) contribution of the effects that were found to the rates in these states.
        windows: of the split.
        episodes: of the split.
        driven: row of the state -> (its name, unit of its force).
        arguments: names of the columns of states and of inputs, see `column_names`.
    """
    parts = []
    lead = windows.u.shape[1] - windows.y.shape[1]
    for w, piece in enumerate(pieces(windows, episodes)):
        n = len(piece.rows) - 1
        for i, (name, unit) in driven.items():
            table: Columns = {
                "model": np.full(n, model), "split": np.full(n, split), "episode": np.full(n, piece.episode),
                "row": piece.rows[:n], "time": piece.time[:n], "acts_on": np.full(n, name), "unit": np.full(n, unit),
                "force": found.force[w, :n, i], "std": found.std[w, :n, i], "effect": effect[w, :n, i],
            }  # fmt: skip
            table |= {column: found.state[w, :n, j] for j, column in enumerate(arguments[0])}
            table |= {column: windows.u[w, lead : lead + n, j] for j, column in enumerate(arguments[1])}
            parts.append(table)
    return joined(parts)


RESERVED = ("model", "split", "episode", "row", "time", "acts_on", "unit", "force", "std", "effect")


def column_names(names: Sequence[str]) -> list[str]:
    """Return names of quantities as columns of the residual's table; one that is taken there gets an underscore."""
    return [f"{n}_" if n in RESERVED else n for n in names]


def innovation_columns(
    model: str, split: str, found: Assessment, windows: Windows, episodes: Sequence[Episode], measured: Sequence[str]
) -> Columns:
    """Return one-step errors and the standard deviation that the model predicts for them."""
    parts = []
    for w, piece in enumerate(pieces(windows, episodes)):
        n = len(piece.rows)
        for j, name in enumerate(measured):
            parts.append(
                {
                    "model": np.full(n, model), "split": np.full(n, split), "episode": np.full(n, piece.episode),
                    "row": piece.rows, "time": piece.time, "output": np.full(n, name),
                    "innovation": found.one_step[w, :n, j], "std": np.sqrt(found.variance[w, :n, j]),
                }
            )  # fmt: skip
    return joined(parts)


def trajectory_columns(
    before: Assessment,
    after: Assessment,
    windows: Windows,
    episodes: Sequence[Episode],
    measured: Mapping[str, str],
) -> Columns:
    """Return measured values and simulated episodes, which use no measurement after their first rows.

    Args:
        before: the calibrated simulator on the windows.
        after: the corrected one.
        windows: of the test split.
        episodes: of the test split.
        measured: name -> unit.
    """
    parts = []
    for w, piece in enumerate(pieces(windows, episodes)):
        n = len(piece.rows)
        for j, (name, unit) in enumerate(measured.items()):
            parts.append(
                {
                    "episode": np.full(n, piece.episode), "row": piece.rows, "time": piece.time,
                    "output": np.full(n, name), "unit": np.full(n, unit),
                    "measured": np.where(windows.ok[w, :n, j] > 0, windows.y[w, :n, j], np.nan),
                    "before": before.free_mean[w, :n, j], "after": after.free_mean[w, :n, j],
                    "free": np.arange(n) >= before.first,
                }
            )  # fmt: skip
    return joined(parts)


def error_columns(
    before: Assessment, after: Assessment, windows: Windows, measured: Mapping[str, str], noise: Mapping[str, float]
) -> Columns:
    """Return RMSE before and after by horizon with 95 % intervals, by resampling the parts of the test (`independent_parts`).

    Args:
        before: the calibrated simulator on the windows.
        after: the corrected one.
        windows: of the test split.
        measured: name -> unit.
        noise: name -> standard deviation of the measurement noise.
    """
    rows: list[dict[str, Any]] = []
    for horizon in HORIZONS:
        one, other = (
            {"one_step": a.one_step, "horizon": a.ahead, "free_run": a.free}[horizon] for a in (before, after)
        )
        first, second, parts = independent_parts(one, other, windows.episode)
        for j, (name, unit) in enumerate(measured.items()):
            row = {"horizon": horizon, "output": name, "unit": unit, "noise_floor": noise[name]}
            whole, drawn = _resampled([e[..., j] for e in (first, second)], parts[:, j])
            row |= _estimate("before", whole[0], drawn[0])
            row |= _estimate("after", whole[1], drawn[1])
            with np.errstate(divide="ignore", invalid="ignore"):
                rows.append(row | _estimate("reduction", whole[0] / whole[1], drawn[0] / drawn[1]))
    return as_columns(rows)


def _resampled(errors: Sequence[np.ndarray], parts: np.ndarray) -> tuple[list[float], list[np.ndarray]]:
    """Return the RMSE of errors (N, T) of each model, and of resampled parts (N,), (DRAWS,) or, without parts, (0,)."""
    there = np.isfinite(errors).any(axis=(0, 2))  # a shorter episode is padded
    whole = [_root(_squares(e)) for e in errors]
    names = np.unique(parts[there])
    if not len(names) or names[0] == NO_PART:
        return [float(r) for r in whole], [np.zeros(0)] * len(errors)
    chosen = np.random.default_rng(3).integers(0, len(names), (DRAWS, len(names)))
    sums = [np.stack([_squares(e[parts == n]) for n in names]) for e in errors]
    return [float(r) for r in whole], [_root(s[chosen].sum(axis=1)) for s in sums]


def _squares(error: np.ndarray) -> np.ndarray:
    """Sum of squares and number of errors, (2,)."""
    return np.array([np.nansum(error**2), np.isfinite(error).sum()])


def _root(sums: np.ndarray) -> Any:
    """Return the root mean square (...,) of (..., 2) sums; NaN where there is nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(sums[..., 0] / sums[..., 1])


def _estimate(name: str, value: float, drawn: np.ndarray) -> dict[str, float]:
    """Value and 95 % interval; none where nothing was measured. Blocks without an error at a horizon do not count."""
    known = drawn[np.isfinite(drawn)]
    low, high = np.quantile(known, [0.025, 0.975]) if known.size else (np.nan, np.nan)
    return {name: float(value), f"{name}_low": float(low), f"{name}_high": float(high)}


def parameter_columns(search: Search, selection: Selection) -> Columns:
    """Return value and 90 % interval of every parameter, before and after, with its declared range.

    Parameters of effects have no `before`, and `effect` says whose they are.
    """
    own = [
        (q.name, "", q.unit, *search.declared.get(q.name, (q.low, q.high)), i)
        for i, q in enumerate(search.plan.augmented.model.params)
        if q.role not in (SPREAD, MEMBER)
    ]
    added = [
        (parameter.label, search.terms[t].label, parameter.unit, parameter.low, parameter.high, row)
        for t in selection.chosen.terms
        for parameter, row in zip(search.terms[t].parameters, search.rows[t], strict=True)
    ]
    rows = [
        {"parameter": name, "effect": effect, "unit": unit, "model": model, "range_low": low, "range_high": high}
        | (before_of if model == "before" else interval_of)(search, trial, row)
        for name, effect, unit, low, high, row in own + added
        for model, trial in (("before", selection.base), ("after", selection.chosen))
        if not (effect and model == "before")
    ]
    return as_columns(rows)


def candidate_columns(search: Search, selection: Selection) -> Columns:
    """Return every candidate of every step: its gain in log evidence, and whether that step added it.

    Of steps that an earlier search took, in other ranges or noise, only what they added is known here.
    """
    rows = []
    stages = steps(search, selection)
    for step, stage in enumerate(stages, start=1):
        following = stages[step].before.terms if step < len(stages) else selection.chosen.terms
        for trial in stage.trials:
            term = search.terms[trial.terms[-1]]
            rows.append(
                {
                    "step": step, "effect": term.effect, "acts_on": term.acts_on, "depends_on": ",".join(term.depends_on),
                    "expression": term.formula,
                    "log_evidence_gain": trial.optimum.log_evidence - stage.before.optimum.log_evidence,
                    "asked": asked(len(stage.before.terms) + 1),
                    "accepted": set(trial.terms) == set(following),
                    "kept": trial.terms[-1] in selection.chosen.terms,
                    "converged": trial.optimum.converged,
                }
            )  # fmt: skip
    return as_columns(rows)


def as_columns(rows: Sequence[Mapping[str, Any]]) -> Columns:
    """Turn rows into columns."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]} if rows else {}
