"""Figures of a run."""

from collections import Counter, defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.reporting.figures.canvas import (
    BLACK,
    COLOURS,
    distinct,
    legend_below,
    legend_beside,
    line_style,
    new_figure,
    save,
    with_unit,
)
from simpel_cli.runs.files import read_columns
from simpel_cli.runs.metrics import read_metrics

MOST_POINTS = 200  # of a panel: more of them is a band of ink


def draw_run(directory: Path) -> list[Path]:
    """Draw every figure whose Parquet file is there; returns their paths."""
    figures = [
        (_prior_predictive, directory / "prior_predictive.parquet", "prior_predictive"),
        (_learning_curves, directory / "metrics.parquet", "learning_curves"),
        (_predictions, directory / "predictions.parquet", "predictions"),
        (_calibration, directory / "calibration.parquet", "calibration"),
        (_horizon, directory / "horizon.parquet", "free_run"),
        (_example, directory / "trajectories.parquet", "free_run_example"),
    ]
    drawn = []
    for draw, source, name in figures:
        if source.is_file():
            figure = draw(source)
            if figure is not None:
                drawn.append(save(figure, directory / f"{name}.png"))
    return drawn


def _prior_predictive(path: Path) -> Any:
    """Training targets among draws of the simulator, in the order of the draws' medians."""
    table = read_columns(path)
    outputs = distinct(table["output"])
    figure, axes = new_figure(len(outputs))
    for axis, output in zip(axes, outputs, strict=True):
        own = table["output"] == output
        order = np.argsort(table["median"][own], kind="stable")
        shown = {name: column[own][order] for name, column in table.items()}
        place = np.arange(len(order))
        axis.fill_between(place, shown["lowest"], shown["highest"], color=COLOURS[0], alpha=0.15, label="all draws")
        axis.fill_between(place, shown["low"], shown["high"], color=COLOURS[0], alpha=0.35, label="90 % of the draws")
        out = shown["outside"]
        axis.plot(place[~out], shown["measured"][~out], ".", color=BLACK, markersize=4, label="measured")
        axis.plot(place[out], shown["measured"][out], "x", color=COLOURS[1], markersize=5, label="measured, outside")
        axis.set(title=output, xlabel="training target", ylabel=with_unit("value", shown["unit"][0]))
    legend_below(figure, axes[0])
    return figure


def _learning_curves(path: Path) -> Any:
    rows = [r for r in read_metrics(path) if r["split"] == "train"]
    if not rows:
        return None
    outputs = distinct(r["output"] for r in rows if r["metric"] == "noise_std")
    kernels = [r["value"] for r in rows if r["metric"] == "mean_kernel"]
    # all but constant: the particles do not feel each other, or the kernel's width follows their distance (`median`)
    has_kernels = bool(kernels) and max(kernels) > 1.2 * min(kernels)
    figure, (loss, *apart, noise) = new_figure(2 + has_kernels, beside=len(outputs))
    for i, seed in enumerate(distinct(r["seed"] for r in rows)):
        own = [r for r in rows if r["seed"] == seed]
        curve = [(r["step"], r["value"]) for r in own if r["metric"] == "loss"]
        loss.plot(*zip(*curve, strict=True), color=COLOURS[0], alpha=0.9 if i == 0 else 0.4, linewidth=1)
        for axis in apart:  # the distance d at which a kernel exp(-d^2/2) has the mean one's value
            widths = [
                (r["step"], max(-2 * np.log(r["value"]), 0.0) ** 0.5)
                for r in own
                if r["metric"] == "mean_kernel" and r["value"] > 0
            ]
            axis.plot(*zip(*widths, strict=True), color=COLOURS[0], alpha=0.9 if i == 0 else 0.4, linewidth=1)
        for j, output in enumerate(outputs):
            line = [(r["step"], r["value"]) for r in own if r["metric"] == "noise_std" and r["output"] == output]
            unit = next(r["unit"] for r in own if r["metric"] == "noise_std" and r["output"] == output)
            label = with_unit(output, unit) if i == 0 else None
            noise.plot(*zip(*line, strict=True), **line_style(j), alpha=0.9 if i == 0 else 0.4, label=label)
    loss.set(
        title=f"training{_of_seeds(rows[0]['seed'], {r['seed'] for r in rows})}",
        xlabel="step",
        ylabel="NLL per point [nat]",
    )
    # the steep fall of the first steps would hide the rest: scale the axis to what follows
    late = [r["value"] for r in rows if r["metric"] == "loss" and r["step"] >= 0.05 * rows[-1]["step"]]
    margin = 0.05 * (max(late) - min(late)) + 1e-9
    loss.set_ylim(min(late) - margin, max(late) + margin)
    for axis in apart:
        axis.set(title="distance between particles", xlabel="step", ylabel="kernel widths")
        axis.set_ylim(bottom=0)
    noise.set(title="learned noise", xlabel="step", ylabel="standard deviation", yscale="log")
    legend_beside(noise)
    return figure


