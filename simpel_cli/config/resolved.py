"""Configurations that runs keep: written and read back as plain YAML."""

from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError
from simpel_cli.runs.manifest import read_manifest, refuse_older

GROUPS = ("sim", "data", "prior", "score", "method", "choices")  # in every configuration that a run keeps


def load(path: Path) -> dict[str, Any]:
    """Read YAML that a run wrote.

    Raises:
        ConfigError: missing or not YAML.
    """
    import yaml

    try:
        config = yaml.safe_load(path.read_text())
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: missing; the directory is not a run that can be read back.") from error
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: not readable ({str(error).splitlines()[0]}).") from error
    if not isinstance(config, dict):
        raise ConfigError(f"{path}: not a configuration of simpel.")
    return config


def of_run(directory: Path) -> dict[str, Any]:
    """Read the resolved configuration of a run.

    Raises:
        ConfigError: missing, not YAML, cut off, or of another version of simpel.
    """
    refuse_older(directory, read_manifest(directory))
    path = directory / "config.yaml"
    config = load(path)
    if lacking := [group for group in GROUPS if not isinstance(config.get(group), dict)]:
        raise ConfigError(
            f"{path}: damaged or cut off ({', '.join(lacking)} missing). Restore it, or make the run again."
        )
    return config


def dump(config: dict[str, Any]) -> str:
    """Return a resolved configuration as YAML."""
    import yaml

    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
