"""Composition and launch: the words of a command line become jobs, each with one resolved configuration.

Hydra composes and starts; it stays behind this module, whose callers see plain dictionaries.
"""

import contextlib
import math
import os
import re
import secrets
import sys
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError
from simpel_cli.hydra_errors import translated, unknown_root
from simpel_cli.places import conf_dir, example_data_dir, recordings_dir, require_recordings
from simpel_cli.runs.directory import refuse_occupied

CONTROL = ("rl-offline", "rl-online")
# group -> key, of the verbs of control: an experiment brings them, there is no default
BROUGHT = {"reward": "reward", "sim@truth": "truth", "sim@mujoco": "mujoco"}
GROUPS = ("sim", "data", "prior", "score", "method", "choices")  # in every configuration that a run keeps


class Job(typing.NamedTuple):
    """One composed, resolved configuration."""

    config: dict[str, Any]
    directory: Path
    data_folder: Path  # folder of the data YAML: relative paths of measurements start there
    words: str = ""  # the overrides that tell this job from the others of a sweep
    given: tuple[str, ...] = ()  # all overrides, as typed
    verb: str = "fit"
    sweep: Path | None = None  # directory of the sweep that it is a job of
    launcher: dict[str, Any] = {}  # noqa: RUF012  options of the sweep's launcher


class _Stopped(BaseException):
    """Carries what a task raised past Hydra, which would print a line of its own and go on with a multirun."""


def launch(
    verb: str, task: Callable[[Job], Any], overrides: list[str], *, config_dir: Path | None, flags: Sequence[str] = ()
) -> None:
    """Compose `conf/<verb>.yaml` with overrides and run `task`; multirun, `--cfg job` and launchers are Hydra's.

    Args:
        verb: name of the root config.
        task: called with every composed job.
        overrides: `key=value` words. A dotted key may add what YAML leaves out: the dataclasses are the schema.
        config_dir: folder with the user's own groups (`sim/`, `data/`, ...), or one that has them under `conf/`.
        flags: flags for Hydra, e.g. `--cfg job` or `-m`.

    Raises:
        ConfigError: what the user wrote does not compose.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from simpel_cli import launcher

    words = checked(_appended(verb, overrides))
    user = _user_conf(config_dir)
    if "--cfg" not in flags:
        _refuse_other_runs(overrides)
    register_resolvers()
    launcher.register()
    known, swept = _top_level(verb), swept_keys(overrides)
    typed = {word.lstrip("+~").partition("=")[0].partition(".")[0] for word in overrides}

    def entry(config: Any) -> Any:
        if not OmegaConf.has_resolver("run_id"):  # a launcher has carried this to another process
            register_resolvers()
        try:
            hydra_config = HydraConfig.get()
            plain = typing.cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
            for key in [k for k in plain if k not in known]:
                if key not in _of_other_verbs(verb) or key in typed:
                    raise ConfigError(unknown_root(str(key), verb, known))
                del plain[key]
            folder = _group_folder("data", hydra_config.runtime.choices.get("data"), user)
            require_recordings(plain.get("data"))
            directory = Path(hydra_config.runtime.output_dir)
            if config_dir is not None and "choices" in plain:
                plain["choices"]["config_dir"] = str(config_dir)  # for the commands that a run ends with
            given = [w.removeprefix("++") for w in hydra_config.overrides.task]
            told = " ".join(w for w in given if w.partition("=")[0] in swept)
            sweep = launching = None
            if hydra_config.mode is not None and hydra_config.mode.name == "MULTIRUN":
                sweep = Path(hydra_config.sweep.dir).absolute()
                launching = {k: v for k, v in (hydra_config.launcher or {}).items() if k != "_target_"}
            return task(
                Job(
                    plain,
                    directory,
                    folder,
                    told,
                    tuple(given),
                    "fit" if verb == "sweep" else verb,
                    sweep,
                    launching or {},
                )
            )
        except Exception as error:
            raise _Stopped from error

    failure: BaseException | None = None
    before, sys.argv = sys.argv, [verb, *words, *flags, *(["--config-dir", str(user)] if user else [])]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach us as exceptions, not as Hydra's printout
    try:
        with _mode_of_flags() if value_of("hydra.mode", overrides) is None else contextlib.nullcontext():
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=verb)(entry)()
    except _Stopped as stopped:
        failure = translated(stopped.__cause__, verb, known, [*([user] if user else []), conf_dir()], own=False)
    except Exception as error:
        failure = translated(error, verb, known, [*([user] if user else []), conf_dir()], own=True)
    finally:
        sys.argv = before
    if failure is not None:  # raised here, so that no traceback shows our detour
        raise failure


@contextlib.contextmanager
def _mode_of_flags() -> Iterator[None]:
    """Hydra composes everything twice, first for `hydra.mode` alone: 0.3 s of every start. Flags say it as well."""
    from hydra._internal.hydra import Hydra

    before = Hydra.get_mode
    Hydra.get_mode = lambda *_, **__: None
    try:
        yield
    finally:
        Hydra.get_mode = before


def count_jobs(overrides: list[str]) -> int:
    """Return the number of jobs of a multirun.

    Raises:
        ConfigError: an override is not of the form key=value.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(checked(overrides))
    return math.prod(sum(1 for _ in o.sweep_iterator()) for o in parsed if o.is_sweep_override())


