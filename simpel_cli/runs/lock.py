"""One process at a time in a directory."""

import os
import platform
from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError

try:
    import fcntl
except ImportError:  # Windows: two processes in one directory are not detected there
    fcntl = None  # type: ignore[assignment]


def locked(directory: Path) -> Any:
    """Take a directory for this process; it is free again when what is returned is closed, or the process ends.

    Raises:
        ConfigError: another process works in it.
    """
    file = (directory / ".lock").open("a+")
    if fcntl is None:  # pragma: no cover
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.seek(0)
        who = file.read().strip() or "another process"
        file.close()
        raise ConfigError(
            f"{directory}: {who} is at work there. Wait until it ends, or stop it; nothing was changed."
        ) from error
    file.truncate(0)
    file.write(f"process {os.getpid()} on {platform.node()}")
    file.flush()
    return file


def is_locked(directory: Path) -> bool:
    """Return whether a process is at work in a directory."""
    if not (directory / ".lock").exists():
        return False
    try:
        locked(directory).close()
    except ConfigError:
        return True
    return False
