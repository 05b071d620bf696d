"""A name that stands for several files: `*`, `**` and `?`, and `{mass}` for text that becomes a column of each file."""

import os
import re
from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher
from pathlib import Path
from typing import NamedTuple

from simpel_cli.errors import ConfigError

SPECIAL = re.compile(r"[*?{}]")
TOKEN = re.compile(r"\*\*/|\*\*|\*|\?|\{(?P<name>[^{}/]*)\}|[{}]|[^*?{}]+")
LOOKED_AT = 5000  # files, for one that is near to what was meant
BAG = "metadata.yaml"  # a folder that has it is a recording of ROS 2


class Found(NamedTuple):
    """A file, and what its name says.

    Args:
        path: of the file, or of the folder of a rosbag2.
        named: column -> text in the name, of the pattern's `{column}`.
    """

    path: Path
    named: dict[str, str]


def is_pattern(path: str) -> bool:
    """Whether a path stands for several files."""
    return SPECIAL.search(path) is not None


def is_bag(path: Path) -> bool:
    """Whether a path is the folder of a rosbag2."""
    return path.is_dir() and (path / BAG).is_file()


def matches(pattern: Path) -> list[Found]:
    """Return the files that a pattern stands for, sorted as people do (run2 before run10).

    Files whose names begin with a dot are passed over, as is `card.yaml`, which describes files.

    Args:
        pattern: an absolute path with wildcards.

    Raises:
        ConfigError: the pattern can be read in two ways.
    """
    root, rest = divided(pattern)
    rule = _rule(rest)
    if not root.is_dir():
        return []
    names = {str(path.relative_to(root).as_posix()): path for path in _below(root, rest)}
    found = [(name, rule.fullmatch(name)) for name in sorted(names, key=natural)]
    return [Found(names[name].resolve(), match.groupdict()) for name, match in found if match is not None]


def divided(pattern: Path) -> tuple[Path, str]:
    """Return the folder above the first wildcard, and the rest of the pattern."""
    parts = pattern.parts
    first = next(i for i, part in enumerate(parts) if is_pattern(part))
    return Path(*parts[:first]), "/".join(parts[first:])


def natural(text: str) -> list[tuple[int, int | str]]:
    """Key to sort by: digits in a row count as a number."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", text) if part]


def nearest(pattern: Path, count: int = 3) -> tuple[Path, list[str]]:
    """Return the nearest folder that there is, and the files in it whose names are most like the pattern."""
    root, rest = divided(pattern)
    while not root.is_dir():
        rest = f"{root.name}/{rest}"
        root = root.parent
    plain = SPECIAL.sub("", rest)
    names = [path.relative_to(root).as_posix() for path, _ in zip(_walk(root, None), range(LOOKED_AT), strict=False)]
    return root, sorted(names, key=lambda n: (-SequenceMatcher(None, n, plain).ratio(), natural(n)))[:count]


def _rule(rest: str) -> re.Pattern[str]:
    """The pattern as a regular expression of the path below the root; `{name}` takes text up to what follows it."""
    tokens = list(TOKEN.finditer(rest))
    parts: list[str] = []
    names: list[str] = []
    for token, before in zip(tokens, [None, *tokens], strict=False):
        text, name = token[0], token["name"]
        if name is None and text in "{}":
            raise ConfigError(f"data.path: '{rest}' has a single {text}. A column is written {{name}}, e.g. {{mass}}.")
        if name is not None:
            if not name.isidentifier() or name in names:
                fault = "is there twice" if name in names else "is no name: use letters, digits and _"
                raise ConfigError(f"data.path: {{{name}}} in '{rest}' {fault}.")
            names.append(name)
        wild = name is not None or text in ("*", "**", "?")
        if before is not None and wild and _is_wild(before) and (name is not None or before["name"] is not None):
            raise ConfigError(
                f"data.path: nothing stands between {before[0]} and {text} in '{rest}', so that it is not known where one "
                "ends. Write what stands between them in the names, e.g. an underscore."
            )
        wildcards = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
        parts.append(f"(?P<{name}>[^/]+?)" if name is not None else wildcards.get(text) or re.escape(text))
    return re.compile("".join(parts))


def _is_wild(token: re.Match[str]) -> bool:
    return token["name"] is not None or token[0] in ("*", "**", "?")


def _below(root: Path, rest: str) -> Iterator[Path]:
    """Files that may match, not deeper than the pattern."""
    return _walk(root, None if "**" in rest else rest.count("/"))


def _walk(root: Path, depth: int | None) -> Iterator[Path]:
    for folder, folders, files in os.walk(root, followlinks=depth is not None):
        here = Path(folder)
        level = len(here.relative_to(root).parts)
        bags = [name for name in folders if is_bag(here / name)]
        folders[:] = [] if depth is not None and level >= depth else _shown(set(folders) - set(bags))
        yield from (here / name for name in _shown([*files, *bags]) if name != "card.yaml")


def _shown(names: Sequence[str] | set[str]) -> list[str]:
    return sorted((name for name in names if not name.startswith(".")), key=natural)
