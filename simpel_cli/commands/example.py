"""`simpel example`: a folder to begin with."""

from pathlib import Path
from typing import Annotated

import typer


def example(
    folder: Annotated[Path, typer.Argument(help="A new or empty folder.")],
) -> None:
    """Write a complete example into a new folder: simulator, measurements, effect, task and experiment, for you to change.

    Examples:
      simpel example my

      simpel example rigs/cart
    """
    from simpel_cli.reporting.example import example as task

    task(folder)
