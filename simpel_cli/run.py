"""What surrounds a computation: settings, device and precision, run directory, named random streams, manifest."""

import contextlib
import hashlib
import json
import os
import platform
import subprocess
import sys
import time
import zlib
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from simpel_cli.errors import ConfigError, Interrupted, SimpelError
from simpel_cli.records import write_text

try:
    import fcntl
except ImportError:  # Windows: two processes in one directory are not told apart there
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    import jax
    from jaxtyping import PRNGKeyArray

PACKAGES = ("simpel", "jax", "jaxlib", "optax", "hydra-core", "omegaconf", "casadi", "mujoco", "numpy", "pyarrow")


@dataclass(frozen=True)
class Settings:
    """The `run:` group of every verb.

    Args:
        name: name of the run in metrics and in the run directory's path.
        seed: random seed of the model; seeds of several runs in one program count up from it.
        seeds: number of seeds that are trained at once.
        precision: `float32` or `float64` for learning (priors' factorisations always run in float64).
        device: `auto`, `cpu` or `gpu`.
        cache: keep compiled programs in the user's cache directory.
        quiet: print errors only.
        figures: draw figures; without them the report has its tables, and a small job of a large sweep ends sooner.
        tensorboard: write scalars for TensorBoard into `tensorboard/` of the run, too.
        plugins: packages of the user's that `_target_` and callables may name.
    """

    name: str = "run"
    seed: int = 0
    seeds: int = 1
    precision: str = "float32"
    device: str = "auto"
    cache: bool = True
    quiet: bool = False
    figures: bool = True
    tensorboard: bool = False
    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.precision not in ("float32", "float64"):
            raise ConfigError(f"run.precision: got {self.precision!r}; allowed are float32 and float64.")
        if self.device not in ("auto", "cpu", "gpu"):
            raise ConfigError(f"run.device: got {self.device!r}; allowed are auto, cpu and gpu.")
        if not 1 <= self.seeds <= 1000:
            raise ConfigError(f"run.seeds: got {self.seeds}; allowed are 1 to 1000.")
        if not 0 <= self.seed < 2**31:
            raise ConfigError(f"run.seed: got {self.seed}; allowed are 0 to 2147483647.")

    @property
    def all_seeds(self) -> list[int]:
        """The seeds of this run."""
        return list(range(self.seed, self.seed + self.seeds))


def configure(settings: Settings) -> "jax.Device":
    """Set up JAX for this process: float64 available, device, persistent compilation cache.

    Returns:
        The device that computations run on.

    Raises:
        ConfigError: `run.device=gpu` and JAX sees none.
    """
    import jax

    # float64 is enabled for factorisations and discovery; learning states its dtype and stays in run.precision
    jax.config.update("jax_enable_x64", True)
    if settings.cache:
        jax.config.update("jax_compilation_cache_dir", str(cache_directory() / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if settings.device == "auto":
        return jax.devices()[0]
    try:
        device = jax.devices(settings.device)[0]
    except RuntimeError as error:
        raise ConfigError(
            f"run.device: got {settings.device}; JAX sees {jax.default_backend()} only. "
            "Use run.device=auto, or install jax[cuda13]."
        ) from error
    jax.config.update("jax_default_device", device)
    return device


def cache_directory() -> Path:
    """Return the user's cache directory for simpel ($XDG_CACHE_HOME/simpel or ~/.cache/simpel)."""
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(root) if root else Path.home() / ".cache") / "simpel"
    except RuntimeError as error:  # no home directory
        raise ConfigError(
            "no home directory: set XDG_CACHE_HOME, or switch the cache off with run.cache=false."
        ) from error


def stream(seed: int, name: str) -> "PRNGKeyArray":
    """Return the random stream `name` of an integer seed; streams of different names are independent."""
    import jax

    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode()))


def typed(path: Path | str) -> str:
    """Return a path as a shell reads it: in quotes where it has blanks."""
    return quote(str(path))


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


RESUMED = ("fit", "rl-offline", "rl-online")  # verbs whose runs can be gone on with
COMPUTED = (
    "checkpoint",
    "*.safetensors",
    "episodes/*.parquet",
)  # of which a run directory has one once it has a result


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


def refuse_occupied(directory: Path, key: str = "hydra.run.dir") -> None:
    """Refuse a directory that holds a run, unless that run failed before anything was computed.

    Raises:
        ConfigError: it holds one.
    """
    if not (directory / "manifest.json").exists():
        return
    record = read_manifest(directory)
    if record.get("status") == "failed" and not any(any(directory.rglob(name)) for name in COMPUTED):
        return
    verb = record["command"]
    go_on = f"Go on with `simpel {verb} --resume {typed(directory)}`, or choose" if verb in RESUMED else "Choose"
    raise ConfigError(f"{key}: {directory} holds a run already. {go_on} another directory; nothing was changed.")


def make_directory(path: Path, key: str = "hydra.run.dir", cure: str = "") -> Path:
    """Create a directory that the key names, and prove that it can be written; the cure is KEY=DIR, or as said.

    Raises:
        ConfigError: it cannot.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigError(
            f"{key}: cannot write to {path} ({error.strerror}). Choose another place: {cure or f'{key}=DIR'}."
        ) from error
    return path


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
