"""What every figure shares: axes without global state, colours, legends beside the curves, saving."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.runs.files import replacing

# colour-blind safe (Okabe and Ito 2008)
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BLACK = "#000000"
DASHES = ("-", "--", ":", "-.")
MARKERS = ("", "o", "s", "^")
LEGEND_LINES = 14  # in a column of a legend
LEGEND_WIDTH = 1.5  # of that column, inches


def new_figure(
    n: int, width: float = 3.6, height: float = 2.8, columns: int = 4, beside: int = 0
) -> tuple[Any, list[Any]]:
    """Rows of n axes, without pyplot: no global state, no display.

    Args:
        n: number of axes.
        width: of one, inches.
        height: of one, inches.
        columns: most in a row.
        beside: number of lines in a legend beside the last one, for which the figure grows.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(n, columns)
    rows = -(-n // columns)
    figure = Figure(
        figsize=(width * columns + LEGEND_WIDTH * -(-beside // LEGEND_LINES), height * rows), layout="constrained"
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for unused in axes[n:]:
        unused.remove()
    for axis in axes[:n]:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.6)
    return figure, axes[:n]


def line_style(i: int) -> dict[str, Any]:
    """Colour and dashes of the i-th line: the first 24 all differ, and later ones differ by a marker."""
    dash, marker = (i // len(COLOURS)) % len(DASHES), i // (len(COLOURS) * len(DASHES))
    return {
        "color": COLOURS[i % len(COLOURS)],
        "linestyle": DASHES[dash],
        "marker": MARKERS[marker % len(MARKERS)],
        "markersize": 3,
        "markevery": 0.2,
    }


def legend_below(figure: Any, axis: Any) -> None:
    """Put the legend of an axis below the whole figure, where it covers no curve."""
    handles, labels = axis.get_legend_handles_labels()
    columns = max(1, int(figure.get_figwidth() // 1.7))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)


def legend_beside(axis: Any) -> None:
    """Put the legend of an axis to its right, in as many columns as its lines need."""
    columns = -(-len(axis.get_legend_handles_labels()[1]) // LEGEND_LINES)
    axis.legend(
        loc="center left", bbox_to_anchor=(1.01, 0.5), ncols=columns, fontsize=7, frameon=False, borderaxespad=0
    )


def save(figure: Any, path: Path) -> Path:
    """Write a PNG atomically."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)
    return path


def distinct(values: Iterable[Any]) -> list[Any]:
    """Return distinct values in order of appearance."""
    return list(dict.fromkeys(values))


def with_interval(value: float, low: float = np.nan, high: float = np.nan, sign: str = "") -> str:
    """Return a number with its interval, if it has one, to two digits of the interval's half width."""
    if not np.isfinite(value):
        return "-"
    if not (np.isfinite(low) and np.isfinite(high)):
        return f"{value:.3g}{sign}"
    half = max((high - low) / 2, 1e-12 * max(abs(value), 1e-300))
    decimals = max(1 - int(np.floor(np.log10(half))), 0)
    fine = decimals <= 6 and abs(value) < 1e6
    first, *ends = (f"{v:.{decimals}f}" if fine else f"{v:.3g}" for v in (value, low, high))
    return f"{first}{sign} ({ends[0]}..{ends[1]})"


def ratio_scale(axis: Any) -> None:
    """Make the y axis logarithmic, with ticks that a person can read."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    class Readable(LogLocator):
        """1, 2 and 5 of every decade, where there are few; matplotlib would show none at all of many."""

        def tick_values(self, low: float, high: float) -> Any:
            few = low > 0 and high / low < 1e3
            self.set_params(subs=(1.0, 2.0, 5.0) if few else (1.0,))
            return super().tick_values(low, high)

    axis.set_yscale("log")
    axis.yaxis.set_major_locator(Readable())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())


def with_unit(name: str, unit: str) -> str:
    """Return `name [unit]`, or the name alone where there is no unit."""
    return name if unit in ("1", "") else f"{name} [{unit}]"
