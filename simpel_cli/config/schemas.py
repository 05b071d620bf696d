"""JSON Schemas (draft 2020-12) of YAML files, made of the dataclasses that read them: an editor completes and checks with them.

A class says in `sections` what its type hints leave open. `_target_` chooses among the classes of a group; of one that is not
simpel's, everything is allowed. Where `defaults:` name another file, nothing is required, since that may say it.
"""

import collections.abc
import dataclasses
import json
import types
import typing
from pathlib import Path
from typing import Any

from simpel_cli.config.build import field_docs, resolve
from simpel_cli.config.group_classes import CLASSES, OPTIONAL, PLAIN_KEYS, SIMULATORS
from simpel_cli.config.groups import options
from simpel_cli.config.resolved import load
from simpel_cli.errors import ConfigError, did_you_mean
from simpel_cli.runs.files import write_text

Schema = dict[str, Any]
NAMES = ("sim", "data", "reward", "experiment")
# classes that no YAML of conf/ names
OTHERS = {"sim": ("simulators.extended.Extended", "simulators.worlds.callable_world.CallableWorld")}
REFERENCE = r"\$\{|^\?\?\?$"  # a value that Hydra puts in: ${...}, or one that must be given: ???
DEFAULTS: Schema = {
    "type": "array",
    "items": {"type": ["string", "object"], "additionalProperties": {"type": ["string", "null", "array"]}},
    "description": "Files that this one builds on, in order: `- other`, `- override /sim: NAME`, `- /reward: NAME`.",
}


def schema(name: str) -> Schema:
    """Return the schema of the YAML files of a group.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in NAMES:
        raise ConfigError(f"schema: got {name}; there are schemas of {', '.join(NAMES)}.{did_you_mean(name, NAMES)}")
    definitions: Schema = {}
    if name == "experiment":
        body = _experiment(definitions)
    else:
        body = _group(name, definitions, partial=False)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"simpel: {name}/NAME.yaml",
        **body,
        "$defs": dict(sorted(definitions.items())),
    }


def text_of(name: str) -> str:
    """Return the schema of a group as JSON."""
    return json.dumps(schema(name), indent=1, ensure_ascii=False) + "\n"


def write(folder: Path) -> list[Path]:
    """Write the schemas of all groups that have one.

    Raises:
        ConfigError: the folder is a file.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise ConfigError(f"--write: {folder} is a file. Name a folder.") from error
    files = {name: folder / f"{name}.schema.json" for name in NAMES}
    for name, path in files.items():
        write_text(path, text_of(name))
    return list(files.values())


def classes_of(group: str) -> dict[str, type]:
    """Return the classes that the YAML files of a group declare, by `_target_`; the obvious one first."""
    folder = "sim" if group in SIMULATORS else group
    obvious = CLASSES.get(group)
    nodes = (load(path) for path in options(folder).values())
    named = [str(node["_target_"]) for node in nodes if "_target_" in node]
    found = [*([obvious] if obvious else []), *sorted(named), *OTHERS.get(folder, ())]
    return {target: resolve(target, group) for target in dict.fromkeys(found)}


def _experiment(definitions: Schema) -> Schema:
    """Return the schema of what sets keys of several groups."""
    groups: Schema = {}
    for group in CLASSES:
        node = _group(group, definitions, partial=True)
        if group == "effect":
            node = {"type": "object", "additionalProperties": node}
        groups[group] = {"anyOf": [node, {"type": "null"}]} if group in OPTIONAL else node
    plain: Schema = dict.fromkeys((*PLAIN_KEYS, "hydra"), True)
    properties = {"defaults": DEFAULTS, **groups, **plain}
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _group(group: str, definitions: Schema, *, partial: bool) -> Schema:
    """Return the schema of a group's node.

    Args:
        group: name.
        definitions: of classes; those of the group are added.
        partial: whether another file may say what this one leaves out, in any case.
    """
    classes = classes_of(group)
    parts = [_reference(target, cls, definitions, partial=True) for target, cls in classes.items()]
    whole = [_reference(target, cls, definitions, partial=False) for target, cls in classes.items() if not partial]
    anyone = parts[0] if len(parts) == 1 else {"anyOf": parts}
    rules = []
    for i, target in enumerate(classes):
        chosen = {"required": ["_target_"], "properties": {"_target_": {"const": target}}}
        rules.append({"if": chosen, "then": parts[i] if partial else _unless_it_builds_on(whole[i], parts[i])})
    obvious = whole[0] if whole and CLASSES.get(group) else {"required": ["_target_"]}
    unnamed = {"not": {"required": ["_target_"]}}
    rules.append({"if": unnamed, "then": anyone if partial else _unless_it_builds_on(obvious, anyone)})
    choice = {"type": "string", "description": "Class of this node.", "examples": list(classes)}
    return {"type": "object", "properties": {"_target_": choice}, "allOf": rules}


