"""`simpel example DIR`: the folder of a rig, to be changed into one's own."""

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
        raise ConfigError(f"{folder}: is there and not empty. Name a new folder, or an empty one; nothing was changed.")
    make_directory(folder, "DIR")
    shutil.copytree(SOURCE, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    terminal = Terminal(quiet=False)
    terminal.line(f"{folder}/README.md says what is what", "written")
    given = f"--config-dir {typed(folder)}"
    terminal.next(
        (
            f"simpel sims cart {given}          # is that the simulator you meant?",
            f"simpel fit {given} experiment=cart",
            f"simpel discover {given} experiment=cart    # what does it lack?",
        )
    )
