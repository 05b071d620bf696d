"""Figures of a search, drawn from its run directory."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from simpel_cli.reporting.figures.canvas import save
from simpel_cli.reporting.figures.discover_evidence import draw_evidence, draw_parameters
from simpel_cli.reporting.figures.discover_force import draw_effects, draw_residual
from simpel_cli.reporting.figures.discover_next import draw_next
from simpel_cli.reporting.figures.discover_runs import draw_errors, draw_traces, draw_whiteness


def draw_discover(directory: Path) -> list[Path]:
    """Draw every figure whose files are there, in the order in which a report shows them; returns their paths.

    Args:
        directory: of the run, with `verdict.json` and tables.
    """
    found = json.loads((directory / "verdict.json").read_text())
    parts: list[tuple[str, tuple[str, ...], Callable[..., Any]]] = [
        ("residual", ("residuals.parquet",), draw_residual),
        ("effects", ("residuals.parquet", "effect_curves.parquet"), draw_effects),
        ("traces", ("trajectories.parquet",), draw_traces),
        ("evidence", ("candidates.parquet",), draw_evidence),
        ("parameters", ("parameters.parquet",), draw_parameters),
        ("whiteness", ("innovations.parquet",), draw_whiteness),
        ("errors", ("errors.parquet",), draw_errors),
        ("next_experiment", ("next_experiment.csv",), draw_next),
    ]
    drawn = []
    for name, sources, draw in parts:
        paths = [directory / source for source in sources]
        if all(path.is_file() for path in paths):
            figure = draw(found, *paths)
            if figure is not None:
                drawn.append(save(figure, directory / f"{name}.png"))
    return drawn
