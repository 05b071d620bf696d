"""Figures of a run, drawn from its Parquet files only."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.records import read_metrics, replacing

# colour-blind safe (Okabe and Ito 2008)
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


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
                drawn.append(_save(figure, directory / f"{name}.png"))
    return drawn


def _figure(n: int, width: float = 3.6, height: float = 2.8) -> tuple[Any, list[Any]]:
    """A row of n axes, without pyplot: no global state, no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(n, 4)
    rows = -(-n // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for unused in axes[n:]:
        unused.set_visible(False)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.6)
    return figure, axes[:n]


def _save(figure: Any, path: Path) -> Path:
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)
    return path


def _columns(path: Path) -> dict[str, np.ndarray]:
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}


def _names(values: Iterable[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


def _label(name: str, unit: str) -> str:
    return name if unit in ("1", "") else f"{name} [{unit}]"


def _learning_curves(path: Path) -> Any:
    rows = [r for r in read_metrics(path) if r["split"] == "train"]
    if not rows:
        return None
    figure, (loss, noise) = _figure(2)
    for i, seed in enumerate(_names(r["seed"] for r in rows)):
        own = [r for r in rows if r["seed"] == seed]
        curve = [(r["step"], r["value"]) for r in own if r["metric"] == "loss"]
        loss.plot(*zip(*curve, strict=True), color=COLOURS[0], alpha=0.9 if i == 0 else 0.4, linewidth=1)
        for j, output in enumerate(_names(r["output"] for r in own if r["metric"] == "noise_std")):
            line = [(r["step"], r["value"]) for r in own if r["metric"] == "noise_std" and r["output"] == output]
            unit = next(r["unit"] for r in own if r["metric"] == "noise_std" and r["output"] == output)
            label = _label(output, unit) if i == 0 else None
            noise.plot(*zip(*line, strict=True), color=COLOURS[j % 7], alpha=0.9 if i == 0 else 0.4, label=label)
    loss.set(title="training", xlabel="step", ylabel="negative log-likelihood per point [nat]")
    # the fall of the first steps is not what one looks for: scale the axis to what follows
    late = [r["value"] for r in rows if r["metric"] == "loss" and r["step"] >= 0.05 * rows[-1]["step"]]
    margin = 0.05 * (max(late) - min(late)) + 1e-9
    loss.set_ylim(min(late) - margin, max(late) + margin)
    noise.set(title="learned noise", xlabel="step", ylabel="standard deviation", yscale="log")
    noise.legend(fontsize=7, frameon=False)
    return figure


def _predictions(path: Path) -> Any:
    """Measured target against prediction with bands, along the longest test segment of the first seed."""
    table = _columns(path)
    first = table["seed"] == table["seed"][0]
    pieces = Counter(zip(table["episode"][first], table["segment"][first], strict=True))
    (episode, segment), _ = pieces.most_common(1)[0]
    chosen = first & (table["episode"] == episode) & (table["segment"] == segment)
    outputs = _names(table["output"])
    figure, axes = _figure(len(outputs))
    for axis, output in zip(axes, outputs, strict=True):
        own = chosen & (table["output"] == output)
        order = np.argsort(table["time"][own], kind="stable")[:200]
        t, mean, std, between, measured = (
            table[c][own][order] for c in ("time", "mean", "std", "epistemic_std", "measured")
        )
        axis.fill_between(t, mean - 2 * std, mean + 2 * std, color=COLOURS[0], alpha=0.15, label="±2 std, total")
        axis.fill_between(
            t, mean - 2 * between, mean + 2 * between, color=COLOURS[0], alpha=0.35, label="±2 std, model"
        )
        axis.plot(t, mean, color=COLOURS[0], linewidth=1.2, label="predicted")
        axis.plot(t, measured, ".", color=COLOURS[1], markersize=3, label="measured")
        axis.set(
            title=f"change of {output} in one step", xlabel="time [s]", ylabel=_label(output, table["unit"][own][0])
        )
    axes[0].legend(fontsize=7, frameon=False)
    return figure


def _calibration(path: Path) -> Any:
    table = _columns(path)
    figure, (axis,) = _figure(1, 4.2, 3.6)
    axis.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--")
    for j, output in enumerate(_names(table["output"])):
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
    table = _columns(path)
    outputs = _names(table["output"])
    figure, axes = _figure(len(outputs))
    for axis, output in zip(axes, outputs, strict=True):
        for i, seed in enumerate(_names(table["seed"])):
            own = (table["output"] == output) & (table["seed"] == seed)
            alpha = 0.9 if i == 0 else 0.4
            label = ("error (RMSE)", "claimed std") if i == 0 else (None, None)
            axis.plot(table["horizon"][own], table["rmse"][own], color=COLOURS[1], alpha=alpha, label=label[0])
            axis.plot(
                table["horizon"][own], table["claimed_std"][own], "--", color=COLOURS[0], alpha=alpha, label=label[1]
            )
        unit = table["unit"][table["output"] == output][0]
        axis.set(title=f"free run, {output}", xlabel="time ahead [s]", ylabel=_label(output, unit), ylim=(0, None))
    axes[0].legend(fontsize=7, frameon=False)
    return figure


def _line(row: dict[str, Any]) -> str:
    """Name of the line that a row of a sweep belongs to: its method, and every swept key but seed and training size."""
    swept = [w for w in row["run"].split() if "=" in w]
    own = [w for w in swept if not w.startswith(("method=", "data.n_train=", "run.seed="))]
    return " ".join([row["method"], *own])


def draw_sweep(path: Path, metric: str, output: str = "joint") -> Path | None:
    """Draw a test metric against the number of training transitions from `sweep.parquet`.

    A line per method and further swept key (median over seeds), a band from the smallest to the largest seed, a
    panel per data set.
    Returns None where no run has the metric.
    """
    rows = [r for r in read_metrics(path) if r["split"] == "test" and r["metric"] == metric and r["output"] == output]
    if not rows:
        return None
    panels = _names((r["experiment"], r["data"]) for r in rows)
    figure, axes = _figure(len(panels), 4.6, 3.4)
    for axis, panel in zip(axes, panels, strict=True):
        own = [r for r in rows if (r["experiment"], r["data"]) == panel]
        for j, line in enumerate(_names(_line(r) for r in own)):
            sizes = sorted({r["n_train"] for r in own if _line(r) == line})
            values = [[r["value"] for r in own if _line(r) == line and r["n_train"] == n] for n in sizes]
            colour = COLOURS[j % 7]
            axis.plot(sizes, [np.median(v) for v in values], marker="o", markersize=4, color=colour, label=line)
            axis.fill_between(sizes, [min(v) for v in values], [max(v) for v in values], color=colour, alpha=0.2)
        ticks = sorted({r["n_train"] for r in own})
        axis.set(title=panel[0], xlabel="training transitions", ylabel=f"test {metric.upper()}", xscale="log")
        axis.set_xticks(ticks, [str(t) for t in ticks])
        values = [r["value"] for r in own]
        if max(values) > 10 + 3 * max(np.median(values), 1.0):
            # a few overconfident runs would flatten all others into one line
            axis.set_yscale("symlog", linthresh=10)
        axis.minorticks_off()
        axis.legend(fontsize=8, frameon=False)
    return _save(figure, path.with_name(f"{metric}_vs_n_train.png"))
