"""The command line: Typer collects words, Hydra composes them, a command of `simpel_cli.commands` does the work.

Nothing heavy is imported at module level, so that `simpel --help` answers at once.
"""

import atexit
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from simpel_cli.errors import ConfigError, Interrupted, SimpelError
from simpel_cli.runs.interruption import never_lost

if TYPE_CHECKING:
    from simpel_cli.config.launch import Job

# at the end Python looks for cycles among all that JAX has made, for nothing: of a fit's 9 s, the last 0.8
atexit.register(gc.freeze)

UsageError: type[Exception] = typer.BadParameter.__bases__[0]  # Typer exports the special case only

app = typer.Typer(
    add_completion=True,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool | None) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"simpel {version('simpel')}")
        raise typer.Exit


@app.callback()
def _simpel(
    version: Annotated[
        bool | None, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")
    ] = None,
) -> None:
    """Simulation priors for data-efficient learning: fit, judge and compare Bayesian models of measured systems."""


def _completed(context: typer.Context, incomplete: str) -> list[str]:
    from simpel_cli.config.completion import overrides

    return overrides(context, incomplete)


def _option_of(group: str) -> Callable[[typer.Context, str], list[str]]:
    def complete(context: typer.Context, incomplete: str) -> list[str]:
        from simpel_cli.config.groups import options

        return [name for name in options(group, context.params.get("config_dir")) if name.startswith(incomplete)]

    return complete


Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="KEY=VALUE...", help="Groups and keys, as Hydra overrides.", autocompletion=_completed),
]
ConfigDir = Annotated[
    Path | None,
    typer.Option("--config-dir", "-cd", help="Folder with groups of your own: sim/, data/, experiment/, ..."),
]


def _one_of(value: str | None) -> str | None:
    if value not in (None, "job", "hydra", "all"):
        raise typer.BadParameter(f"got {value!r}; allowed are job, hydra and all.")
    return value


