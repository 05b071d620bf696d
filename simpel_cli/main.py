"""The command line: Typer collects words, Hydra composes them, a command of `simpel_cli.commands` does the work.

Nothing heavy is imported at module level, so that `simpel --help` answers at once.
"""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from simpel_cli.errors import SimpelError

app = typer.Typer(
    add_completion=True,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Simulation priors for data-efficient learning: fit, judge and compare Bayesian models of measured systems.",
)

Overrides = Annotated[
    list[str] | None, typer.Argument(metavar="KEY=VALUE...", help="Groups and keys, as Hydra overrides.")
]
ConfigDir = Annotated[
    Path | None,
    typer.Option("--config-dir", "-cd", help="Folder with groups of your own: sim/, data/, experiment/, ..."),
]
Cfg = Annotated[
    str | None, typer.Option("--cfg", help="Print the composed configuration (`--cfg job`) and do nothing.")
]
Multirun = Annotated[bool, typer.Option("--multirun", "-m", help="Run every combination of comma-separated values.")]


@app.command()
def fit(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    resume: Annotated[Path | None, typer.Option(help="Go on with an interrupted run.")] = None,
) -> None:
    """Fit a model to measured transitions, with a simulator as prior.

    Examples:
      simpel fit experiment=pendulum

      simpel fit --config-dir my sim=rig data=rig data.n_train=50 run.seeds=5
    """
    from simpel_cli.commands import fit as command

    if resume is not None:
        if overrides:
            raise typer.BadParameter("a resumed run takes no overrides; its configuration is in RUN_DIR/config.yaml")
        command.resume(resume)
        return
    _launch("fit", command.fit, overrides, config_dir, cfg, ["-m"] if multirun else [])


@app.command()
def evaluate(
    run_dir: Annotated[Path, typer.Argument(help="Directory of a fit.")],
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
) -> None:
    """Judge a fitted model on held-out or other measurements.

    Examples:
      simpel evaluate runs/fit/pendulum/20261121-101502-3fa9

      simpel evaluate runs/fit/pendulum/20261121-101502-3fa9 --config-dir my data=rig
    """
    from simpel_cli.commands import evaluate as command

    words = [f"run_dir='{run_dir}'", *(overrides or [])]
    _launch("evaluate", command.evaluate, words, config_dir, cfg, [])


@app.command()
def sweep(overrides: Overrides = None, config_dir: ConfigDir = None, cfg: Cfg = None) -> None:
    """Fit every combination of values and collect the results.

    Examples:
      simpel sweep experiment=pendulum method=simpel,fsvgd data.n_train=10,20,40 'run.seed=range(3)'

      simpel sweep --config-dir my sim=rig data=rig data.n_train=20,80 'run.seed=range(5)'
    """
    from simpel_cli.commands import sweep as command

    command.sweep(overrides or [], config_dir, cfg)


@app.command()
def simulate(overrides: Overrides = None, config_dir: ConfigDir = None, cfg: Cfg = None) -> None:
    """Turn a simulator or a MuJoCo world into measurements: Parquet and card.

    Examples:
      simpel simulate sim=pendulum_world out=data/pendulum

      simpel simulate --config-dir my sim=rig simulation.episodes=20 simulation.seed=1 out=my/data/rig
    """
    from simpel_cli.commands import simulate as command

    _launch("simulate", command.simulate, overrides, config_dir, cfg, [])


def _launch(verb, task, overrides, config_dir, cfg, flags) -> None:  # type: ignore[no-untyped-def]
    from simpel_cli.config import launch

    launch(verb, task, overrides or [], config_dir=config_dir, flags=[*flags, *(["--cfg", cfg] if cfg else [])])


def main() -> None:
    """Entry point: run the command line and turn errors into one message and an exit code."""
    try:
        app(standalone_mode=True)
    except SimpelError as error:
        _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        _fail("interrupted.", 130)
    except BrokenPipeError:
        # the reader of our output went away (`simpel fit | head`): end quietly, as other tools do
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _fail(message: str, code: int) -> None:
    label = "stopped" if code == 130 else "error"
    sys.stderr.write(f"{label}: {message}\n")
    sys.exit(code)


if __name__ == "__main__":
    main()
