"""`simpel import`: a first data YAML of files that nobody has described yet."""

from pathlib import Path
from typing import Annotated

import typer

from simpel_cli.commands.options import ConfigDir, option_of
from simpel_cli.errors import ConfigError


def import_(
    files: Annotated[
        list[str],
        typer.Argument(metavar="FILE...", help="Measurements: files, or a pattern in quotes ('runs/*.csv')."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Write the YAML here, e.g. my/data/rig.yaml. Default: print it.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write over a file that is there already.")] = False,
    sim: Annotated[
        str | None,
        typer.Option(
            help="Simulator whose quantities the columns are; sim=NAME does, too.", autocompletion=option_of("sim")
        ),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """Look at files of measurements and write a first data YAML: what is sure as keys, what is not as questions.

    Examples:
      simpel import run.csv

      simpel import 'runs/*/mass{mass}_*.csv' --config-dir my sim=rig --out my/data/rig.yaml
    """
    words = [word for word in files if word.startswith("sim=")]
    named = [word.removeprefix("sim=") for word in words] + ([sim] if sim is not None else [])
    if len(set(named)) > 1:
        raise ConfigError(f"sim: got {' and '.join(named)}; the columns can be compared with one simulator only.")
    paths = [word for word in files if word not in words]
    if not paths:
        raise ConfigError("import: no file is named. simpel import FILE... sim=NAME")
    from simpel_cli.reporting.importing import import_files

    import_files(paths, out, force, next(iter(named), None), config_dir)
