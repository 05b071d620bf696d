"""Run directories: made, proved writable, and never shared by two runs."""

from pathlib import Path
from shlex import quote

from simpel_cli.errors import ConfigError
from simpel_cli.runs.manifest import read_manifest

RESUMED = ("fit", "rl-offline", "rl-online")  # verbs whose runs can be resumed
COMPUTED = ("checkpoint", "*.safetensors", "episodes/*.parquet")  # a run directory has one of them once it has a result


def typed(path: Path | str) -> str:
    """Return a path as a shell reads it: in quotes where it has blanks."""
    return quote(str(path))


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
