"""`simpel example DIR`: a complete example folder, to be adapted to a rig."""

import shutil
from pathlib import Path

from simpel_cli.errors import ConfigError
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, typed

SOURCE = Path(__file__).parents[1] / "example"


def example(folder: Path) -> None:
    """Write the example into a folder that is new or empty.

    Raises:
        ConfigError: the folder has something in it, or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(
            f"{folder}: exists and is not empty. Name a new folder, or an empty one; nothing was changed."
        )
    make_directory(folder, "DIR")
    shutil.copytree(SOURCE, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    terminal = Terminal(quiet=False)
    terminal.line(f"{folder}/README.md explains every file", "written")
    given = f"--config-dir {typed(folder)}"
    terminal.next(
        (
            f"simpel sims cart {given}          # shows the simulator",
            f"simpel fit {given} experiment=cart",
            f"simpel discover {given} experiment=cart    # searches for missing effects",
        )
    )
