"""Arguments and options that several verbs have, with what completes them at TAB."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer


def _overrides(context: typer.Context, incomplete: str) -> list[str]:
    from simpel_cli.config.completion import overrides

    return overrides(context, incomplete)


def option_of(group: str) -> Callable[[typer.Context, str], list[str]]:
    """Return what completes the name of an option of a configuration group, e.g. of `sim`."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        from simpel_cli.config.groups import options

        return [name for name in options(group, context.params.get("config_dir")) if name.startswith(incomplete)]

    return complete


def _one_of(value: str | None) -> str | None:
    if value not in (None, "job", "hydra", "all"):
        raise typer.BadParameter(f"got {value!r}; allowed are job, hydra and all.")
    return value


Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE...",
        help="Groups (sim=NAME) and keys (data.n_train=20) of the configuration, as Hydra overrides.",
        autocompletion=_overrides,
    ),
]
ConfigDir = Annotated[
    Path | None,
    typer.Option("--config-dir", "-cd", help="Folder with YAML files of your own, in sim/, data/, experiment/, ..."),
]
Cfg = Annotated[
    str | None,
    typer.Option("--cfg", callback=_one_of, help="Print the configuration (`--cfg job`) and do nothing else."),
]
Multirun = Annotated[bool, typer.Option("--multirun", "-m", help="Run every combination of comma-separated values.")]
Resume = Annotated[Path | None, typer.Option(help="Continue an interrupted run, named by its directory.")]