def _of_seeds(first: int, seeds: Collection[int]) -> str:
    """Say which seed the strong lines are of, where there are several."""
    return f", seed {first} (other seeds: pale)" if len(seeds) > 1 else ""


def _predictions(path: Path) -> Any:
    """Measured and predicted targets of the first seed: along the longest test segment, or against each other."""
    table = read_columns(path)
    first = table["seed"] == table["seed"][0]
    pieces = Counter(zip(table["episode"][first], table["segment"][first], strict=True))
    (episode, segment), _ = pieces.most_common(1)[0]
    along = first & (table["episode"] == episode) & (table["segment"] == segment)
    in_time = _follow(table["time"][along & (table["output"] == table["output"][0])], table["kind"])
    outputs = distinct(table["output"])
    figure, axes = new_figure(len(outputs))
    for axis, output in zip(axes, outputs, strict=True):
        own = (along if in_time else first) & (table["output"] == output)
        order = np.argsort(table["time"][own], kind="stable")[:MOST_POINTS]
        shown = {name: column[own][order] for name, column in table.items()}
        axis.set_title(output)
        what = "change in one step" if shown["kind"][0] == "change" else "value"
        (_along_time if in_time else _against_each_other)(axis, shown, with_unit(what, shown["unit"][0]))
    legend_below(figure, axes[0])
    return figure


def _follow(time: np.ndarray, kinds: np.ndarray) -> bool:
    """Whether rows are a course in time: those of a simulator without states, or in no order, are not."""
    steps = np.diff(np.sort(time))
    return "change" in kinds and len(steps) > 1 and bool(steps.min() > 0 and steps.max() < 1.5 * np.median(steps))


def _along_time(axis: Any, shown: dict[str, np.ndarray], label: str) -> None:
    t, mean, std, between = (shown[c] for c in ("time", "mean", "std", "epistemic_std"))
    axis.fill_between(t, mean - 2 * std, mean + 2 * std, color=COLOURS[0], alpha=0.15, label="±2 std, total")
    axis.fill_between(t, mean - 2 * between, mean + 2 * between, color=COLOURS[0], alpha=0.35, label="±2 std, model")
    axis.plot(t, mean, color=COLOURS[0], linewidth=1.2, label="predicted")
    axis.plot(t, shown["measured"], ".", color=COLOURS[1], markersize=3, label="measured")
    axis.set(xlabel="time [s]", ylabel=label)


def _against_each_other(axis: Any, shown: dict[str, np.ndarray], label: str) -> None:
    measured, mean, std = (shown[c] for c in ("measured", "mean", "std"))
    ends = [measured.min(), measured.max()]
    axis.plot(ends, ends, color="0.6", linewidth=1, linestyle="--", label="exact prediction")
    style = {"fmt": ".", "color": COLOURS[0], "ecolor": "#9CC7E1", "elinewidth": 1, "markersize": 4}
    axis.errorbar(measured, mean, yerr=2 * std, label="predicted, ±2 std, total", **style)
    axis.set(xlabel=f"measured {label}", ylabel=f"predicted {label}")


