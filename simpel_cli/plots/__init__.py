"""Figures, drawn from Parquet files only."""

from simpel_cli.plots.discover import draw_discover
from simpel_cli.plots.run import draw_run
from simpel_cli.plots.sweep import draw_sweep

__all__ = ["draw_discover", "draw_run", "draw_sweep"]
