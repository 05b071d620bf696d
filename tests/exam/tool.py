"""Running `simpel discover` on the files of a set as a user would, many sets in one process so that programs are compiled once.

The tool is given the set's folder and nothing else. What it raises becomes the outcome of that set.
"""

import contextlib
import io
import os
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class Answer(NamedTuple):
    """What became of a run: its directory, seconds of wall time, and the message if it failed."""

    directory: Path
    wall: float
    error: str = ""


def discover(folder: Path, run: str, effects: Sequence[str] = ()) -> Answer:
    """Search in the folder of a set, unless that was done.

    Args:
        folder: with `sim/rig.yaml` and `data/rig.yaml`.
        run: name of the run directory below it.
        effects: names to try; none = the whole catalogue.
    """
    from simpel_cli.main import app

    directory = folder / run
    if (directory / "verdict.json").exists():
        return Answer(directory, float("nan"))
    clear(directory)
    words = [
        "discover",
        "--config-dir",
        str(folder),
        "sim=rig",
        "data=rig",
        "close=false",
        "report=false",
        "run.quiet=true",
    ]
    words += [f"hydra.run.dir='{directory}'"] + ([f"effect=[{','.join(effects)}]"] if effects else [])
    began, here = time.perf_counter(), Path.cwd()
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            app(words, prog_name="simpel", standalone_mode=False)
    except (Exception, SystemExit) as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
        return Answer(directory, time.perf_counter() - began, text[:500])
    finally:
        os.chdir(here)
    if not (directory / "verdict.json").exists():
        return Answer(directory, time.perf_counter() - began, f"no verdict: {said.getvalue().strip()[-300:]}")
    return Answer(directory, time.perf_counter() - began)


def clear(directory: Path) -> None:
    """Remove what an interrupted run left, so that the tool does not refuse the directory."""
    if directory.exists():
        for path in sorted(directory.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        directory.rmdir()
