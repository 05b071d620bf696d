"""`simpel report`: runs and sweeps compared."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    directories: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Runs, sweeps, or folders of them.")],
    out: Annotated[Path | None, typer.Option(help="Left out: the sweep itself, else a folder in runs/report.")] = None,
    baseline: Annotated[str | None, typer.Option(help="Method that the others are compared with.")] = None,
) -> None:
    """Compare runs and sweeps: one HTML file, LaTeX and CSV tables.

    Examples:
      simpel report runs/sweep/pendulum/20261121-101502-3fa9

      simpel report runs/fit/pendulum/* --baseline fsvgd --out comparison
    """
    from simpel_cli.reporting.compare_runs import default_folder
    from simpel_cli.reporting.compare_runs import report as task

    task(directories, out or default_folder(directories), baseline)
