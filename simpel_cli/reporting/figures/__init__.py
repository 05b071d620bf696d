"""Figures, drawn from Parquet files only."""

from simpel_cli.reporting.figures.discover import draw_discover
from simpel_cli.reporting.figures.run import draw_run
from simpel_cli.reporting.figures.sweep import draw_sweep

__all__ = ["draw_discover", "draw_run", "draw_sweep"]