def first_job(overrides: list[str]) -> list[str]:
    """Return the overrides of the first job of a multirun."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(checked(overrides))
    return [
        f"{o.get_key_element()}={next(iter(o.sweep_string_iterator()))}" if o.is_sweep_override() else word
        for word, o in zip(overrides, parsed, strict=True)
    ]


def value_of(key: str, overrides: list[str]) -> str | None:
    """Return the text that the last override of a key gives it; None: there is none."""
    found = [re.fullmatch(rf"\+*{re.escape(key)}=(['\"]?)(.*)\1", word) for word in overrides]
    return next((match[2] for match in reversed(found) if match), None)


def sweep_directory() -> Path | None:
    """Return the directory of the multirun that this process has started last."""
    from simpel_cli import launcher

    return launcher.directories[-1] if launcher.directories else None


def swept_keys(overrides: list[str]) -> set[str]:
    """Return the keys to which a multirun gives several values."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(checked(overrides))
    return {o.key_or_group for o in parsed if o.is_sweep_override()}


def checked(overrides: list[str]) -> list[str]:
    """Return the overrides as Hydra takes them.

    Raises:
        ConfigError: one is not of the form key=value.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    words = [_force(o) for o in overrides]
    for given, word in zip(overrides, words, strict=True):
        key, sign, value = given.partition("=")
        if not given.startswith("~") and (not sign or not key or key != key.strip() or value != value.lstrip()):
            raise ConfigError(
                f"{given}: not of the form key=value, without blanks around the sign, e.g. method.steps=2000 or "
                "method=fsvgd."
            )
        try:
            OverridesParser.create().parse_override(word)
        except HydraException as error:
            raise ConfigError(
                f"{given}: the value cannot be read. A list is written [1,2]; text with brackets, commas or quotes "
                f"goes into quotes of its own, twice because of the shell: '{key}=\"{value}\"'."
            ) from error
    return words


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
        ConfigError: missing, not YAML, or cut off.
    """
    path = directory / "config.yaml"
    config = load(path)
    if lacking := [group for group in GROUPS if not isinstance(config.get(group), dict)]:
        raise ConfigError(
            f"{path}: damaged or cut off ({', '.join(lacking)} missing). Restore it, or make the run again."
        )
    return config


def options(group: str, config_dir: Path | None = None) -> dict[str, Path]:
    """Return the options of a group by name: simpel's own, and those of a user's folder, which go before."""
    roots = [conf_dir(), _user_conf(config_dir)]
    found = {path.stem: path for root in roots if root is not None for path in (root / group).glob("*.yaml")}
    return dict(sorted(found.items()))


def dump(config: dict[str, Any]) -> str:
    """Return a resolved configuration as YAML."""
    import yaml

    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True)


def register_resolvers() -> None:
    """Make `${simpel_data:}`, `${simpel_shared:}` (measurements) and `${run_id:}` (a new hash per launch) available."""
    from omegaconf import OmegaConf

    run_id = secrets.token_hex(3)  # two starts in one second must never share a run directory

    OmegaConf.register_new_resolver("simpel_data", lambda: str(example_data_dir()), replace=True)
    OmegaConf.register_new_resolver("simpel_shared", lambda: str(recordings_dir()), replace=True)
    OmegaConf.register_new_resolver("run_id", lambda: run_id, replace=True)


def _appended(verb: str, overrides: list[str]) -> list[str]:
    """Say `+group=` for a group that an experiment would bring, where there is none to bring it."""
    if verb not in CONTROL or any(word.startswith("experiment=") for word in overrides):
        return overrides
    return [f"+{word}" if word.partition("=")[0] in BROUGHT else word for word in overrides]


def _force(override: str) -> str:
    """Let `a.b=c` set what the YAML leaves out; `nodes.build` then tells a field from a typo."""
    return f"++{override}" if re.match(r"(?!hydra\.)[A-Za-z_]\w*(\.[\w\[\]]+)+=", override) else override


def _user_conf(config_dir: Path | None) -> Path | None:
    if config_dir is None:
        return None
    if not config_dir.is_dir():
        raise ConfigError(f"--config-dir: {config_dir} is not a folder. It holds your own groups: sim/, data/, ...")
    folder = config_dir / "conf" if (config_dir / "conf").is_dir() else config_dir
    return folder.resolve()


def _refuse_other_runs(overrides: list[str]) -> None:
    """Look into a run directory that the user names before Hydra writes to it."""
    if (given := value_of("hydra.run.dir", overrides)) is not None:
        refuse_occupied(Path(given))


def _group_folder(group: str, choice: str | None, user: Path | None) -> Path:
    """Return the folder of the YAML that a group's choice came from."""
    for root in [user, conf_dir()]:
        if root is not None and choice and (root / group / f"{choice}.yaml").is_file():
            return (root / group / f"{choice}.yaml").parent
    return Path.cwd()


def _of_other_verbs(verb: str) -> set[str]:
    """Groups and keys that an experiment may set for another verb that takes experiments: it serves all of them."""
    verbs = [path.stem for path in conf_dir().glob("*.yaml")]
    entries = {other: _entries(other) for other in verbs if other != verb}
    brought = set(BROUGHT.values()) if verb not in CONTROL else set()
    return {key for keys in entries.values() if "experiment" in keys for key in keys} | brought


def _top_level(verb: str) -> list[str]:
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
