"""Figures of the latent force, the model error of the simulator, and of the effects that explain it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli.reporting.figures.canvas import (
    BLACK,
    COLOURS,
    distinct,
    legend_below,
    new_figure,
    with_unit,
)
from simpel_cli.reporting.figures.discover_runs import models_of
from simpel_cli.runs.files import read_columns, read_units

BINS = 14
LEAST = 6  # rows of a bin
MOST_POINTS = 600  # of a panel
MOST_PANELS = 8
TICKS = 4  # intervals of an axis of a small panel, whose numbers may be long
TABLE = ("model", "split", "episode", "row", "time", "acts_on", "unit", "force", "std", "effect")
STYLE = {"before": (COLOURS[1], "calibrated simulator"), "after": (COLOURS[0], "corrected simulator")}


class Bins(NamedTuple):
    """Means of a quantity over bins of another, with the standard error of each."""

    at: np.ndarray
    mean: np.ndarray
    error: np.ndarray


def binned(argument: np.ndarray, value: np.ndarray, bins: int = BINS) -> Bins:
    """Average over bins that hold equally many points."""
    good = np.isfinite(argument) & np.isfinite(value)
    argument, value = argument[good], value[good]
    order = np.argsort(argument, kind="stable")
    parts = [p for p in np.array_split(order, max(min(bins, len(order) // LEAST), 1)) if len(p) > 1]
    return Bins(
        np.array([argument[p].mean() for p in parts]),
        np.array([value[p].mean() for p in parts]),
        np.array([value[p].std(ddof=1) / np.sqrt(len(p)) for p in parts]),
    )


def strength(b: Bins) -> float:
    """How far the means lie from zero, in standard errors."""
    return float(np.sqrt(np.mean((b.mean / np.maximum(b.error, 1e-300)) ** 2))) if len(b.at) else 0.0


def draw_residual(found: dict[str, Any], path: Path) -> Any:
    """Draw the latent force against each state and input, of the simulator before and after."""
    table, units = read_columns(path), read_units(path)
    panels = _panels(table)
    figure, axes = new_figure(len(panels), 3.4, 2.9, columns=3)
    for axis, (acts_on, argument) in zip(axes, panels, strict=True):
        for model in models_of(found):
            own = (table["acts_on"] == acts_on) & (table["model"] == model)
            colour, label = STYLE[model]
            x, force = table[argument][own], table["force"][own]
            if model == "before":
                _points(axis, x, force, colour)
                _limit(axis, force)
            _band(axis, binned(x, force), colour, label)
        _frame(axis, argument, acts_on, units, table)
    legend_below(figure, axes[0])
    return figure


def _panels(table: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Pairs of a driven state and an argument; of too many, those on which the force before depends most."""
    before = table["model"] == "before"
    ranked = [
        (strength(binned(table[argument][own], table["force"][own])), acts_on, argument)
        for acts_on in distinct(table["acts_on"])
        for own in [before & (table["acts_on"] == acts_on)]
        for argument in table
        if argument not in TABLE
    ]
    kept = sorted(ranked, reverse=True)[:MOST_PANELS]
    return [rank[1:] for rank in ranked if rank in kept]


