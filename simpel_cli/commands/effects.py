"""`simpel effects`: the effects that `discover` can find."""

from typing import Annotated

import typer

from simpel_cli.commands.options import ConfigDir, option_of


def effects(
    name: Annotated[
        str | None, typer.Argument(help="Show this one, with its parameters.", autocompletion=option_of("effect"))
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """List the effects that `discover` can find, or show one with its formula and parameters.

    Examples:
      simpel effects

      simpel effects coulomb_friction
    """
    from simpel_cli.reporting.catalogue import effects as task

    task(name, config_dir)
