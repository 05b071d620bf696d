"""The figure of a sweep: test NLL and error against the number of training transitions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli.evaluation.comparison import METRICS, Point, by_seed, points
from simpel_cli.reporting.figures.canvas import distinct, legend_below, line_style, new_figure, ratio_scale, save
from simpel_cli.runs.metrics import read_metrics

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
    """Draw the metrics of `sweep.parquet` against the number of training transitions, see `draw_by_size`."""
    rows = read_metrics(path)
    every = [point for run in distinct(r["run"] for r in rows) for point in _points(rows, run)]
    return draw_by_size(every, path.with_name("metrics_vs_n_train.png"))


def draw_by_size(every: Sequence[Point], path: Path) -> Path | None:
    """Draw joint metrics against the number of training transitions.

    A line per method and further swept key (median over seeds), a band from the smallest to the largest seed, a row
    of two panels per data set. A line far above all others in NLL leaves the panel, with its values noted at the edge:
    following it would flatten the others into one.
    Returns None where no run has a metric.
    """
    shown = []
    for panel in distinct(p.panel for p in every):
        own = [p for p in every if p.panel == panel]
        there = [m for m in METRICS.get(panel[0], ()) if m.sign and any(p.metric == m.name for p in own)]
        shown += [(panel, metric, by_seed(own, metric.name)) for metric in there[:2]]
    if not shown:
        return None
    figure, axes = new_figure(len(shown), 4.2, 3.2, columns=2)
    names = distinct(name for *_, cells in shown for name, _ in cells)
    for axis, (panel, metric, cells) in zip(axes, shown, strict=True):
        lines = _lines(cells)
        for line in lines:
            style = line_style(names.index(line.name))
            axis.fill_between(line.sizes, line.low, line.high, color=style["color"], alpha=0.2, linewidth=0)
            axis.plot(line.sizes, line.middle, label=line.name, **(style | {"marker": "o", "markevery": 1}))
        sizes = sorted({size for _, size in cells})
        axis.set(title=panel[1] or panel[2], xlabel="training transitions", ylabel=metric.label)
        if min(sizes) > 0:
            axis.set_xscale("log")
        axis.set_xticks(sizes, [str(n) for n in sizes])
        axis.minorticks_off()
        axis.margins(x=0.1)
        if metric.name == "nll":
            _zoom(axis, lines, names)
        elif metric.sign < 0:
            _by_ratio(axis, lines)
    legend_below(figure, axes[0])
    return save(figure, path)


def _points(rows: list[dict[str, Any]], run: str) -> list[Point]:
    return points((r for r in rows if r["run"] == run), run.split())


def _lines(cells: dict[tuple[str, int], dict[int, float]]) -> list[Line]:
    lines = []
    for name in distinct(name for name, _ in cells):
        sizes = sorted(size for own, size in cells if own == name)
        values = [list(cells[name, size].values()) for size in sizes]
        spread = (np.array([reduce(v) for v in values]) for reduce in (np.min, np.median, np.max))
        lines.append(Line(name, np.array(sizes), *spread))
    return lines


def _zoom(axis: Any, lines: list[Line], names: list[str]) -> None:
    """Fit the axis to the lines that lie together; note the medians of the others where they leave it."""
    bottom, top = view(lines)
    if top is None:
        return
    axis.set_ylim(bottom, top)
    for size in distinct(n for line in lines for n in line.sizes.tolist()):
        beyond = [
            (names.index(line.name), float(line.middle[line.sizes == size][0]))
            for line in lines
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
