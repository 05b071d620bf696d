"""Config nodes to dataclasses: plain mappings in, objects out.

A config node holds the fields of one frozen dataclass, which `_target_:` names where the group has no obvious one; the
dataclass is schema, defaults, documentation and validator. `_target_` reaches simpel_cli, simulators and the packages named
in `run.plugins`, nothing else: a YAML file cannot call arbitrary code.
"""

import collections.abc
import dataclasses
import difflib
import importlib
import inspect
import keyword
import re
import types
import typing
from collections.abc import Mapping
from typing import Any

from simpel_cli.config.group_classes import CLASSES, OPTIONAL, PLAIN_KEYS, ROLES, SIMULATORS, obvious_class
from simpel_cli.errors import ConfigError, did_you_mean

OWN_PACKAGES = ("simpel_cli", "simulators")


def build(node: Any, path: str, plugins: tuple[str, ...] = (), *, default: type | None = None) -> Any:
    """Build the dataclass that a config node declares.

    Args:
        node: mapping of the dataclass's fields, with `_target_` where the group has no obvious class.
        path: where the node stands, for messages, e.g. `method`.
        plugins: further packages that `_target_` may name.
        default: dataclass of a node without `_target_`; None: that of the group, if it has an obvious one.

    Raises:
        ConfigError: an unknown key, a wrong type, a target outside the fence, or what the dataclass itself refuses.
    """
    if not isinstance(node, dict):
        raise ConfigError(f"{path}: got {node!r}; expected a mapping of keys.")
    fields = {_field(str(k)): v for k, v in node.items() if k != "_target_"}
    target = node.get("_target_")
    cls = resolve(str(target), path, plugins) if target is not None else default or obvious_class(path)
    if cls is None:
        raise ConfigError(
            f"{path}: the key _target_ is missing; it names the class, as the options in conf/{path.partition('.')[0]}/ do."
        )
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
    values = {k: _convert(v, hints[k], f"{path}.{k.removesuffix('_')}", plugins, cls) for k, v in fields.items()}
    try:
        return cls(**values)
    except ValueError as error:  # e.g. simulators.model.ModelError, which knows nothing of simpel_cli
        raise ConfigError(str(error)) from error


def build_source(node: Any, path: str, plugins: tuple[str, ...] = ()) -> Any:
    """Build a simulator: a symbolic model, or a world with query access only.

    Raises:
        ConfigError: as `build`, or the model cannot be made of what is declared.
    """
    declared = build(node, path, plugins)
    try:
        return declared.model()
    except ValueError as error:  # simulators.model.ModelError
        raise ConfigError(of_group(str(error), path)) from error


def of_group(message: str, group: str) -> str:
    """Return what a simulator says of `sim.KEY` with the name of the group that it is declared in."""
    return f"{group}.{message.removeprefix('sim.')}" if message.startswith("sim.") else message


def build_settings(config: Mapping[str, Any]) -> Any:
    """Build the group `run`, which a run directory is begun with, and refuse keys that no verb has.

    Raises:
        ConfigError: such a key, or what the group's class refuses.
    """
    for key in config:
        if key not in CLASSES and key not in PLAIN_KEYS:
            groups = list(CLASSES)
            raise ConfigError(f"{key}: no such key.{did_you_mean(key, groups)} (groups: {', '.join(groups)})")
    return build(config.get("run") or {}, "run")


def build_groups(config: Mapping[str, Any], settings: Any) -> dict[str, Any]:
    """Build every other group of a configuration, once. `effect` becomes a list.

    An optional group that is null or empty is None. A MuJoCo world is built where `world` names it, since it is compiled.

    Args:
        config: resolved.
        settings: the group `run`, built.

    Raises:
        ConfigError: what a group's class refuses.
    """
    built: dict[str, Any] = {"run": settings}
    for name in (name for name in config if name in CLASSES and name != "run"):
        absent = name in OPTIONAL and not config[name]
        unused = name == "mujoco" and config.get("world") != "mujoco"
        built[name] = None if absent or unused else _build_group(config[name], name, settings.plugins)
    return built


def _build_group(node: Any, name: str, plugins: tuple[str, ...]) -> Any:
    if name in SIMULATORS:
        return build_source(node, name, plugins)
    if name == "effect" and isinstance(node, dict):
        return [build(entry, f"effect.{key}", plugins) for key, entry in node.items()]
    return build(node, name, plugins)


def resolve(target: str, path: str, plugins: tuple[str, ...] = ()) -> type:
    """Return the dataclass that a `_target_` names.

    Raises:
        ConfigError: it is none, or outside the fence.
    """
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
    if inspect.isabstract(cls):
        raise ConfigError(
            f"{path}._target_: {target} is a base of others, without a law of its own; name one of them, as conf/{path}/ does."
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


def _field(key: str) -> str:
    """Return the field of a key: a word that Python keeps for itself has an underscore behind it there."""
    return f"{key}_" if keyword.iskeyword(key) else key


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
    doc = field_docs(owner).get(_field(path.rpartition(".")[2]), "")
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


def field_docs(cls: type) -> dict[str, str]:
    """First sentences of the `Args:` section of a dataclass's docstring."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):  # a field is described where it is declared
        section = re.split(r"\n\s*Args:\n", inspect.cleandoc(base.__doc__ or ""), maxsplit=1)
        found = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", section[1], re.M) if len(section) > 1 else []
        docs |= {name: re.sub(r"\s+", " ", text).strip() for name, text in found}
    return docs


def _described(cls: type, name: str, hints: dict[str, Any]) -> str:
    doc = field_docs(cls).get(name, "")
    return f"({name}: {getattr(hints[name], '__name__', str(hints[name]))}{', ' + doc if doc else ''})"


def _unknown_key(path: str, key: str, cls: type, hints: dict[str, Any]) -> str:
    names = [f.name.removesuffix("_") for f in dataclasses.fields(cls)]
    close = difflib.get_close_matches(key, names, n=1, cutoff=0.6)
    if not close:
        return f"{path}.{key}: no such key in {cls.__name__}. It has: {', '.join(names)}."
    field = next(f for f in dataclasses.fields(cls) if f.name == _field(close[0]))
    doc = field_docs(cls).get(field.name, "")
    kind = getattr(hints[field.name], "__name__", str(hints[field.name]))
    value = f" = {field.default!r}" if field.default is not dataclasses.MISSING else ""
    return (
        f"{path}.{key}: no such key in {cls.__name__}. Did you mean {path}.{close[0]}?"
        f"      ({close[0]}: {kind}{value}{', ' + doc if doc else ''})"
    )
