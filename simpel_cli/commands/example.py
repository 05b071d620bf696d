"""`simpel example`: a folder to begin with."""

from pathlib import Path
from typing import Annotated

import typer


def example(
    folder: Annotated[Path, typer.Argument(help="A new or empty folder.")],
) -> None:
    """Write the folder of a rig, to be changed into your own: simulator, measurements, effect, task, experiment.

    Examples:
      simpel example my
    """
    from simpel_cli.reporting.example import example as task

    task(folder)
