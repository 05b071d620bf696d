"""What the shell offers at TAB: groups, their options, keys with their values. Quick: from the YAML files alone."""

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from simpel_cli.config.groups import BROUGHT, CONTROL, defaults_of, group_of, options
from simpel_cli.config.resolved import load
from simpel_cli.errors import SimpelError


def overrides(context: Any, incomplete: str) -> list[str]:
    """Return completions of an override, as Typer asks for them.

    Args:
        context: of the command; its name is the verb.
        incomplete: what stands before the cursor. Bash takes words apart at `=`, zsh and fish do not.
    """
    before = re.sub(r" =( |$)", "=", " ".join(map(str, context.params.get("overrides") or []))).split()
    folder = context.params.get("config_dir")
    start = ""
    if before and ("=" not in before[-1] or before[-1].endswith("=")):  # bash's first part of the word
        start = f"{before.pop().rstrip('=')}="
    with contextlib.suppress(SimpelError, OSError):
        found = candidates(str(context.info_name), start + incomplete, before, Path(folder) if folder else None)
        return [text.removeprefix(start) for text in found]
    return []


def candidates(verb: str, text: str, before: list[str], config_dir: Path | None = None) -> list[str]:
    """Return the words that begin with a text.

    Args:
        verb: of simpel.
        text: what was typed of the word.
        before: the other words: a group's keys are those of the option that they choose.
        config_dir: folder of the user's groups.
    """
    chosen = defaults_of(verb) | (dict.fromkeys(BROUGHT) if verb in CONTROL else {})
    key, sign, value = text.partition("=")
    if sign:
        last = re.split(r"[\[,]", value)[-1]  # of several values, of a sweep or a list
        whole = text.removesuffix(last)
        return [whole + name for name in _values(key, chosen, config_dir) if name.startswith(last)]
    chosen |= {word.partition("=")[0]: word.partition("=")[2] for word in before if "=" in word and "." not in word}
    if "." in text:
        return [word for word in _keys(text.partition(".")[0], chosen, config_dir) if word.startswith(text)]
    found = [f"{name}=" for name in chosen if options(group_of(name), config_dir)]
    found += [f"{name}." for name in chosen if any(_keys(name, chosen, config_dir))]
    found = [word for word in found if word.startswith(text)]
    # one that is alone would be taken as a whole, with a blank behind it: what may follow is offered at once
    return candidates(verb, found[0], before, config_dir) if len(found) == 1 else found


def _values(key: str, chosen: Mapping[str, Any], config_dir: Path | None) -> list[str]:
    if key in chosen or "@" in key:
        return list(options(group_of(key), config_dir))
    group = key.partition(".")[0]
    for word in _keys(group, chosen, config_dir):
        name, _, value = word.partition("=")
        if name == key:
            return ["true", "false"] if value in ("true", "false") else [value]
    return []


def _keys(group: str, chosen: Mapping[str, Any], config_dir: Path | None) -> Iterator[str]:
    """Give `group.key=value` of every key that the YAML of the chosen option holds."""
    path = options(group_of(group), config_dir).get(str(chosen.get(group)))
    if path is not None:
        for key, value in _flat(load(path)):
            yield f"{group}.{key}={value}"


def _flat(node: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, str]]:
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{path}{key}.")
        elif key not in ("_target_", "defaults"):
            yield f"{path}{key}", _written(value)


def _written(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    text = str(value).replace(" ", "")
    return "" if any(sign in text for sign in "${}'\"") else text
