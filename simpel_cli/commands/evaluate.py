"""`simpel evaluate`: a fitted model judged on held-out data, or on a new file."""

from pathlib import Path
from typing import Annotated

import typer

from simpel_cli.commands.options import Cfg, ConfigDir, Overrides
from simpel_cli.commands.starting import launch
from simpel_cli.errors import ConfigError


def evaluate(
    run_dir: Annotated[Path, typer.Argument(help="Directory of a run of fit.")],
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
) -> None:
    """Test a fitted model on its held-out episodes, or on every episode of a new file.

    Examples:
      simpel evaluate runs/fit/pendulum/20261121-101502-3fa9

      simpel evaluate runs/fit/pendulum/20261121-101502-3fa9 --config-dir my data=rig
    """
    if "=" in str(run_dir) and not run_dir.is_dir():
        raise ConfigError(
            f"evaluate: the first word is the directory of a fit, got {run_dir}: simpel evaluate RUN_DIR {run_dir}"
        )
    from simpel_cli.runs.manifest import read_manifest
    from simpel_cli.sweeps.verbs import evaluate as task

    read_manifest(run_dir)
    quoted = str(run_dir).replace("\\", "\\\\").replace("'", "\\'")
    launch("evaluate", task, [f"run_dir='{quoted}'", *(overrides or [])], config_dir, cfg)
