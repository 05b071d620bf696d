"""YAML to dataclasses, and Hydra behind one function. The only importer of Hydra and OmegaConf (with main).

A config node is `_target_:` plus the fields of one frozen dataclass; the dataclass is schema, defaults, documentation
and validator. `_target_` reaches simpel_cli, simulators and the packages named in `run.plugins`, nothing else: a YAML
file cannot call arbitrary code.
"""

import collections.abc
import dataclasses
import difflib
import importlib
import inspect
import math
import os
import re
import secrets
import sys
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

from simpel_cli.errors import ConfigError, did_you_mean
from simpel_cli.run import refuse_occupied

OWN_PACKAGES = ("simpel_cli", "simulators")
ROLES = {"sim": "model", "prior": "uses_simulator", "score": "closed_form_gap", "method": "bind"}


def conf_dir() -> Path:
    """Return the folder of the built-in configuration: inside the wheel, else the checkout's."""
    inside = Path(__file__).parent / "conf"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "conf"


def example_data_dir() -> Path:
    """Return the folder of the measurements that come with simpel: inside the wheel, else the checkout's."""
    inside = Path(__file__).parent / "example_data"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "data"


# ------------------------------------------------------------------------------------------------ nodes to dataclasses


def build(node: Any, path: str, plugins: tuple[str, ...] = (), *, default: type | None = None) -> Any:
    """Build the dataclass that a config node declares.

    Args:
        node: mapping with `_target_` (or without, if `default` is given) and the dataclass's fields.
        path: where the node stands, for messages, e.g. `method`.
        plugins: further packages that `_target_` may name.
        default: dataclass of a node without `_target_`.

    Raises:
        ConfigError: an unknown key, a wrong type, a target outside the fence, or what the dataclass itself refuses.
    """
    if not isinstance(node, dict):
        raise ConfigError(f"{path}: got {node!r}; expected a mapping of keys.")
    fields = {str(k): v for k, v in node.items() if k != "_target_"}
    target = node.get("_target_")
    cls = _resolve(str(target), path, plugins) if target is not None else default
    if cls is None:
        raise ConfigError(f"{path}: the key _target_ is missing; it names the class, e.g. simulators.model.Declared.")
    role = ROLES.get(path)
    if role is not None and role not in {*dir(cls), *(f.name for f in dataclasses.fields(cls))}:
        raise ConfigError(f"{path}._target_: {target} is no {path}; the options in conf/{path}/ show what is.")
    known = {f.name: f for f in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls)
    for key in fields:
        if key not in known:
            raise ConfigError(_unknown_key(path, key, cls, hints))
    for name, field in known.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in fields:
            raise ConfigError(f"{path}.{name}: missing. {_described(cls, name, hints)}")
    values = {k: _convert(v, hints[k], f"{path}.{k}", plugins, cls) for k, v in fields.items()}
    try:
        return cls(**values)
    except ValueError as error:  # e.g. simulators.model.ModelError, which knows nothing of simpel_cli
        raise ConfigError(str(error)) from error


def _resolve(target: str, path: str, plugins: tuple[str, ...]) -> type:
    package = target.split(".")[0]
    if package not in (*OWN_PACKAGES, *plugins):
        raise ConfigError(
            f"{path}._target_: got {target}; allowed are classes of {', '.join((*OWN_PACKAGES, *plugins))}. "
            f"To use a package of your own, name it: 'run.plugins=[{package}]'."
        )
    module_name, _, name = target.rpartition(".")
    if not module_name:
        raise ConfigError(f"{path}._target_: got {target}; a class is named with its module, package.module.Class.")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"{path}._target_: cannot import {module_name} ({error}).") from error
    cls = getattr(module, name, None)
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        public = [n for n, v in vars(module).items() if isinstance(v, type) and dataclasses.is_dataclass(v)]
        raise ConfigError(
            f"{path}._target_: {target} is not a dataclass.{did_you_mean(name, public)} "
            f"({module_name} has: {', '.join(public) or 'none'})"
        )
    return cls


def _function(name: str, path: str, plugins: tuple[str, ...]) -> Any:
    """Import a function of a package that the user named in `run.plugins`."""
    module_name, _, attribute = name.rpartition(".")
    package = name.split(".")[0]
    if package not in plugins or not module_name:
        raise ConfigError(
            f"{path}: got {name}; expected package.module.function of a package in run.plugins ({list(plugins)}). "
            f"If you trust it: 'run.plugins=[{package}]'."
        )
    try:
        found = getattr(importlib.import_module(module_name), attribute, None)
    except ImportError as error:
        raise ConfigError(
            f"{path}: cannot import {module_name} ({error}). Install its package, or put its folder into PYTHONPATH."
        ) from error
    if not callable(found):
        raise ConfigError(f"{path}: {module_name} has no function {attribute}.")
    return found