Cfg = Annotated[
    str | None,
    typer.Option("--cfg", callback=_one_of, help="Print the composed configuration (`--cfg job`) and do nothing."),
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
    if resume is not None:
        _refuse_more(resume, overrides, config_dir, cfg, multirun)
        from simpel_cli.commands.fit import resume as go_on

        go_on(resume)
    else:
        from simpel_cli.commands.fit import fit as task

        _launch("fit", task, overrides, config_dir, cfg, multirun)


@app.command()
def evaluate(
    run_dir: Annotated[Path, typer.Argument(help="Directory of a fit.")],
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
) -> None:
    """Judge a fitted model on its held-out episodes, or on all of a new file.

    Examples:
      simpel evaluate runs/fit/pendulum/20261121-101502-3fa9

      simpel evaluate runs/fit/pendulum/20261121-101502-3fa9 --config-dir my data=rig
    """
    if "=" in str(run_dir) and not run_dir.is_dir():
        raise ConfigError(
            f"evaluate: the first word is the directory of a fit, got {run_dir}: simpel evaluate RUN_DIR {run_dir}"
        )
    from simpel_cli.commands.evaluate import evaluate as task
    from simpel_cli.runs.manifest import read_manifest

    read_manifest(run_dir)
    quoted = str(run_dir).replace("\\", "\\\\").replace("'", "\\'")
    _launch("evaluate", task, [f"run_dir='{quoted}'", *(overrides or [])], config_dir, cfg)


@app.command()
def discover(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 5 unless the verdict is `effect`.")] = False,
) -> None:
    """Find what the simulator leaves unexplained, name the cause, add it, and report the error before and after.

    Examples:
      simpel discover experiment=hidden_pendulum

      simpel discover --config-dir my sim=rig data=rig effect=[viscous_friction,coulomb_friction,input_delay]
    """
    from functools import partial

    from simpel_cli.commands.discover import discover as task

    _launch("discover", partial(task, strict=strict), overrides, config_dir, cfg, multirun)


@app.command("rl-offline")
def rl_offline(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    resume: Annotated[Path | None, typer.Option(help="Go on with an interrupted run.")] = None,
) -> None:
    """Learn a policy in a model that was fitted to measurements, and judge it in the true world.

    Examples:
      simpel rl-offline experiment=rc_car_parking data.n_train=200

      simpel rl-offline --config-dir my sim=rig data=rig reward=my_task sim@truth=rig_as_i_know_it
    """
    if resume is not None:
        _refuse_more(resume, overrides, config_dir, cfg, multirun)
        from simpel_cli.commands.rl_offline import resume as go_on

        go_on(resume)
    else:
        from simpel_cli.commands.rl_offline import rl_offline as task

        _launch("rl-offline", task, overrides, config_dir, cfg, multirun)


@app.command("rl-online")
def rl_online(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    resume: Annotated[Path | None, typer.Option(help="Go on with an interrupted run.")] = None,
) -> None:
    """Act, measure, learn a model and a policy, act again, without data to begin with.

    Examples:
      simpel rl-online experiment=rc_car_parking online.episodes=10

      simpel rl-online --config-dir my sim=rig reward=my_task world=folder:exchange

      simpel rl-online --resume runs/rl-online/rig/20261121-101502-3fa9 online.episodes=20
    """
    if resume is not None:
        _refuse_more(resume, config_dir, cfg, multirun)
        from simpel_cli.commands.rl_online import resume as go_on

        go_on(resume, overrides or [])
    else:
        from simpel_cli.commands.rl_online import rl_online as task

        _launch("rl-online", task, overrides, config_dir, cfg, multirun)


@app.command()
def sweep(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    resume: Annotated[Path | None, typer.Option(help="Run what is missing or failed of a sweep.")] = None,
) -> None:
    """Fit every combination of values and collect the results; other verbs sweep with -m.

    Examples:
      simpel sweep experiment=pendulum method=simpel,fsvgd data.n_train=10,20,40 'run.seed=range(3)'

      simpel sweep --config-dir my sim=rig data=rig data.n_train=20,80 'run.seed=range(5)'

      simpel sweep experiment=pendulum 'run.seed=range(100)' hydra.launcher.address=tcp://cluster:8786

      simpel sweep --resume runs/sweep/pendulum/20261121-101502-3fa9
    """
    if resume is not None:
        _refuse_more(resume, config_dir, cfg)
        from simpel_cli.commands.sweep import resume as go_on

        go_on(resume, overrides or [])
    else:
        _launch("fit", None, overrides, config_dir, cfg, multirun=True)


@app.command()
def report(
    directories: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Runs, sweeps, or folders of them.")],
    out: Annotated[Path | None, typer.Option(help="Left out: the sweep itself, else a folder in runs/report.")] = None,
    baseline: Annotated[str | None, typer.Option(help="Method that the others are compared with.")] = None,
) -> None:
    """Compare runs and sweeps: one HTML file, LaTeX and CSV tables.

    Examples:
      simpel report runs/sweep/pendulum/20261121-101502-3fa9

      simpel report runs/fit/pendulum/* --baseline fsvgd --out comparison
    """
    from simpel_cli.reporting.compare_runs import default_folder
    from simpel_cli.reporting.compare_runs import report as task

    task(directories, out or default_folder(directories), baseline)


@app.command()
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
    from simpel_cli.commands.export import export as task

    task(run_dir, out, seed)


@app.command()
def sims(
    name: Annotated[
        str | None, typer.Argument(help="Show one, with ranges and equations.", autocompletion=_option_of("sim"))
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """List the simulators with their units."""
    from simpel_cli.reporting.catalogue import sims as task

    task(name, config_dir)


@app.command()
def effects(
    name: Annotated[
        str | None, typer.Argument(help="Show one, with its parameters.", autocompletion=_option_of("effect"))
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """List the effects that `discover` can find, with their formulas."""
    from simpel_cli.reporting.catalogue import effects as task

    task(name, config_dir)


@app.command()
def example(
    folder: Annotated[Path, typer.Argument(help="A new or empty folder.")],
) -> None:
    """Write the folder of a rig, to be changed into your own: simulator, measurements, effect, task, experiment.

    Examples:
      simpel example my
    """
    from simpel_cli.commands.example import example as task

    task(folder)


@app.command()
def doctor() -> None:
    """Tell what this installation has, and test in a few seconds whether it computes right."""
    from simpel_cli.reporting.doctor import doctor as task

    task()


@app.command()
def simulate(overrides: Overrides = None, config_dir: ConfigDir = None, cfg: Cfg = None) -> None:
    """Turn a simulator or a MuJoCo world into measurements: Parquet and card.

    Examples:
      simpel simulate sim=pendulum_world out=data/pendulum

      simpel simulate --config-dir my sim=rig simulation.episodes=20 simulation.seed=1 out=my/data/rig
    """
    from simpel_cli.commands.simulate import simulate as task

    _launch("simulate", task, overrides, config_dir, cfg)


def _refuse_more(resume: Path, *given: object) -> None:
    if any(given):
        raise ConfigError(
            "--resume: a resumed run takes nothing else; its configuration is in "
            f"{resume / 'config.yaml'}. For other settings start a new run."
        )


def _launch(
    verb: str,
    task: Callable[["Job"], None] | None,
    overrides: list[str] | None,
    config_dir: Path | None,
    cfg: str | None,
    multirun: bool = False,
) -> None:
    if multirun or task is None:
        from simpel_cli.commands.sweep import sweep as every

        every(verb, overrides or [], config_dir, cfg)
        return
    from simpel_cli.config.launch import launch

    launch(verb, task, overrides or [], config_dir=config_dir, flags=["--cfg", cfg] if cfg else [])


def main() -> None:
    """Entry point: run the command line and turn errors into one message and an exit code."""
    try:
        # not standalone: errors come to us, so that they are one line each and an interrupt has its exit code
        with never_lost():
            code = app(sys.argv[1:] or ["--help"], prog_name="simpel", standalone_mode=False)
        if code == Interrupted.exit_code:  # Typer makes this of Ctrl-C
            raise typer.Abort
        sys.exit(code)
    except SimpelError as error:
        _fail(str(error), error.exit_code)
    except typer.Abort:
        _fail("interrupted.", Interrupted.exit_code)
    except UsageError as error:
        message = cast(typer.BadParameter, error).format_message()
        end = "" if message.endswith((".", "?")) else "."
        _fail(f"{message}{end} See `{_command_path(error)} --help`.", ConfigError.exit_code)
    except BrokenPipeError:
        # the reader of `--cfg` went away: end quietly, as other tools do (a run goes on, see `Terminal`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        _fail(_of_the_disk(error), 1)


def _of_the_disk(error: OSError) -> str:
    """Say what the system does not allow; anything else is a fault of ours, and shows where."""
    import errno

    if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO):
        raise error
    where = f"{error.filename}: " if error.filename else ""
    return (
        f"{where}{error.strerror}. What was complete before is kept; make room or give another place (hydra.run.dir=DIR), and "
        "go on with --resume where the run has begun."
    )


def _command_path(error: Exception) -> str:
    context = cast(typer.BadParameter, error).ctx
    return context.command_path if context is not None else "simpel"


def _fail(message: str, code: int) -> None:
    label = "stopped" if code == 130 else "error"
    sys.stderr.write(f"{label}: {message}\n")
    sys.exit(code)


if __name__ == "__main__":
    main()
