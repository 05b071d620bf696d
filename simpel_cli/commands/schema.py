"""`simpel schema`: JSON Schemas of YAML files, for editors."""

from pathlib import Path
from typing import Annotated

import typer

from simpel_cli.errors import ConfigError


def _names(incomplete: str) -> list[str]:
    from simpel_cli.config.schemas import NAMES

    return [name for name in NAMES if name.startswith(incomplete)]


def schema(
    name: Annotated[
        str | None,
        typer.Argument(help="Print this one: sim, data, reward or experiment.", autocompletion=_names),
    ] = None,
    write: Annotated[Path | None, typer.Option(help="Write all of them into this folder.")] = None,
) -> None:
    """Print or write JSON Schemas of YAML files, with which an editor completes and checks them.

    Examples:
      simpel schema sim

      simpel schema --write schemas
    """
    from simpel_cli.config.schemas import text_of
    from simpel_cli.config.schemas import write as write_all

    if (name is None) == (write is None):
        raise ConfigError(
            "schema: name one (sim, data, reward or experiment), or write all: simpel schema --write DIR."
        )
    if name is not None:
        typer.echo(text_of(name), nl=False)
        return
    assert write is not None
    for path in write_all(write):
        group = path.name.partition(".")[0]
        typer.echo(f"{path}: in {group}/NAME.yaml write   # yaml-language-server: $schema={path.absolute().as_uri()}")
