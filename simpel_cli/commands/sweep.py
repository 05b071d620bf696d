"""`simpel sweep`: a fit for every combination of values."""

from pathlib import Path
from typing import Annotated

import typer

from simpel_cli.commands.options import Cfg, ConfigDir, Overrides
from simpel_cli.commands.starting import refuse_more


def sweep(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    resume: Annotated[
        Path | None, typer.Option(help="Continue a sweep: run the jobs that are missing or failed.")
    ] = None,
) -> None:
    """Fit every combination of values on all cores or a cluster, and collect the results. Other verbs sweep with -m.

    Examples:
      simpel sweep experiment=pendulum method=simpel,fsvgd data.n_train=10,20,40 'run.seed=range(3)'

      simpel sweep --config-dir my sim=rig data=rig data.n_train=20,80 'run.seed=range(5)'

      simpel sweep experiment=pendulum 'run.seed=range(100)' hydra.launcher.address=tcp://cluster:8786

      simpel sweep --resume runs/sweep/pendulum/20261121-101502-3fa9
    """
    if resume is not None:
        refuse_more(resume, config_dir, cfg)
        from simpel_cli.sweeps.sweep import resume as go_on

        go_on(resume, overrides or [])
    else:
        from simpel_cli.sweeps.sweep import sweep as task

        task("fit", overrides or [], config_dir, cfg)