def _convert(value: Any, hint: Any, path: str, plugins: tuple[str, ...], owner: type) -> Any:
    """Convert a YAML value to a field's type, or say what was expected."""
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) or _origin(hint) is typing.Union else (hint,)
    if value is None and type(None) in options:
        return None
    for option in options:
        converted = _as(value, option, path, plugins, owner)
        if converted is not _NO:
            return converted
    expected = " or ".join(_type_name(o) for o in options)
    doc = _field_docs(owner).get(path.rpartition(".")[2], "")
    raise ConfigError(f"{path}: got {value!r}; expected {expected}{': ' + doc if doc else '.'}")


_NO = object()


def _as(value: Any, hint: Any, path: str, plugins: tuple[str, ...], owner: type) -> Any:
    origin = _origin(hint)
    if hint is Any:
        return value
    if origin is collections.abc.Callable:
        return _function(value, path, plugins) if isinstance(value, str) else _NO
    if hint is bool or hint is str:
        return value if isinstance(value, hint) else _NO
    if hint is int:
        return value if isinstance(value, int) and not isinstance(value, bool) else _NO
    if hint is float:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else _NO
    if origin in (tuple, list) and isinstance(value, list | tuple):
        item = typing.get_args(hint)[0]
        return origin(_convert(v, item, f"{path}[{i}]", plugins, owner) for i, v in enumerate(value))
    if origin in (dict, collections.abc.Mapping) and isinstance(value, dict):
        item = typing.get_args(hint)[1]
        return {k: _convert(v, item, f"{path}.{k}", plugins, owner) for k, v in value.items()}
    if isinstance(value, dict) and (dataclasses.is_dataclass(hint) or getattr(hint, "_is_protocol", False)):
        default = hint if isinstance(hint, type) and dataclasses.is_dataclass(hint) else None
        return build(value, path, plugins, default=default)
    return _NO


def _origin(hint: Any) -> Any:
    return typing.get_origin(hint)


def _type_name(hint: Any) -> str:
    if hint is type(None):
        return "null"
    if _origin(hint) in (tuple, list):
        return f"a list of {_type_name(typing.get_args(hint)[0])}"
    if _origin(hint) in (dict, collections.abc.Mapping):
        return "a mapping"
    if dataclasses.is_dataclass(hint) or getattr(hint, "_is_protocol", False):
        return "a mapping of keys"
    return {int: "an integer", float: "a number", str: "text", bool: "true or false"}.get(hint, str(hint))


def _field_docs(cls: type) -> dict[str, str]:
    """First sentences of the `Args:` section of a dataclass's docstring."""
    section = re.split(r"\n\s*Args:\n", inspect.getdoc(cls) or "", maxsplit=1)
    if len(section) < 2:
        return {}
    docs = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", section[1], re.M)
    return {name: re.sub(r"\s+", " ", text).strip() for name, text in docs}


def _described(cls: type, name: str, hints: dict[str, Any]) -> str:
    doc = _field_docs(cls).get(name, "")
    return f"({name}: {getattr(hints[name], '__name__', str(hints[name]))}{', ' + doc if doc else ''})"


def _unknown_key(path: str, key: str, cls: type, hints: dict[str, Any]) -> str:
    names = [f.name for f in dataclasses.fields(cls)]
    close = difflib.get_close_matches(key, names, n=1, cutoff=0.6)
    if not close:
        return f"{path}.{key}: no such key in {cls.__name__}. It has: {', '.join(names)}."
    field = next(f for f in dataclasses.fields(cls) if f.name == close[0])
    doc = _field_docs(cls).get(close[0], "")
    kind = getattr(hints[close[0]], "__name__", str(hints[close[0]]))
    value = f" = {field.default!r}" if field.default is not dataclasses.MISSING else ""
    return (
        f"{path}.{key}: no such key in {cls.__name__}. Did you mean {path}.{close[0]}?"
        f"      ({close[0]}: {kind}{value}{', ' + doc if doc else ''})"
    )


# -------------------------------------------------------------------------------------------------------- composition


class Job(typing.NamedTuple):
    """One composed, resolved configuration."""

    config: dict[str, Any]
    directory: Path
    data_folder: Path  # folder of the data YAML: relative paths of measurements start there
    words: str = ""  # the overrides that tell this job from the others of a sweep


class _Stopped(BaseException):
    """Carries what a task raised past Hydra, which would print a line of its own and go on with a multirun."""


