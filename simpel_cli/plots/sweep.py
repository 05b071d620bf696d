"""The figure of a sweep: test metrics against the number of training transitions."""

from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.plots.canvas import COLOURS, distinct, new_figure, save
from simpel_cli.records import read_metrics


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
    panels = distinct((r["experiment"], r["data"]) for r in rows)
    figure, axes = new_figure(len(panels), 4.6, 3.4)
    for axis, panel in zip(axes, panels, strict=True):
        own = [r for r in rows if (r["experiment"], r["data"]) == panel]
        for j, line in enumerate(distinct(_line(r) for r in own)):
            sizes = sorted({r["n_train"] for r in own if _line(r) == line})
            values = [[r["value"] for r in own if _line(r) == line and r["n_train"] == n] for n in sizes]
            colour = COLOURS[j % 6]
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
    return save(figure, path.with_name(f"{metric}_vs_n_train.png"))
