"""Figures of a run."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.plots.canvas import COLOURS, columns_of, distinct, legend_below, new_figure, save, with_unit
from simpel_cli.records import read_metrics

MOST_POINTS = 200  # of a panel: more of them is a band of ink


def draw_run(directory: Path) -> list[Path]:
    """Draw every figure whose Parquet file is there; returns their paths."""
    figures = [
        (_learning_curves, directory / "metrics.parquet", "learning_curves"),
        (_predictions, directory / "predictions.parquet", "predictions"),
        (_calibration, directory / "calibration.parquet", "calibration"),
        (_horizon, directory / "horizon.parquet", "free_run"),
    ]
    drawn = []
    for draw, source, name in figures:
        if source.is_file():
            figure = draw(source)
            if figure is not None:
                drawn.append(save(figure, directory / f"{name}.png"))
    return drawn


def _learning_curves(path: Path) -> Any:
    rows = [r for r in read_metrics(path) if r["split"] == "train"]
    if not rows:
        return None
    figure, (loss, noise) = new_figure(2)
    for i, seed in enumerate(distinct(r["seed"] for r in rows)):
        own = [r for r in rows if r["seed"] == seed]
        curve = [(r["step"], r["value"]) for r in own if r["metric"] == "loss"]
        loss.plot(*zip(*curve, strict=True), color=COLOURS[0], alpha=0.9 if i == 0 else 0.4, linewidth=1)
        for j, output in enumerate(distinct(r["output"] for r in own if r["metric"] == "noise_std")):
            line = [(r["step"], r["value"]) for r in own if r["metric"] == "noise_std" and r["output"] == output]
            unit = next(r["unit"] for r in own if r["metric"] == "noise_std" and r["output"] == output)
            label = with_unit(output, unit) if i == 0 else None
            noise.plot(*zip(*line, strict=True), color=COLOURS[j % 6], alpha=0.9 if i == 0 else 0.4, label=label)
    loss.set(title="training", xlabel="step", ylabel="negative log-likelihood per point [nat]")
    # the fall of the first steps is not what one looks for: scale the axis to what follows
    late = [r["value"] for r in rows if r["metric"] == "loss" and r["step"] >= 0.05 * rows[-1]["step"]]
    margin = 0.05 * (max(late) - min(late)) + 1e-9
    loss.set_ylim(min(late) - margin, max(late) + margin)
    noise.set(title="learned noise", xlabel="step", ylabel="standard deviation", yscale="log")
    noise.legend(fontsize=7, frameon=False)
    return figure


def _predictions(path: Path) -> Any:
    """Measured and predicted targets of the first seed: along the longest test segment, or against each other."""
    table = columns_of(path)
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
        changes = shown["kind"][0] == "change"
        axis.set_title(f"change of {output} in one step" if changes else output)
        (_along_time if in_time else _against_each_other)(axis, shown, with_unit(output, shown["unit"][0]))
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
    axis.plot(ends, ends, color="0.6", linewidth=1, linestyle="--", label="as measured")
    style = {"fmt": ".", "color": COLOURS[0], "ecolor": "#9CC7E1", "elinewidth": 1, "markersize": 4}
    axis.errorbar(measured, mean, yerr=2 * std, label="predicted, ±2 std, total", **style)
    axis.set(xlabel=f"measured {label}", ylabel=f"predicted {label}")


def _calibration(path: Path) -> Any:
    table = columns_of(path)
    figure, (axis,) = new_figure(1, 4.2, 3.6)
    axis.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--")
    for j, output in enumerate(distinct(table["output"])):
        own = table["output"] == output
        levels = np.unique(table["level"][own])
        fraction = [table["fraction"][own & (table["level"] == level)].mean() for level in levels]
        width = 2.0 if output == "joint" else 1.2
        colour = "black" if output == "joint" else COLOURS[j % 6]
        axis.plot(levels, fraction, marker=".", markersize=4, linewidth=width, color=colour, label=output)
    axis.set(
        title="calibration",
        xlabel="stated probability",
        ylabel="share of test targets inside",
        xlim=(0, 1),
        ylim=(0, 1),
    )
    axis.text(0.97, 0.05, "below the diagonal: overconfident", ha="right", fontsize=7, color="0.4")
    axis.legend(fontsize=7, frameon=False)
    return figure


def _horizon(path: Path) -> Any:
    table = columns_of(path)
    outputs = distinct(table["output"])
    figure, axes = new_figure(len(outputs))
    for axis, output in zip(axes, outputs, strict=True):
        for i, seed in enumerate(distinct(table["seed"])):
            own = (table["output"] == output) & (table["seed"] == seed)
            alpha = 0.9 if i == 0 else 0.4
            label = ("error (RMSE)", "claimed std") if i == 0 else (None, None)
            axis.plot(table["horizon"][own], table["rmse"][own], color=COLOURS[1], alpha=alpha, label=label[0])
            axis.plot(
                table["horizon"][own], table["claimed_std"][own], "--", color=COLOURS[0], alpha=alpha, label=label[1]
            )
        unit = table["unit"][table["output"] == output][0]
        axis.set(title=f"free run, {output}", xlabel="time ahead [s]", ylabel=with_unit(output, unit), ylim=(0, None))
    axes[0].legend(fontsize=7, frameon=False)
    return figure
