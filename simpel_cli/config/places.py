"""Where in the YAML files of a composition a key stands: added to messages that begin with a key."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from simpel_cli.config.folders import conf_dir
from simpel_cli.errors import ConfigError, DataError

E = TypeVar("E", bound=BaseException)
_KEY = re.compile(r"[^\W\d]\w*(?:\.\w+|\[\d+\])+(?=:)")  # e.g. sim.parameters.c.range, before a colon


class Layer(NamedTuple):
    """A YAML file of a composition.

    Args:
        file: that was read.
        package: keys under which its content stands; none for the root and for experiments.
    """

    file: Path
    package: tuple[str, ...]


def layers_of(verb: str, overrides: Sequence[str], folders: Sequence[Path]) -> list[Layer]:
    """Return the files that Hydra composes for a verb, in its order: later ones go before.

    Args:
        verb: name of the root configuration.
        overrides: as Hydra got them.
        folders: where groups are looked for, the user's first.
    """
    from hydra.core.global_hydra import GlobalHydra
    from hydra.types import RunMode

    loader = GlobalHydra.instance().config_loader()
    found = loader.compute_defaults_list(config_name=verb, overrides=list(overrides), run_mode=RunMode.RUN)
    layers = []
    for default in found.defaults:
        file = next((f for folder in folders if (f := folder / f"{default.config_path}.yaml").is_file()), None)
        package = (default.package or "").replace("_global_", "")
        if file is not None:
            layers.append(Layer(file, tuple(filter(None, package.split(".")))))
    return layers


def with_place(error: E, layers: Sequence[Layer], overrides: Sequence[str] = ()) -> E:
    """Return the error with file and line of the key that its message begins with, if it comes from a file.

    Args:
        error: what is shown to the user.
        layers: files of the composition, later ones go before.
        overrides: words of the command line: what these give has no place in a file.
    """
    text = str(error)
    key = _KEY.match(text)
    if not isinstance(error, ConfigError | DataError) or key is None or _is_given(key[0], overrides):
        return error
    place = _place(key[0], layers)
    if place:
        first, *rest = text.split("\n")  # an expression is shown below, with a caret
        error.args = ("\n".join([f"{first} ({place})", *rest]),)
    return error


def _is_given(key: str, overrides: Sequence[str]) -> bool:
    words = [word.lstrip("+~").partition("=")[0] for word in overrides]
    below = [word for word in words if "." in word]  # a word without a dot chooses an option of a group: a file
    return any(f"{key}.".startswith(f"{word}.") or word.startswith(f"{key}.") for word in below)


def _place(key: str, layers: Sequence[Layer]) -> str:
    """Return file and line of the key, of the part of it that is there, or the file where it is missing."""
    parts = tuple(part for part in re.split(r"[.\[\]]", key) if part)
    best, place = 0, ""
    for layer in layers:
        size = len(layer.package)
        if parts[:size] != layer.package:
            continue
        depth, line = _line(layer.file, parts[size:])
        if depth and size + depth >= best:
            best, place = size + depth, f"{_shown(layer.file)}, line {line}"
        elif size and size >= best:
            best, place = size, _shown(layer.file)
    return place


def _line(file: Path, parts: Sequence[str]) -> tuple[int, int]:
    """Return how many of the parts are there, one inside the other, and the line of the last."""
    import yaml

    try:
        node: Any = yaml.compose(file.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError):
        return 0, 0
    depth = line = 0
    for part in parts:
        child = None
        if isinstance(node, yaml.MappingNode):
            child = next((pair for pair in reversed(node.value) if pair[0].value == part), None)
        elif isinstance(node, yaml.SequenceNode) and part.isdigit() and int(part) < len(node.value):
            child = (node.value[int(part)],) * 2
        if child is None:
            break
        depth, line, node = depth + 1, child[0].start_mark.line + 1, child[1]
    return depth, line


def _shown(file: Path) -> str:
    """Return the path as a user would write it: a built-in one as conf/..., others from the working directory."""
    for folder in (conf_dir().parent, Path.cwd()):
        if file.is_relative_to(folder) and (folder != conf_dir().parent or file.is_relative_to(conf_dir())):
            return str(file.relative_to(folder))
    return str(file)
