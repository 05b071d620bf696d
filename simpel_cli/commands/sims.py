"""`simpel sims`: the simulators that there are."""

from typing import Annotated

import typer

from simpel_cli.commands.options import ConfigDir, option_of


def sims(
    name: Annotated[
        str | None, typer.Argument(help="Show this one, with ranges and equations.", autocompletion=option_of("sim"))
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """List the simulators, or show one with its ranges, units and equations.

    Examples:
      simpel sims

      simpel sims pendulum
    """
    from simpel_cli.reporting.catalogue import sims as task

    task(name, config_dir)