def launch(
    verb: str, task: Callable[[Job], Any], overrides: list[str], *, config_dir: Path | None, flags: list[str]
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

    words = checked(overrides)
    user = _user_conf(config_dir)
    if "--cfg" not in flags:
        _refuse_other_runs(overrides)
    register_resolvers()
    known, swept = _top_level(verb), swept_keys(overrides)

    def entry(config: Any) -> Any:
        try:
            hydra_config = HydraConfig.get()
            plain = typing.cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
            for key in plain:
                if key not in known:
                    raise ConfigError(_unknown_root(str(key), verb, known))
            folder = _group_folder("data", hydra_config.runtime.choices.get("data"), user)
            directory = Path(hydra_config.runtime.output_dir)
            if config_dir is not None and "choices" in plain:
                plain["choices"]["config_dir"] = str(config_dir)  # for the commands that a run ends with
            given = [w.removeprefix("++") for w in hydra_config.overrides.task]
            return task(Job(plain, directory, folder, " ".join(w for w in given if w.partition("=")[0] in swept)))
        except Exception as error:
            raise _Stopped from error

    failure: BaseException | None = None
    before, sys.argv = sys.argv, [verb, *words, *flags, *(["--config-dir", str(user)] if user else [])]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach us as exceptions, not as Hydra's printout
    try:
        hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=verb)(entry)()
    except _Stopped as stopped:
        failure = _translated(stopped.__cause__, verb, user, own=False)
    except Exception as error:
        failure = _translated(error, verb, user, own=True)
    finally:
        sys.argv = before
    if failure is not None:  # raised here, so that no traceback shows our detour
        raise failure


def count_jobs(overrides: list[str]) -> int:
    """Return the number of jobs of a multirun.

    Raises:
        ConfigError: an override is not of the form key=value.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(checked(overrides))
    return math.prod(sum(1 for _ in o.sweep_iterator()) for o in parsed if o.is_sweep_override())


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
    """Read a resolved configuration that a run wrote.

    Raises:
        ConfigError: missing or not YAML.
    """
    import yaml

    try:
        config = yaml.safe_load(path.read_text())
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: missing; the directory is not a run that can be read back.") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: not readable ({str(error).splitlines()[0]}).") from error
    if not isinstance(config, dict):
        raise ConfigError(f"{path}: not a configuration of simpel.")
    return config


def dump(config: dict[str, Any]) -> str:
    """Return a resolved configuration as YAML."""
    import yaml

    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True)


def register_resolvers() -> None:
    """Make `${simpel_data:}` (bundled measurements) and `${run_id:}` (a new hash per launch) available."""
    from omegaconf import OmegaConf

    run_id = secrets.token_hex(3)  # two starts in one second must never share a run directory

    OmegaConf.register_new_resolver("simpel_data", lambda: str(example_data_dir()), replace=True)
    OmegaConf.register_new_resolver("run_id", lambda: run_id, replace=True)


def _force(override: str) -> str:
    """Let `a.b=c` set what the YAML leaves out; `build` then tells a field from a typo."""
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
    for word in overrides:
        if found := re.fullmatch(r"\+*hydra\.run\.dir=['\"]?(.*?)['\"]?", word):
            refuse_occupied(Path(found[1]))


def _group_folder(group: str, choice: str | None, user: Path | None) -> Path:
    """Return the folder of the YAML that a group's choice came from."""
    for root in [user, conf_dir()]:
        if root is not None and choice and (root / group / f"{choice}.yaml").is_file():
            return (root / group / f"{choice}.yaml").parent
    return Path.cwd()


def _yaml_message(error: Any) -> str:
    mark = getattr(error, "problem_mark", None)
    where = f"{mark.name}, line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return f"{where}not valid YAML ({getattr(error, 'problem', None) or error})."


def _translated(error: BaseException | None, verb: str, user: Path | None, *, own: bool) -> BaseException:
    """Return a `ConfigError` for what the user can have caused, anything else as it is.

    Args:
        error: what was raised.
        verb: that was launched.
        user: folder with the user's groups.
        own: Hydra itself raised it, not the task.
    """
    import yaml
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    assert error is not None
    message = None
    if isinstance(error, OmegaConfBaseException | HydraException):
        message = _translate(error, verb)
    elif own and isinstance(error, yaml.YAMLError):
        message = _yaml_message(error)
    elif own and isinstance(error, UnicodeDecodeError):
        message = f"{_not_text(user)}: not UTF-8 text ({error.reason}). Save it in UTF-8."
    elif own and isinstance(error, OSError) and error.filename:
        message = (
            f"hydra.run.dir: cannot write to {error.filename} ({error.strerror}). Choose another: hydra.run.dir=DIR."
        )
    elif own and isinstance(error, ValueError) and "Config group override must be" in str(error):
        groups = ", ".join(name for name in _top_level(verb) if name != "choices")
        message = f"a group cannot be null: name one of its options, e.g. method=simpel (groups and keys: {groups})."
    if message is None:
        return error
    translated = ConfigError(message)
    translated.__cause__ = error
    return translated


