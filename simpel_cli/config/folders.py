"""Folders that simpel reads besides the user's own: configuration, example data, recordings."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import simpel_cli
from simpel_cli.errors import ConfigError

PACKAGE = Path(simpel_cli.__file__).parent


def conf_dir() -> Path:
    """Return the folder of the built-in configuration: inside the wheel, else the checkout's."""
    inside = PACKAGE / "conf"
    return inside if inside.is_dir() else PACKAGE.parent / "conf"


def example_data_dir() -> Path:
    """Return the folder of the measurements that come with simpel: inside the wheel, else the checkout's."""
    inside = PACKAGE / "example_data"
    return inside if inside.is_dir() else PACKAGE.parent / "data"


def recordings_dir() -> Path:
    """Return the folder of the recordings, there or not: SIMPEL_SHARED, else `shared` beside a checkout."""
    given = os.environ.get("SIMPEL_SHARED")
    return Path(given).expanduser().absolute() if given else PACKAGE.parents[1] / "shared"


def require_recordings(data: Any) -> None:
    """Refuse measurements that lie among the recordings where the recordings' folder is missing.

    Args:
        data: the resolved `data:` node. Anything that is no mapping with paths is left to its own checks.

    Raises:
        ConfigError: names the folder and how to name another.
    """
    folder = recordings_dir()
    paths = data.get("path") if isinstance(data, Mapping) else None
    named = [path for path in (paths if isinstance(paths, list | tuple) else [paths]) if isinstance(path, str)]
    if folder.is_dir() or not any(Path(path).is_relative_to(folder) for path in named):
        return
    given = os.environ.get("SIMPEL_SHARED")
    tried = f"SIMPEL_SHARED is {given!r}, which" if given else f"SIMPEL_SHARED is not set, and {folder}"
    raise ConfigError(
        f"data.path: {tried} is no folder. The recordings do not come with simpel: export SIMPEL_SHARED=FOLDER."
    )
