"""`simpel discover`: what the simulator lacks."""

from functools import partial
from typing import Annotated

import typer

from simpel_cli.commands.options import Cfg, ConfigDir, Multirun, Overrides
from simpel_cli.commands.starting import launch


def discover(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with code 5 unless the verdict is `effect`.")] = False,
) -> None:
    r"""Find the physical effect that the simulator lacks, add it, and report the error before and after.

    Examples:
      simpel discover experiment=hidden_pendulum

      simpel discover --config-dir my sim=rig data=rig 'effect=\[viscous_friction,coulomb_friction,input_delay]'
    """
    from simpel_cli.sweeps.verbs import discover as task

    launch("discover", partial(task, strict=strict), overrides, config_dir, cfg, multirun)