def _not_text(user: Path | None) -> str:
    """First YAML file of the user's that is not UTF-8."""
    for path in sorted(user.rglob("*.yaml")) if user is not None else []:
        try:
            path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            return str(path)
    return "a YAML file"


def _translate(error: Exception, verb: str) -> str:
    """Say in one line what Hydra and OmegaConf say in ten."""
    text = str(error)
    cause = error.__cause__
    if found := re.search(r"Could not find '([\w/@.\-]+)/([^'/]*)'\s+Available options in '[^']*':\s*(.*)", text, re.S):
        group, choice, listing = found.groups()
        options = [o for o in listing.split() if o and not o.startswith("Config")]
        options = options[: options.index("search")] if "search" in options else options
        return f"{group}: no option {choice!r}.{did_you_mean(choice, options)} (available: {', '.join(options)})"
    if found := re.search(r"Could not find '([^']+)'", text):
        return f"{found[1]}: no such configuration. Groups are folders with YAML files, given with --config-dir DIR."
    if found := re.search(r"Could not override '([\w.@/]+)'", text):
        return _unknown_root(found[1], verb, _top_level(verb))
    if found := re.search(r"Ambiguous value for argument '\+*([^']*)'", text):
        key, _, value = found[1].partition("=")
        return (
            f"{found[1]}: several values, but `simpel {verb}` takes one. Run each of them with "
            f"`simpel sweep {found[1]}`; a list is written '{key}=[{value}]'."
        )
    lines = [line.strip() for line in [*str(cause or "").splitlines(), *text.splitlines()] if line.strip()]
    key = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("full_key:")), "")
    what = lines[0] if lines else text
    if "'sim.name' not found" in what or "Index 'name'" in what:
        return (
            "sim.name: missing. A simulator's YAML is a mapping with the keys _target_, name, dt, states, dynamics, ..."
        )
    return f"{key + ': ' if key else ''}{_interpolation(what, key)}"


def _interpolation(text: str, key: str) -> str:
    """Say what is wrong with a value that refers to another."""
    if "'sim.name' not found" in text or "Index 'name'" in text:
        return (
            "the simulator has no key `sim.name`; its YAML is a mapping with _target_, name, dt, states, dynamics, ..."
        )
    if found := re.search(r"Interpolation key '(.+)' not found", text):
        return f"${{{found[1]}}} names a key that does not exist. Write out the value, or the whole path of the key."
    if found := re.search(r"Environment variable '(.+)' not found", text):
        return f"the environment variable {found[1]} is not set: set it, or give a default, ${{oc.env:{found[1]},DEFAULT}}."
    if found := re.search(r"Unsupported interpolation type (.+)", text):
        return f"${{{found[1]}:...}} is unknown; allowed are ${{oc.env:NAME}}, ${{simpel_data:}} and ${{key}}."
    if "Missing mandatory value" in text:
        return f"a value must be given (the YAML says ???), e.g. on the command line: {key}=VALUE."
    if found := re.search(r"(?:no viable alternative|mismatched|token recognition).*?'(\$\{.*)'", text):
        return f"{found[1]!r} is no complete ${{...}}; close the brace."
    return text


def _unknown_root(key: str, verb: str, known: list[str]) -> str:
    if key == "experiment":
        return "experiment: its file must begin with the line `# @package _global_`, so that it can set every group."
    if key.startswith("hydra."):
        return f"{key}: no such key of Hydra's; `simpel {verb} --cfg hydra` shows them."
    shown = [name for name in known if name != "choices"]
    return f"{key}: no such key or group of `simpel {verb}`.{did_you_mean(key, shown)} (it has: {', '.join(shown)})"


def _top_level(verb: str) -> list[str]:
    """Groups and keys of a root configuration and of those that it builds on."""
    import yaml

    root = yaml.safe_load((conf_dir() / f"{verb}.yaml").read_text())
    entries = root.get("defaults", [])
    inherited = [name for e in entries if isinstance(e, str) and e != "_self_" for name in _top_level(e)]
    groups = [name for name in (next(iter(d)) for d in entries if isinstance(d, dict)) if "/" not in name]
    own = [k for k in root if k not in ("defaults", "hydra")]
    return list(dict.fromkeys([*inherited, *(g for g in groups if g != "experiment"), *own]))
