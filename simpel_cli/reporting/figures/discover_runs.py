"""Figures of the simulator before and after: simulated episodes, whiteness of one-step errors, errors by horizon."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.filtering.likelihood.whiteness import autocorrelation, cumulated_periodogram
from simpel_cli.reporting.figures.canvas import (
    BLACK,
    COLOURS,
    distinct,
    legend_below,
    new_figure,
    ratio_scale,
    with_unit,
)
from simpel_cli.runs.files import read_columns

STYLE = {"before": (COLOURS[1], "calibrated simulator", "--"), "after": (COLOURS[0], "corrected simulator", "-")}
MOST_SWINGS = 60  # that a reader can tell apart
HORIZONS = {"one_step": "one step", "horizon": "{steps} rows ahead", "free_run": "whole episode"}


def models_of(found: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the models worth showing: where nothing was corrected, both are the same."""
    return ("before", "after") if found["corrected_sim"] else ("before",)


def draw_traces(found: dict[str, Any], path: Path) -> Any:
    """Draw measured values and free runs of the test episode whose error after is the median of all; of a long one the end."""
    table = read_columns(path)
    if not len(table["episode"]):
        return None
    episode = typical_episode(table)
    outputs = distinct(table["output"])
    figure, axes = new_figure(len(outputs), 9.4, 2.1, columns=1)
    shown = [table["measured"][(table["episode"] == episode) & (table["output"] == output)] for output in outputs]
    begin = max(last_swings(values) for values in shown)
    for axis, output in zip(axes, outputs, strict=True):
        own = {n: c[(table["episode"] == episode) & (table["output"] == output)][begin:] for n, c in table.items()}
        axis.plot(own["time"], own["measured"], ".", color=BLACK, markersize=3, label="measured")
        free = np.where(own["free"], 1.0, np.nan)
        for model in models_of(found):
            colour, label, dash = STYLE[model]
            axis.plot(own["time"], own[model] * free, dash, color=colour, linewidth=1.3, label=label)
        _around(axis, own, models_of(found))
        axis.set(ylabel=with_unit(output, own["unit"][0]))
    part = f", its last {len(shown[0]) - begin} of {len(shown[0])} rows" if begin else ""
    axes[0].set_title(f"test episode {episode}{part}", fontsize=9, loc="left")
    axes[-1].set_xlabel("time [s]")
    legend_below(figure, axes[0])
    return figure


def last_swings(values: np.ndarray) -> int:
    """Return the row from which a course has no more than `MOST_SWINGS` swings through its middle left."""
    low, high = np.nanquantile(values, [0.05, 0.95]) if np.isfinite(values).any() else (0.0, 0.0)
    off = values - (low + high) / 2
    there = np.flatnonzero(np.abs(off) > 0.2 * (high - low))  # noise about the middle is no swing
    turns = there[1:][np.diff(np.sign(off[there])) != 0]
    return int(turns[-MOST_SWINGS]) if len(turns) > MOST_SWINGS else 0


