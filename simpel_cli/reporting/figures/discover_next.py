"""Figure of the next experiment: the inputs, and the measurements that each possible cause predicts."""

from pathlib import Path
from typing import Any

import pandas as pd

from simpel_cli.reporting.figures.canvas import BLACK, COLOURS, DASHES, legend_below, new_figure, with_unit

PREDICTED = "_if_"  # in a column: <channel>_if_<effect>


def draw_next(found: dict[str, Any], path: Path) -> Any:
    """Draw inputs on top and, below, every measured channel with one curve per member."""
    plan = found["next_experiment"] or {}
    units = plan.get("units") or {}
    table = pd.read_csv(path, comment="#")
    predicted = [c.split(PREDICTED, 1) for c in table.columns if PREDICTED in c]
    channels = list(dict.fromkeys(channel for channel, _ in predicted))
    inputs = [c for c in table.columns if c != "time" and PREDICTED not in c]
    figure, axes = new_figure(len(inputs) + len(channels), 9.4, 1.7, columns=1)
    for axis, name in zip(axes, [*inputs, *channels], strict=True):
        if name in inputs:
            axis.step(table["time"], table[name], where="post", color=BLACK, linewidth=1.1)
        for i, effect in enumerate(effect for channel, effect in predicted if channel == name):
            # dashes let a curve be seen that lies under another
            axis.plot(
                table["time"], table[f"{name}{PREDICTED}{effect}"], DASHES[i % len(DASHES)],
                color=COLOURS[i % len(COLOURS)], linewidth=1.4, label=f"if {effect.replace('_', ' ')}",
            )  # fmt: skip
        axis.set(ylabel=with_unit(name, units.get(name, "")))
    axes[-1].set_xlabel("time [s]")
    legend_below(figure, axes[-1])
    return figure
