"""`manifest.json` of a run directory: what ran, on what, with which inputs, and how it ended."""

import contextlib
import hashlib
import json
import platform
import subprocess
import sys
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError, Interrupted, SimpelError
from simpel_cli.runs.files import write_text
from simpel_cli.runs.lock import locked
from simpel_cli.runs.settings import Settings

FORMAT = 2  # of a run directory; 1 had configurations with module paths of before the rooms
PACKAGES = ("simpel", "jax", "jaxlib", "optax", "hydra-core", "omegaconf", "casadi", "mujoco", "numpy", "pyarrow")


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass
class Manifest:
    """`manifest.json` of a run directory: what ran, on what, with which inputs, and how it ended.

    Args:
        directory: the run directory.
        command: verb.
        settings: of the run.
    """

    directory: Path
    command: str
    settings: Settings
    inputs: dict[str, str] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    started: float = field(default_factory=time.monotonic)
    _before: float = (
        0.0  # s of a run that is gone on with, until it was stopped; those until a kill nobody has written down
    )
    _lock: Any = None

    def write(self, status: str, error: str | None = None) -> None:
        """Write the manifest with a status: running, done, interrupted or failed."""
        record = {
            "format": FORMAT,
            "command": self.command,
            "command_line": _command_line(),
            "status": status,
            "error": error,
            "seed": self.settings.seed,
            "seeds": self.settings.seeds,
            "wall_seconds": round(self.wall_seconds, 3),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "git_commit": _git_commit(),
            "python": platform.python_version(),
            "platform": platform.platform(),
            "versions": versions(),
            "inputs_sha256": self.inputs,
            "config_sha256": _sha256_of_config(self.directory),
            **self.facts,
        }
        write_text(self.directory / "manifest.json", json.dumps(record, indent=1, default=str))

    @property
    def wall_seconds(self) -> float:
        """Time at work, with that before a resume."""
        return self._before + time.monotonic() - self.started

    def add_inputs(self, files: "tuple[Path, ...]") -> None:
        """Record the SHA-256 of input files."""
        self.inputs |= {str(f): sha256(f) for f in files}

    def __enter__(self) -> "Manifest":
        self._lock = locked(self.directory)
        try:
            if (self.directory / "manifest.json").exists():
                seconds = read_manifest(self.directory).get("wall_seconds")
                self._before = float(seconds) if isinstance(seconds, int | float) else 0.0
            self.write("running")
        except BaseException:
            self._lock.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            if error is None:
                self.write("done")
            elif isinstance(error, Interrupted | KeyboardInterrupt):
                self.write("interrupted", str(error))
            else:
                text = str(error) if isinstance(error, SimpelError) else f"{type(error).__name__}: {error}"
                with contextlib.suppress(OSError):  # a full disk: the first error is the one to tell
                    self.write("failed", text)
        finally:
            self._lock.close()


def refuse_older(directory: Path, record: dict[str, Any]) -> None:
    """Refuse a run directory whose configuration this version cannot build. Its Parquet files can still be compared.

    Raises:
        ConfigError: with the version that made it.
    """
    if record.get("format", 1) != FORMAT:
        version = (record.get("versions") or {}).get("simpel", "unknown")
        raise ConfigError(
            f"{directory}: made by another version of simpel ({version}, run directory format {record.get('format', 1)}; this "
            f"version reads format {FORMAT}). Make the run again, or use that version."
        )


def read_manifest(directory: Path) -> dict[str, Any]:
    """Read `manifest.json` of a run directory.

    Raises:
        ConfigError: it is missing or not readable, so the directory is not a run.
    """
    path = directory / "manifest.json"
    try:
        record = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise ConfigError(
            f"{directory}: not a run directory (it has no manifest.json). Run directories lie under runs/."
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not readable ({error}).") from error
    if not isinstance(record, dict) or "command" not in record:
        raise ConfigError(f"{path}: not a manifest of simpel (no key `command`).")
    return record


def refuse_changed_config(directory: Path, record: dict[str, Any]) -> None:
    """Refuse to go on with a run whose configuration is not the one that it was begun with: cut off, or edited.

    Raises:
        ConfigError: it is another one.
    """
    kept = record.get("config_sha256")
    if kept is not None and kept != _sha256_of_config(directory):
        raise ConfigError(
            f"{directory / 'config.yaml'}: not as it was when the run began (damaged, or edited). Restore it; for other "
            "settings start a new run."
        )


def _sha256_of_config(directory: Path) -> str | None:
    path = directory / "config.yaml"
    return sha256(path) if path.is_file() else None


def _command_line() -> str:
    """Return what was typed; while Hydra composes, the words stand behind the verb in place of the program."""
    words = [word.removeprefix("++") for word in sys.argv]
    return " ".join(["simpel", *(words if words and "/" not in words[0] else words[1:])])


def versions() -> dict[str, str | None]:
    """Return the versions of the packages that numbers depend on; None: not installed as a package."""
    return {name: _version(name) for name in PACKAGES}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    try:
        answer = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() or None
