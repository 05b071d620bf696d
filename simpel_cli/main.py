"""The command line: registers the verbs. Nothing heavy is imported here, so that `simpel --help` answers at once."""

import atexit
import gc
from typing import Annotated

import typer

from simpel_cli.commands.discover import discover
from simpel_cli.commands.doctor import doctor
from simpel_cli.commands.effects import effects
from simpel_cli.commands.evaluate import evaluate
from simpel_cli.commands.example import example
from simpel_cli.commands.exit_codes import run
from simpel_cli.commands.export import export
from simpel_cli.commands.fit import fit
from simpel_cli.commands.import_ import import_
from simpel_cli.commands.report import report
from simpel_cli.commands.rl_offline import rl_offline
from simpel_cli.commands.rl_online import rl_online
from simpel_cli.commands.schema import schema
from simpel_cli.commands.sims import sims
from simpel_cli.commands.simulate import simulate
from simpel_cli.commands.sweep import sweep

# at the end Python looks for cycles among all that JAX has made, for nothing: of a fit's 9 s, the last 0.8
atexit.register(gc.freeze)

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
        bool | None, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = None,
) -> None:
    """Accurate models and control policies from a rough simulator and a few measurements.

    Start with `simpel doctor` and `simpel fit experiment=pendulum`. Every verb has `--help` with examples.
    """


for verb in (
    fit, evaluate, discover, rl_offline, rl_online, sweep, report, export, import_, sims, effects, example, doctor, simulate,
    schema,
):  # fmt: skip
    app.command(verb.__name__.strip("_").replace("_", "-"))(verb)  # `import_`: import is a word of Python's


def main() -> None:
    """Entry point: run the command line and turn errors into one message and an exit code."""
    run(app)


if __name__ == "__main__":
    main()
