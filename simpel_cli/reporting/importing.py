"""`simpel import`: a first data YAML of files that nobody has described yet, on the screen or in a file."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from simpel_cli.config.build import build_source
from simpel_cli.config.groups import options
from simpel_cli.config.resolved import load
from simpel_cli.data.importing.draft import Draft, draft
from simpel_cli.data.recording import Source
from simpel_cli.errors import ConfigError, did_you_mean
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, typed
from simpel_cli.runs.files import write_text


def import_files(files: Sequence[str], out: Path | None, force: bool, sim: str | None, config_dir: Path | None) -> None:
    """Look at files and write a data YAML.

    Args:
        files: names or patterns.
        out: file of the YAML; None: standard output.
        force: whether it may be there already.
        sim: name of the simulator to compare with; None: none.
        config_dir: folder of the user's groups.

    Raises:
        ConfigError: there is such a file already, or no such simulator.
        DataError: a file is not there, or cannot be read.
    """
    if out is not None:
        _refuse(out, force)
    model = None if sim is None else _simulator(sim, config_dir)
    if out is None:
        sys.stdout.write(draft(files, files, Path.cwd(), model).yaml)
        return
    make_directory(out.parent, "--out", "--out FILE")
    shown = [name if Path(name).expanduser().is_absolute() else os.path.relpath(name, out.parent) for name in files]
    found = draft(files, shown, Path.cwd(), model)
    write_text(out, found.yaml)
    _tell(found, out, sim, config_dir)


def _tell(found: Draft, out: Path, sim: str | None, config_dir: Path | None) -> None:
    terminal = Terminal(quiet=False)
    for label, text in found.lines:
        terminal.line(text, label)
    for question in found.questions:
        terminal.line(question, "question", style="yellow")
    terminal.line(f"{out}   {len(found.questions)} questions to answer in it", "written")
    folder = config_dir or (out.parent.parent if out.parent.name == "data" else None)
    given = f" --config-dir {typed(folder)}" if folder is not None and str(folder) != "." else ""
    if folder is not None:
        terminal.next((f"simpel fit{given} sim={sim or 'NAME'} data={out.stem}",))


def _refuse(out: Path, force: bool) -> None:
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--out: got {out}; a data YAML is named NAME.yaml, e.g. conf/data/rig.yaml.")
    if out.is_dir() or (out.exists() and not force):
        cure = "Name another file." if out.is_dir() else "Name another file, or write over it with --force."
        raise ConfigError(f"--out: {out} is there already; nothing was changed. {cure}")


def _simulator(name: str, config_dir: Path | None) -> Source:
    every = options("sim", config_dir)
    if name not in every:
        raise ConfigError(
            f"sim: got {name}; there is no sim of that name.{did_you_mean(name, list(every))} `simpel sims` lists them."
        )
    source: Source = build_source(load(every[name]), "sim")
    return source