def typical_episode(table: dict[str, np.ndarray]) -> Any:
    """Return the episode in the middle, by squared free-run error after, relative to that of all, summed over outputs."""
    totals = dict.fromkeys(distinct(table["episode"]), 0.0)
    squared = np.where(table["free"], (table["measured"] - table["after"]) ** 2, np.nan)
    for output in distinct(table["output"]):
        own = table["output"] == output
        scale = max(float(np.nansum(squared[own])), np.finfo(float).tiny)
        for episode in totals:
            totals[episode] += float(np.nansum(squared[own & (table["episode"] == episode)])) / scale
    return sorted(totals, key=lambda name: totals[name])[(len(totals) - 1) // 2]


def _around(axis: Any, own: dict[str, np.ndarray], models: tuple[str, ...]) -> None:
    """Keep the measured course readable when a free run leaves it for good."""
    low, high = np.nanmin(own["measured"]), np.nanmax(own["measured"])
    margin = high - low + 1e-12
    runs = np.concatenate([own[m][own["free"].astype(bool)] for m in models])
    runs = runs[np.isfinite(runs)]
    ends = (max(low - margin, runs.min(initial=low)), min(high + margin, runs.max(initial=high)))
    axis.set_ylim(ends[0] - 0.05 * margin, ends[1] + 0.05 * margin)


def draw_whiteness(found: dict[str, Any], path: Path) -> Any:
    """Draw autocorrelation and cumulated periodogram of the standardised one-step errors on test episodes."""
    table = read_columns(path)
    outputs, models = distinct(table["output"]), models_of(found)
    figure, axes = new_figure(2 * len(outputs), 4.6, 2.5, columns=2)
    for k, output in enumerate(outputs):
        left, right = axes[2 * k : 2 * k + 2]
        for i, model in enumerate(models):
            colour, label, _ = STYLE[model]
            own = (table["output"] == output) & (table["model"] == model) & (table["split"] == "test")
            e = table["innovation"][own] / table["std"][own]
            parts = [_trimmed(e[table["episode"][own] == name]) for name in distinct(table["episode"][own])]
            acf, cumulated = autocorrelation(parts), cumulated_periodogram(parts)
            if acf is None or cumulated is None:
                continue
            shift = (i - (len(models) - 1) / 2) * 0.3
            left.vlines(acf.lag + shift, 0, acf.value, color=colour, linewidth=2.2, label=label)
            right.plot([0, *cumulated.frequency], [0, *cumulated.value], color=colour, linewidth=1.4, label=label)
            if i == 0:
                left.axhspan(-acf.band, acf.band, color="0.9", zorder=0, label="95 % band of white errors")
                f = np.array([0, 0.5])
                right.fill_between(f, 2 * f - cumulated.band, 2 * f + cumulated.band, color="0.9", zorder=0)
        left.axhline(0, color="0.5", linewidth=0.8)
        left.set(xlabel="lag [rows]", ylabel="autocorrelation")
        left.xaxis.get_major_locator().set_params(integer=True)
        left.set_title(output, fontsize=9, loc="left")
        right.plot([0, 0.5], [0, 1], color="0.5", linewidth=0.8)
        right.set(xlabel="frequency [cycles per row]", ylabel="share of power below", xlim=(0, 0.5), ylim=(0, 1))
        right.set_title(output, fontsize=9, loc="left")
    legend_below(figure, axes[0])
    return figure


def _trimmed(e: np.ndarray) -> np.ndarray:
    """Cut off rows at the ends that have no error."""
    good = np.flatnonzero(np.isfinite(e))
    return e[good[0] : good[-1] + 1] if len(good) else e[:0]


def draw_errors(found: dict[str, Any], path: Path) -> Any:
    """Draw RMSE before and after by horizon with 95 % intervals, and the noise below which no error can fall."""
    table = read_columns(path)
    outputs, models = distinct(table["output"]), models_of(found)
    figure, axes = new_figure(len(outputs), 3.6, 2.8, columns=3)
    steps = found["error"]["horizon_steps"]
    for axis, output in zip(axes, outputs, strict=True):
        own = {n: c[table["output"] == output] for n, c in table.items()}
        place = np.arange(len(own["horizon"]))
        for i, model in enumerate(models):
            colour, label, _ = STYLE[model]
            at = place + (i - (len(models) - 1) / 2) * 0.22
            value, low, high = (own[c] for c in (model, f"{model}_low", f"{model}_high"))
            axis.plot(at, value, "o", color=colour, markersize=5, label=label)
            told = np.isfinite(low) & np.isfinite(high)
            bars = np.stack([value - low, high - value])[:, told].clip(min=0)
            axis.errorbar(at[told], value[told], yerr=bars, fmt="none", ecolor=colour, elinewidth=1.6, capsize=3)
        axis.axhline(own["noise_floor"][0], color="0.4", linewidth=1, linestyle=":", label="measurement noise")
        values = np.concatenate([own[m][np.isfinite(own[m])] for m in models] + [own["noise_floor"]])
        if values.min() > 0 and values.max() > 3 * values.min():
            ratio_scale(axis)
        else:
            axis.set_ylim(0, None)
        axis.set_xticks(place, [HORIZONS[h].format(steps=steps) for h in own["horizon"]], fontsize=8)
        axis.set(xlim=(-0.5, len(place) - 0.5), ylabel=with_unit("RMSE", own["unit"][0]))
        axis.set_title(output, fontsize=9, loc="left")
    legend_below(figure, axes[0])
    return figure
