"""Columns beside the quantities of a simulator: by name, else by a unit that only one of each has."""

import math
import re
from collections.abc import Sequence
from difflib import get_close_matches
from typing import NamedTuple

from simpel_cli.data.computed import COMPOUND
from simpel_cli.data.importing.columns import Column
from simpel_cli.data.recording import Source
from simpel_cli.data.unit_words import ALIASES, canonical
from simulators.expression import RESERVED
from simulators.model import Quantity

GREEK = {
    "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "θ": "theta", "ϑ": "theta", "φ": "phi", "ϕ": "phi", "ψ": "psi",
    "ω": "omega", "τ": "tau", "ρ": "rho", "μ": "mu",
}  # fmt: skip
PREFIXES = {"k": 1e3, "h": 1e2, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
ANGLES = {("deg", "rad"): "pi/180", ("rad", "deg"): "180/pi"}


class Matched(NamedTuple):
    """What belongs together.

    Args:
        columns: quantity -> column, of the file or computed; None: no column is sure to be it.
        computed: new column -> formula, where a unit has to be converted.
        reasons: quantity -> how the column was found.
        questions: what only a person can tell.
    """

    columns: dict[str, str | None]
    computed: dict[str, str]
    reasons: dict[str, str]
    questions: tuple[str, ...]


def match(model: Source, columns: Sequence[Column]) -> Matched:
    """Find the columns of the quantities.

    Args:
        model: the simulator.
        columns: that are neither time nor names.
    """
    left = {c.name: c for c in columns if c.values is not None}
    quantities = [*model.states, *model.inputs, *model.outputs]
    found: dict[str, Column] = {}
    reasons: dict[str, str] = {}
    for alike in (_same, _same_word, _same_last_word):
        hits = {q.name: [c for c in left.values() if alike(c.name, q.name)] for q in quantities if q.name not in found}
        for name, able in hits.items():
            if len(able) == 1 and sum(able[0] in other for other in hits.values()) == 1:
                found[name], reasons[name] = able[0], "by its name"
                del left[able[0].name]
    for q in quantities:
        unit = canonical(q.unit)
        free = [other for other in quantities if other.name not in found and canonical(other.unit) == unit]
        able = [c for c in left.values() if _unit(c) and canonical(_unit(c)) == unit]
        if q.name not in found and unit != "1" and len(free) == len(able) == 1:
            found[q.name], reasons[q.name] = able[0], "by its unit alone: check it"
            del left[able[0].name]
    return _converted(model, quantities, found, reasons, list(left.values()))


def _unit(column: Column) -> str:
    """Unit of a column; a name such as `volts` is one."""
    return column.unit or (column.name if column.name.lower() in ALIASES else "")


def _converted(
    model: Source, quantities: list[Quantity], found: dict[str, Column], reasons: dict[str, str], left: list[Column]
) -> Matched:
    columns: dict[str, str | None] = {}
    computed: dict[str, str] = {}
    questions: list[str] = []
    outputs = {q.name for q in model.outputs}
    for q in quantities:
        column = found.get(q.name)
        if column is None:
            if q.name not in outputs:
                questions.append(_missing(q, q in model.inputs, left))
                columns[q.name] = None
            continue
        columns[q.name] = column.name
        if not column.unit or not q.unit or canonical(column.unit) == canonical(q.unit):
            continue
        factor = factor_between(column.unit, q.unit)
        if factor is None or not is_usable(column.name):
            del columns[q.name]
            columns[q.name] = None
            how = f"by {factor} in the file" if factor else "in the file, or correct its unit"
            questions.append(f"{q.name} is in {q.unit}, {column.name} in {column.unit}: convert it {how}.")
            continue
        name = f"{re.sub(r'[./]', '_', column.name)}_in_{re.sub(r'[^A-Za-z0-9]+', '_', q.unit).strip('_')}"
        computed[name] = f"{column.name}*{factor}"
        columns[q.name] = name
        reasons[q.name] += f", converted from {column.unit} to {q.unit}"
    return Matched(columns, computed, reasons, tuple(questions))


def _missing(q: Quantity, is_input: bool, left: Sequence[Column]) -> str:
    """Ask for the column of a quantity."""
    able = [c for c in left if not c.unit or canonical(c.unit) == canonical(q.unit)]
    near = get_close_matches(q.name.lower(), [c.name.lower() for c in able], n=3, cutoff=0.4)
    alike = [c for c in able if c.name.lower() in near or c.name.lower().startswith(q.name.lower())]
    named = [c.name for c in (*alike, *(c for c in able if c not in alike))]
    unit = f" [{q.unit}]" if canonical(q.unit) != "1" else ""
    which = f"Is it one of {', '.join(named)}?" if named else "No column is left for it."
    if is_input:
        return f"Which column is the input {q.name}{unit}? {which} It has to be measured."
    return f"Which column is {q.name}{unit}? {which} null: it was not measured."


def is_usable(column: str) -> bool:
    """Whether a formula can name a column."""
    return (column.isidentifier() and column not in RESERVED) or COMPOUND.fullmatch(column) is not None


def factor_between(given: str, wanted: str) -> str | None:
    """Factor from one unit to another, where they differ in the prefix of one word, or in degrees and rad; None: not known."""
    ours, theirs = canonical(given).split(" "), canonical(wanted).split(" ")
    differ = [i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b]
    if len(ours) != len(theirs) or len(differ) != 1:
        return None
    a, b = ours[differ[0]], theirs[differ[0]]
    below = "/" in ours[: differ[0]]
    if (a, b) in ANGLES:
        return ANGLES[(b, a) if below else (a, b)]
    scale = _prefix(a, b) or (1 / inverse if (inverse := _prefix(b, a)) else None)
    if scale is None:
        return None
    scale = 1 / scale if below else scale
    exponent = round(math.log10(scale))
    return f"1e{exponent}" if math.isclose(scale, 10.0**exponent) else None


def _prefix(long: str, short: str) -> float | None:
    """Size of `long` in units of `short`, if it is that with a prefix, e.g. mm and m."""
    return PREFIXES.get(long.removesuffix(short)) if long.endswith(short) and not short[-1].isdigit() else None


def _same(column: str, quantity: str) -> bool:
    return column == quantity


def _same_word(column: str, quantity: str) -> bool:
    return _plain(column) == _plain(quantity)


def _same_last_word(column: str, quantity: str) -> bool:
    return _plain(re.split(r"[./]", column)[-1]) == _plain(quantity)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", "".join(GREEK.get(letter, letter) for letter in name.lower()))
