"""Which groups, options and keys there are, from the YAML files alone."""

from pathlib import Path
from typing import Any

from simpel_cli.config.folders import conf_dir
from simpel_cli.errors import ConfigError

CONTROL = ("rl-offline", "rl-online")
# group -> key, of the verbs of control: an experiment brings them, there is no default
BROUGHT = {"reward": "reward", "sim@truth": "truth", "sim@mujoco": "mujoco"}


def options(group: str, config_dir: Path | None = None) -> dict[str, Path]:
    """Return the options of a group by name: simpel's own, and those of a user's folder, which go before."""
    roots = [conf_dir(), user_conf(config_dir)]
    found = {path.stem: path for root in roots if root is not None for path in (root / group).glob("*.yaml")}
    return dict(sorted(found.items()))


def user_conf(config_dir: Path | None) -> Path | None:
    """Return the folder of the user's groups: the given one, or `conf/` inside it.

    Raises:
        ConfigError: it is no folder.
    """
    if config_dir is None:
        return None
    if not config_dir.is_dir():
        raise ConfigError(f"--config-dir: {config_dir} is not a folder. It holds your own groups: sim/, data/, ...")
    folder = config_dir / "conf" if (config_dir / "conf").is_dir() else config_dir
    return folder.resolve()


def group_folder(group: str, choice: str | None, user: Path | None) -> Path:
    """Return the folder of the YAML that a group's choice came from."""
    for root in [user, conf_dir()]:
        if root is not None and choice and (root / group / f"{choice}.yaml").is_file():
            return (root / group / f"{choice}.yaml").parent
    return Path.cwd()


def keys_of_other_verbs(verb: str) -> set[str]:
    """Groups and keys that an experiment may set for another verb that takes experiments: it serves all of them."""
    verbs = [path.stem for path in conf_dir().glob("*.yaml")]
    entries = {other: _entries(other) for other in verbs if other != verb}
    brought = set(BROUGHT.values()) if verb not in CONTROL else set()
    return {key for keys in entries.values() if "experiment" in keys for key in keys} | brought


def top_level(verb: str) -> list[str]:
    """Groups and keys of a root configuration and of those that it builds on."""
    brought = list(BROUGHT.values()) if verb in CONTROL else []
    return [*(name for name in _entries(verb) if name != "experiment"), *brought]


def defaults_of(verb: str) -> dict[str, Any]:
    """Return the groups of a root configuration, and of those that it builds on, with the options that they begin with.

    A key that is no group, and a group that an experiment brings, has None.
    """
    import yaml

    root = yaml.safe_load((conf_dir() / f"{verb}.yaml").read_text())
    entries = root.get("defaults", [])
    found: dict[str, Any] = {}
    for inherited in (e for e in entries if isinstance(e, str) and e != "_self_"):
        found |= defaults_of(inherited)
    for name, option in ((n, o) for e in entries if isinstance(e, dict) for n, o in e.items()):
        plain = name.removeprefix("override ")
        if "/" not in plain:
            found[plain] = option
    return found | {key: None for key in root if key not in ("defaults", "hydra")}


def group_of(key: str) -> str:
    """Return the group of a key such as `sim@truth`, or of the name that such a group is brought under."""
    return next((group for group, name in BROUGHT.items() if name == key), key).partition("@")[0]


def _entries(verb: str) -> list[str]:
    return list(defaults_of(verb))
