"""`simpel export`: files of a run for CasADi, C and numpy."""

from pathlib import Path
from typing import Annotated

import typer


def export(
    run_dir: Annotated[Path, typer.Argument(help="Directory of a run of fit, discover or rl-offline.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the files. Default: export/ in the run directory.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed to export, of a run with several. Default: the first.")] = None,
) -> None:
    """Write the files that a rig needs: the simulator for CasADi and C, the networks for numpy.

    Examples:
      simpel export runs/discover/hidden_pendulum/20261121-101502-3fa9

      simpel export runs/fit/pendulum/20261121-101502-3fa9 --out rig/model
    """
    from simpel_cli.export.run import export as task

    task(run_dir, out, seed)
