"""The figure of a sweep: test NLL and error against the number of training transitions."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli.plots.canvas import distinct, legend_below, line_style, new_figure, ratio_scale, save
from simpel_cli.records import read_metrics

METRICS = {"nll": "test NLL [nat]", "nrmse": "test RMSE, normalised"}
FARTHEST = 5.0  # a line that would stretch the axis more than so many times is not followed
LEAST_SPAN = 1.0  # nat; differences below are small however the lines lie


class Line(NamedTuple):
    """One method (and further swept keys): spread over seeds by training size."""

    name: str
    sizes: np.ndarray  # (k,)
    low: np.ndarray  # (k,) smallest seed
    middle: np.ndarray  # (k,) median
    high: np.ndarray  # (k,) largest seed


def draw_sweep(path: Path) -> Path | None:
    """Draw joint test NLL and normalised RMSE against the number of training transitions, from `sweep.parquet`.

    A line per method and further swept key (median over seeds), a band from the smallest to the largest seed, a row
    of two panels per data set. A line far above all others in NLL leaves the panel, with its values noted at the edge:
    following it would flatten the others into one.
    Returns None where no run has a metric.
    """
    rows = [r for r in read_metrics(path) if r["split"] == "test" and r["output"] == "joint" and r["metric"] in METRICS]
    if not rows:
        return None
    data_sets = distinct((r["experiment"], r["data"]) for r in rows)
    figure, axes = new_figure(2 * len(data_sets), 4.2, 3.2, columns=2)
    panels = [(data_set, metric) for data_set in data_sets for metric in METRICS]
    for axis, (data_set, metric) in zip(axes, panels, strict=True):
        own = [r for r in rows if (r["experiment"], r["data"]) == data_set and r["metric"] == metric]
        lines = _lines(own)
        for j, line in enumerate(lines):
            style = line_style(j)
            axis.fill_between(line.sizes, line.low, line.high, color=style["color"], alpha=0.2, linewidth=0)
            axis.plot(line.sizes, line.middle, label=line.name, **(style | {"marker": "o", "markevery": 1}))
        sizes = sorted({r["n_train"] for r in own})
        axis.set(title=data_set[0], xlabel="training transitions", ylabel=METRICS[metric], xscale="log")
        axis.set_xticks(sizes, [str(n) for n in sizes])
        axis.minorticks_off()
        axis.margins(x=0.1)
        (_zoom if metric == "nll" else _by_ratio)(axis, lines)
    legend_below(figure, axes[0])
    return save(figure, path.with_name("metrics_vs_n_train.png"))


def _lines(rows: list[dict[str, Any]]) -> list[Line]:
    lines = []
    for name in distinct(_name(r) for r in rows):
        sizes = sorted({r["n_train"] for r in rows if _name(r) == name})
        values = [[r["value"] for r in rows if _name(r) == name and r["n_train"] == n] for n in sizes]
        spread = (np.array([reduce(v) for v in values]) for reduce in (np.min, np.median, np.max))
        lines.append(Line(name, np.array(sizes), *spread))
    return lines


def _name(row: dict[str, Any]) -> str:
    """Name of the line that a row of a sweep belongs to: its method, and every swept key but seed and training size."""
    swept = [w for w in row["run"].split() if "=" in w]
    own = [w for w in swept if not w.startswith(("method=", "data.n_train=", "run.seed="))]
    return " ".join([row["method"], *own])


def _zoom(axis: Any, lines: list[Line]) -> None:
    """Fit the axis to the lines that lie together; note the medians of the others where they leave it."""
    bottom, top = view(lines)
    if top is None:
        return
    axis.set_ylim(bottom, top)
    for size in distinct(n for line in lines for n in line.sizes.tolist()):
        beyond = [
            (j, float(line.middle[line.sizes == size][0]))
            for j, line in enumerate(lines)
            if size in line.sizes and line.middle[line.sizes == size][0] > top
        ]
        for place, (j, value) in enumerate(sorted(beyond, key=lambda item: -item[1])):
            axis.annotate(
                f"↑ {value:.3g}", (size, 1), xycoords=("data", "axes fraction"), xytext=(0, -3 - 11 * place),
                textcoords="offset points", ha="center", va="top", fontsize=8, color=line_style(j)["color"],
            )  # fmt: skip


def view(lines: list[Line]) -> tuple[float, float | None]:
    """Return the limits of an axis that shows the lines that lie together; no upper one if these are all."""
    ordered = sorted(lines, key=lambda line: line.high.max())
    bottom = min(line.low.min() for line in ordered)
    top = ordered[0].high.max()
    for line in ordered[1:]:
        if line.high.max() - bottom > FARTHEST * max(top - bottom, LEAST_SPAN):
            span = max(top - bottom, LEAST_SPAN)
            return float(bottom - 0.1 * span), float(top + 0.6 * span)
        top = line.high.max()
    return float(bottom), None


def _by_ratio(axis: Any, lines: list[Line]) -> None:
    """Scale by ratio where values differ by more than a factor of 3."""
    low, high = min(line.low.min() for line in lines), max(line.high.max() for line in lines)
    if low > 0 and high > 3 * low:
        ratio_scale(axis)
        axis.set_ylim(low / 1.2, high * 1.2)
    else:
        axis.set_ylim(0, None)
