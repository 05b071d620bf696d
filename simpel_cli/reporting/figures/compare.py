"""Figures of many runs: learning curves and calibration of each method."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli.reporting.figures.canvas import distinct, legend_below, line_style, new_figure, save

MOST_LINES = 60  # of a panel; of more, every k-th is drawn
EARLY = 0.05  # of a run; its steep fall is left out of the axis limits


class Course(NamedTuple):
    """The learning curve of a run.

    Args:
        variant: name of its method.
        size: training transitions.
        steps: of the run, or episodes, shape (k,).
        values: at them, shape (k,).
    """

    variant: str
    size: int
    steps: np.ndarray
    values: np.ndarray


def draw_courses(courses: Sequence[Course], label: str, across: str, path: Path) -> Path:
    """Draw every run's course: a panel per method, a colour per number of training transitions."""
    variants, sizes = distinct(c.variant for c in courses), sorted({c.size for c in courses})
    figure, axes = new_figure(len(variants), 3.6, 2.6, columns=3)
    for axis, variant in zip(axes, variants, strict=True):
        own = [c for c in courses if c.variant == variant]
        own = own[:: -(-len(own) // MOST_LINES)]
        for course in own:
            axis.plot(course.steps, course.values, color=line_style(sizes.index(course.size))["color"], linewidth=0.8)
        late = np.concatenate([c.values[c.steps >= EARLY * c.steps[-1]] for c in own])
        late = late[np.isfinite(late)]
        if len(late):
            margin = 0.05 * float(np.ptp(late)) + 1e-9
            axis.set_ylim(late.min() - margin, late.max() + margin)
        axis.set(title=variant, xlabel=across, ylabel=label)
        axis.title.set_fontsize(9)
    if len(sizes) > 1 or sizes[0] > 0:
        for i, size in enumerate(sizes):
            axes[0].plot([], [], color=line_style(i)["color"], label=f"n = {size}")
        legend_below(figure, axes[0])
    return save(figure, path)


def draw_calibrations(found: Mapping[str, Mapping[str, Any]], path: Path) -> Path:
    """Draw the share of test targets inside the central region of a stated probability, joint over outputs.

    Args:
        found: variant -> columns `level` and `fraction` of all of its runs.
        path: of the figure.
    """
    figure, (axis,) = new_figure(1, 4.2, 3.8)
    axis.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--")
    for i, (variant, table) in enumerate(found.items()):
        levels = np.unique(table["level"])
        shares = [table["fraction"][table["level"] == level] for level in levels]
        style = line_style(i)
        axis.fill_between(
            levels, [s.min() for s in shares], [s.max() for s in shares], color=style["color"], alpha=0.12, linewidth=0
        )
        axis.plot(levels, [s.mean() for s in shares], label=variant, **(style | {"marker": ""}))
    axis.set(xlabel="stated probability", ylabel="share of test targets inside", xlim=(0, 1), ylim=(0, 1))
    axis.text(0.97, 0.05, "below the diagonal: overconfident", ha="right", fontsize=7, color="0.4")
    legend_below(figure, axis)
    return save(figure, path)
