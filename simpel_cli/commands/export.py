"""`simpel export`: files of a run for CasADi, C and numpy."""

from pathlib import Path
from typing import Annotated

import typer


def export(
    run_dir: Annotated[Path, typer.Argument(help="Directory of a fit, a discovery or an offline policy.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the files; left out: export/ in the run's own.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of several that the run has fitted.")] = None,
) -> None:
    """Write the simulator for CasADi and C, and the networks for numpy.

    Examples:
      simpel export runs/discover/hidden_pendulum/20261121-101502-3fa9

      simpel export runs/fit/pendulum/20261121-101502-3fa9 --out rig/model
    """
    from simpel_cli.export.run import export as task

    task(run_dir, out, seed)
