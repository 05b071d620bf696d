"""Figures, drawn from Parquet files only."""

from simpel_cli.plots.run import draw_run
from simpel_cli.plots.sweep import draw_sweep

__all__ = ["draw_run", "draw_sweep"]
