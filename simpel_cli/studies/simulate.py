"""A simulator or a MuJoCo world becomes measurements, Parquet and card: the work of `simpel simulate`."""

from pathlib import Path

from simpel_cli.config.compose import Job
from simpel_cli.config.resolved import dump
from simpel_cli.errors import ConfigError
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, refuse_occupied
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.manifest import Manifest
from simpel_cli.studies.declared import declare


def simulate(job: Job) -> None:
    """Simulate and write `measurements.parquet` and `card.yaml`."""
    declared = declare(job.config)
    out = job.config["out"]
    refuse_occupied(job.directory)
    directory = make_directory(Path(out) if out else job.directory, "out" if out else "hydra.run.dir")
    path = directory / "measurements.parquet"
    if path.exists():
        raise ConfigError(f"out: {path} exists; remove it, or choose another folder. Nothing was changed.")
    terminal = Terminal(declared.settings.quiet)
    with Manifest(make_directory(job.directory), "simulate", declared.settings):
        try:
            made = declared.groups["simulation"].run(declared.source)
        except ValueError as error:  # simulators.model.ModelError
            raise ConfigError(str(error)) from error
        write_table(path, made.columns)
        write_text(directory / "card.yaml", dump(made.card))
    rows = len(next(iter(made.columns.values())))
    terminal.line(f"{path}   {rows} rows: {', '.join(made.columns)}", "data")
    terminal.line(str(directory / "card.yaml"), "card")