def _calibration(path: Path) -> Any:
    table = read_columns(path)
    outputs = distinct(table["output"])
    figure, (axis,) = new_figure(1, 3.6, 3.4, beside=len(outputs))
    axis.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--")
    for j, output in enumerate(outputs):
        own = table["output"] == output
        levels = np.unique(table["level"][own])
        fraction = [table["fraction"][own & (table["level"] == level)].mean() for level in levels]
        style = {"color": BLACK, "linewidth": 2.0} if output == "joint" else line_style(j) | {"linewidth": 1.2}
        axis.plot(levels, fraction, label=output, **style)
    axis.set(
        title="calibration, test data",
        xlabel="stated probability",
        ylabel="share of test targets inside",
        xlim=(0, 1),
        ylim=(0, 1),
    )
    axis.text(0.97, 0.05, "below the diagonal: overconfident", ha="right", fontsize=7, color="0.4")
    legend_beside(axis)
    return figure


def _horizon(path: Path) -> Any:
    table = read_columns(path)
    outputs, seeds = distinct(table["output"]), distinct(table["seed"].tolist())
    figure, axes = new_figure(len(outputs))
    for axis, output in zip(axes, outputs, strict=True):
        for i, seed in enumerate(seeds):
            own = (table["output"] == output) & (table["seed"] == seed)
            alpha = 0.9 if i == 0 else 0.4
            label = (
                (f"error (RMSE){_of_seeds(seed, seeds)}", "predicted standard deviation") if i == 0 else (None, None)
            )
            there = own & np.isfinite(table["rmse"])  # a slow sensor was not there at every time
            mark = "-" if there.sum() == own.sum() else ".-"
            axis.plot(
                table["horizon"][there], table["rmse"][there], mark, color=COLOURS[1], alpha=alpha, label=label[0]
            )
            axis.plot(
                table["horizon"][own], table["claimed_std"][own], "--", color=COLOURS[0], alpha=alpha, label=label[1]
            )
        unit = table["unit"][table["output"] == output][0]
        axis.set(title=output, xlabel="time ahead [s]", ylabel=with_unit("error ahead", unit), ylim=(0, None))
    legend_below(figure, axes[0])
    return figure


def _example(path: Path) -> Any:
    """Measured and predicted course of the first seed's free run whose error is the median of all."""
    table = read_columns(path)
    table = {name: column[table["seed"] == table["seed"][0]] for name, column in table.items()}
    runs = list(zip(table["episode"], table["segment"], table["start"], strict=True))
    typical = _median_run(runs, table)
    outputs = distinct(table["output"])
    figure, axes = new_figure(len(outputs))
    chosen = np.array([run == typical for run in runs])
    for axis, output in zip(axes, outputs, strict=True):
        own = chosen & (table["output"] == output)
        t, mean, std, measured = (table[c][own] for c in ("time", "mean", "std", "measured"))
        axis.fill_between(t, mean - 2 * std, mean + 2 * std, color=COLOURS[0], alpha=0.2, label="±2 std")
        axis.plot(t, mean, color=COLOURS[0], linewidth=1.2, label="predicted")
        axis.plot(t, measured, ".", color=COLOURS[1], markersize=4, label="measured")
        axis.set(title=output, xlabel="time [s]", ylabel=with_unit("value", table["unit"][own][0]))
    legend_below(figure, axes[0])
    count = len(set(runs))
    figure.suptitle(f"test episode {typical[0]} from {typical[2]:.4g} s: median error of {count} runs", fontsize=9)
    return figure


def _median_run(runs: list[tuple[Any, ...]], table: dict[str, np.ndarray]) -> tuple[Any, ...]:
    """Return the run in the middle, by squared error relative to that of all runs, summed over outputs."""
    squared = np.nan_to_num((table["mean"] - table["measured"]) ** 2)  # where nothing was measured there is no error
    for output in distinct(table["output"]):
        own = table["output"] == output
        squared[own] /= max(squared[own].mean(), np.finfo(float).tiny)
    total: dict[tuple[Any, ...], float] = defaultdict(float)
    for run, value in zip(runs, squared, strict=True):
        total[run] += value
    return sorted(total, key=lambda run: total[run])[(len(total) - 1) // 2]
