"""The text of a data YAML with comments."""

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import yaml

WIDTH = 110
REMARK_AT = 44
MOST_LISTED = 200  # columns


class Line(NamedTuple):
    """A key of the YAML.

    Args:
        key: its name.
        value: as YAML holds it; the text itself where it is not active.
        remark: behind it.
        active: False: it is a proposal, in a comment.
    """

    key: str
    value: Any
    remark: str = ""
    active: bool = True


def yaml_of(
    lines: Sequence[Line],
    columns: Sequence[tuple[str, str, str, str]],
    notes: Sequence[str],
    questions: Sequence[str],
    verdict: str,
) -> str:
    """Return the text.

    Args:
        lines: keys.
        columns: name, unit, range, remarks of every column.
        notes: what was seen in the files.
        questions: what only a person can tell.
        verdict: whether it reads with a simulator; empty: there is none.
    """
    parts = ["# Measurements, as `simpel import` understood them. What it was not sure of stands under Questions.\n"]
    parts += [_line(line) for line in lines]
    if questions:
        parts += ["\n# Questions\n", *(_comment(f"{i}. {text}", "   ") for i, text in enumerate(questions, 1))]
    if verdict:
        parts += ["\n", _comment(f"{verdict}.".replace("..", "."))]
    if notes:
        parts += ["\n# What was seen\n", *(_comment(f"* {note}", "  ") for note in notes)]
    parts.append(f"\n# The {len(columns)} columns\n")
    parts += [f"#   {row}\n" for row in _aligned(columns[:MOST_LISTED])]
    if len(columns) > MOST_LISTED:
        parts.append(f"#   ... and {len(columns) - MOST_LISTED} more\n")
    return "".join(parts)


def _line(line: Line) -> str:
    value = _value(line.value) if line.active or not isinstance(line.value, str) else line.value
    text = f"{'' if line.active else '# '}{line.key}: {value}"
    return f"{text:<{REMARK_AT}}# {line.remark}\n" if line.remark else f"{text}\n"


def _value(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False, allow_unicode=True)
    return text.removesuffix("...\n").strip()


def _comment(text: str, indent: str = "") -> str:
    plain = " ".join(text.split())
    wrapped = textwrap.wrap(plain, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return "".join(f"# {line}\n" for line in wrapped)


def _aligned(rows: Sequence[tuple[str, str, str, str]]) -> list[str]:
    cells = [(" ".join(name.split()), f"[{unit}]" if unit else "", span, remark) for name, unit, span, remark in rows]
    widths = [max((len(cell[i]) for cell in cells), default=0) for i in range(3)]
    return ["  ".join([*(c.ljust(w) for c, w in zip(cell, widths, strict=False)), cell[3]]).rstrip() for cell in cells]