def _unless_it_builds_on(whole: Schema, part: Schema) -> Schema:
    return {"if": {"required": ["defaults"]}, "then": part, "else": whole}


def _reference(target: str, cls: type, definitions: Schema, *, partial: bool) -> Schema:
    name = f"{target}.partial" if partial else target
    if name not in definitions:
        node = of_class(cls)
        node["properties"] = {"_target_": {"const": target}, "defaults": DEFAULTS} | node["properties"]
        definitions[name] = _without_required(node) if partial else node
    return {"$ref": f"#/$defs/{name}"}


def of_class(cls: type) -> Schema:
    """Return the schema of the fields of a dataclass."""
    hints, docs = typing.get_type_hints(cls), field_docs(cls)
    own: Schema = getattr(cls, "sections", {})
    properties: Schema = {}
    required = []
    for field in dataclasses.fields(cls):
        node = dict(own[field.name]) if field.name in own else _of_type(hints[field.name])
        if docs.get(field.name):
            node["description"] = docs[field.name]
        if isinstance(field.default, bool | int | float | str):
            node["default"] = field.default
        key = field.name.removesuffix("_")  # a word that Python keeps for itself has an underscore behind it
        properties[key] = node
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            required.append(key)
    node = {"type": "object", "properties": properties, "additionalProperties": False}
    return node | ({"required": required} if required else {})


def _of_type(hint: Any) -> Schema:
    """Return the schema of a type; whatever is no text may be a reference, which is."""
    origin = typing.get_origin(hint)
    simple = {bool: "boolean", int: "integer", float: "number"}.get(hint)
    if simple is not None:
        return {"type": [simple, "string"], "pattern": REFERENCE}
    if hint is str:
        return {"type": "string"}
    if hint is type(None):
        return {"type": "null"}
    if origin is typing.Union or isinstance(hint, types.UnionType):
        return _of_union([_of_type(option) for option in typing.get_args(hint)])
    if origin in (tuple, list):
        return {"type": ["array", "string"], "items": _of_type(typing.get_args(hint)[0]), "pattern": REFERENCE}
    if origin in (dict, collections.abc.Mapping):
        values = _of_type(typing.get_args(hint)[1])
        return {"type": ["object", "string"], "additionalProperties": values or True, "pattern": REFERENCE}
    if origin is collections.abc.Callable:
        return {"type": "string"}
    if getattr(hint, "_is_protocol", False):
        return {"type": "object", "properties": {"_target_": {"type": "string"}}}
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        node = of_class(hint)
        node["properties"] = {"_target_": {"type": "string"}} | node["properties"]
        return node
    return {}


def _of_union(options: list[Schema]) -> Schema:
    """Return one schema where types alone tell the options apart: an editor then says what is wrong with a value."""
    if all(option.keys() <= {"type", "pattern"} for option in options):
        kinds = [k for o in options for k in ([o["type"]] if isinstance(o["type"], str) else o["type"])]
        free_text = any(option == {"type": "string"} for option in options)
        node: Schema = {"type": list(dict.fromkeys(kinds))}
        return node if free_text or "string" not in kinds else node | {"pattern": REFERENCE}
    return {"anyOf": options}


def _without_required(node: Any) -> Any:
    """Return a schema in which every key may be left out."""
    if isinstance(node, dict):
        return {key: _without_required(value) for key, value in node.items() if key != "required"}
    return [_without_required(value) for value in node] if isinstance(node, list) else node
