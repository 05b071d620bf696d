"""`simpel report`: runs and sweeps compared."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Directories of runs or sweeps, or folders that hold them.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the report. Default: the sweep's own directory, or a new one in runs/report."),
    ] = None,
    baseline: Annotated[
        str | None, typer.Option(help="Method that the others are compared with. Default: the best.")
    ] = None,
) -> None:
    """Compare runs and sweeps in one HTML file, with LaTeX and CSV tables.

    Examples:
      simpel report runs/sweep/pendulum/20261121-101502-3fa9

      simpel report runs/fit/pendulum/* --baseline fsvgd --out comparison
    """
    from simpel_cli.reporting.report import default_folder
    from simpel_cli.reporting.report import report as task

    task(directories, out or default_folder(directories), baseline)
