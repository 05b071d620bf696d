"""Units in the header of a CSV file: `phi [rad]`, `phi (rad)` and `phi/rad`, or a second row that holds nothing else."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from simpel_cli.data.unit_words import bare, canonical, is_unit

IN_BRACKETS = re.compile(r"(?P<name>.*\S)(?P<blank>\s*)(?:\[(?P<square>[^\[\]]+)\]|\((?P<round>[^()]+)\))$")
AFTER_SLASH = re.compile(r"(?P<name>[^/]*[^/\s])\s*/\s*(?P<unit>\S.*)$")
NOT_AFTER_SLASH = {"1", "min", "step", "count"}  # x/1, x/min: the first of several columns, or the smallest value


class Header(NamedTuple):
    """Names of columns, and what their headers say beside the name.

    Args:
        names: to address the columns by, in their order; empty: a column without a header.
        units: name -> unit.
        full: header as it stands in the file -> name, where the two differ.
        doubtful: name that several columns could have -> their headers, which are their names then.
    """

    names: tuple[str, ...]
    units: dict[str, str]
    full: dict[str, str]
    doubtful: dict[str, tuple[str, ...]]


def header_of(texts: Sequence[str], units_below: Sequence[str] = ()) -> Header:
    """Take the units out of headers.

    A short name that two columns would share is given to neither. What one of them has behind it is no unit if what another one
    has there is none: force (L) and force (R).

    Args:
        texts: the headers, none twice.
        units_below: the row of units, if there is one.

    Raises:
        ValueError: a header and the row of units contradict each other; the message names both.
    """
    parts = [_parts(text) for text in texts]
    odd = {_stem(text) for text, (_, unit, _) in zip(texts, parts, strict=True) if not unit} - {""}
    parts = [
        (text, "", False) if unit and _stem(text) in odd else (short, unit, slash)
        for text, (short, unit, slash) in zip(texts, parts, strict=True)
    ]
    shorts = [short for short, _, _ in parts]
    names: list[str] = []
    units: dict[str, str] = {}
    doubtful: dict[str, tuple[str, ...]] = {}
    for i, (text, (short, unit, slash)) in enumerate(zip(texts, parts, strict=True)):
        alone = shorts.count(short) == 1 or not unit
        names.append(short if alone else text)
        if not alone and short not in texts:
            doubtful[short] = tuple(other for other, s in zip(texts, shorts, strict=True) if s == short)
        unit = unit if alone or not slash else ""  # left/m and left/s: more likely two signals than two units
        below = bare(units_below[i]) if units_below else ""
        if unit and below and canonical(unit) != canonical(below):
            raise ValueError(f"the header '{text}' gives the unit {unit}, the row below it {below}")
        if text and (unit or below):
            units[names[-1]] = unit or below
    full = {text: name for text, name in zip(texts, names, strict=True) if text != name}
    return Header(tuple(names), units, full, doubtful)


def are_units(texts: Sequence[str], numeric: Sequence[bool]) -> bool:
    """Whether the first row below a header gives units: each entry is one or empty, and one stands above numbers.

    Args:
        texts: entries of the row.
        numeric: whether the column has numbers, and nothing else, below it.
    """
    above_numbers = any(number and text and not is_number(text) for text, number in zip(texts, numeric, strict=True))
    return above_numbers and all(not text or is_unit(bare(text)) for text in texts)


def _parts(text: str) -> tuple[str, str, bool]:
    """Name, unit (empty: none is given) and whether a slash stands between them."""
    if match := IN_BRACKETS.fullmatch(text):
        unit = (match["square"] or match["round"]).strip()
        index = unit.isdigit() and not (unit == "1" and match["square"] and match["blank"])  # x[1], phi (2)
        if is_unit(unit) and not index:
            return match["name"].removesuffix("/").rstrip() or text, unit, False
    if match := AFTER_SLASH.fullmatch(text):
        unit = bare(match["unit"])
        if is_unit(unit) and unit not in NOT_AFTER_SLASH:
            return match["name"], unit, True
    return text, "", False


def _stem(text: str) -> str:
    """What stands before brackets or a slash; empty: there are none."""
    match = IN_BRACKETS.fullmatch(text) or AFTER_SLASH.fullmatch(text)
    return match["name"] if match else ""


def is_number(text: str) -> bool:
    """Whether a text is a number with a decimal point."""
    try:
        float(text)
    except ValueError:
        return False
    return True