def draw_effects(found: dict[str, Any], residuals: Path, curves: Path) -> Any:
    """Draw what the effects have to explain, along their arguments, with the fitted curves; then all of it at once.

    Points are the latent force with the corrected parameters and the effects switched off, less what the effects on other
    arguments do: a partial residual (Larsen and McCleary 1972).
    """
    table, units, curve = read_columns(residuals), read_units(residuals), read_columns(curves)
    table = {name: column[table["model"] == "without"] for name, column in table.items()}
    if not len(table["force"]) or not found["effects"]:
        return None
    names = [name for name in table if name not in TABLE]
    panels = [p for p in distinct(zip(curve["acts_on"], curve["argument"], strict=True)) if p[1] in names]
    moved = [a for a in distinct(table["acts_on"]) if np.any(_of(table, a)["effect"] != 0)]
    if not panels and not moved:
        return None
    figure, axes = new_figure(len(panels) + len(moved), 3.7, 3.1, columns=3)
    for axis, (acts_on, argument) in zip(axes, panels, strict=False):
        own = _of(table, acts_on)
        here = (curve["acts_on"] == acts_on) & (curve["argument"] == argument)
        lines = {key: here & (curve["effect"] == key) for key in distinct(curve["effect"][here])}
        value = next(curve["value"][rows] for rows in lines.values())
        total = np.sum([curve["force"][rows] for rows in lines.values()], axis=0)
        partial = own["force"] - own["effect"] + np.interp(own[argument], value, total)
        _points(axis, own[argument], partial, COLOURS[1])
        _limit(axis, partial)
        _band(axis, binned(own[argument], partial), COLOURS[1], "latent force: mean and 95 % band")
        if len(lines) > 1:
            for dash, (name, rows) in zip(("--", ":", "-."), lines.items(), strict=False):
                axis.plot(value, curve["force"][rows], dash, color="0.35", linewidth=1.1, label=name.replace("_", " "))
        axis.plot(
            value, total, color=BLACK, linewidth=1.6, label="fitted effect" + ("s together" if len(lines) > 1 else "")
        )
        _frame(axis, argument, acts_on, units, table)
        axis.legend(fontsize=7, frameon=False)
    for axis, acts_on in zip(axes[len(panels) :], moved, strict=True):
        own = _of(table, acts_on)
        _points(axis, own["effect"], own["force"], COLOURS[1], most=5 * MOST_POINTS, alpha=0.35)
        _limit(axis, np.concatenate([own["force"], own["effect"]]), share=0.998)
        _band(axis, binned(own["effect"], own["force"], 2 * BINS), COLOURS[1], "latent force: mean and 95 % band")
        ends = np.nanquantile(own["effect"], [0, 1])
        axis.plot(ends, ends, color=BLACK, linewidth=1.6, label="equal")
        unit = own["unit"][0]
        axis.set(xlabel=with_unit("sum of all effects", unit), ylabel=with_unit(f"latent force on {acts_on}", unit))
        axis.set_title("all effects together", fontsize=9)
        axis.legend(fontsize=7, frameon=False)
    return figure


def _of(table: dict[str, np.ndarray], acts_on: str) -> dict[str, np.ndarray]:
    own = table["acts_on"] == acts_on
    return {name: column[own] for name, column in table.items()}


def _points(axis: Any, x: np.ndarray, y: np.ndarray, colour: str, most: int = MOST_POINTS, alpha: float = 0.22) -> None:
    shown = np.random.default_rng(0).permutation(len(x))[:most]
    axis.plot(x[shown], y[shown], ".", color=colour, alpha=alpha, markersize=3, markeredgewidth=0)


def _limit(axis: Any, force: np.ndarray, share: float = 0.96) -> None:
    """Fit the axis to nearly all points: a first row, whose state is hardly known, can be far off."""
    low, high = np.nanquantile(force, [(1 - share) / 2, (1 + share) / 2])
    low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.08 * (high - low) + 1e-12
    axis.set_ylim(low - margin, high + margin)


def _band(axis: Any, b: Bins, colour: str, label: str) -> None:
    axis.fill_between(b.at, b.mean - 1.96 * b.error, b.mean + 1.96 * b.error, color=colour, alpha=0.25, linewidth=0)
    axis.plot(b.at, b.mean, "o-", color=colour, linewidth=1.2, markersize=2.5, label=label)


def _frame(axis: Any, argument: str, acts_on: str, units: dict[str, str], table: dict[str, np.ndarray]) -> None:
    unit = table["unit"][table["acts_on"] == acts_on][0]
    axis.axhline(0, color="0.5", linewidth=0.8)
    axis.locator_params(axis="x", nbins=TICKS)
    axis.set(xlabel=with_unit(argument, units.get(argument, "")), ylabel=with_unit(f"force on {acts_on}", unit))
