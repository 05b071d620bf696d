"""A first data YAML of files: what is sure as keys, what is not as questions in comments."""

from collections.abc import Sequence
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli.data.config import Measurements
from simpel_cli.data.estimation.derived_speeds import difference_kind
from simpel_cli.data.estimation.kinematics import Motion
from simpel_cli.data.importing.clock import Clock, clock_of
from simpel_cli.data.importing.columns import Column, columns_of, with_jumps
from simpel_cli.data.importing.episodes import Parts, parts_of
from simpel_cli.data.importing.match import Matched, is_usable, match
from simpel_cli.data.importing.text import Line, yaml_of
from simpel_cli.data.reader import read
from simpel_cli.data.recording import Source
from simpel_cli.data.summary import split_summary
from simpel_cli.data.tables.locate import locate
from simpel_cli.data.tables.table import Table, read_table
from simpel_cli.errors import SimpelError

MOST_COMPARED = 12  # columns, in the search for differences
IRREGULAR = 0.05  # of the steps


class Draft(NamedTuple):
    """A data YAML, and what to say of it.

    Args:
        yaml: its text.
        lines: label and text of what was found, for a terminal.
        questions: what only a person can tell; they stand in the YAML, too.
        reads: whether it reads with the simulator; None: there is none.
    """

    yaml: str
    lines: tuple[tuple[str, str], ...]
    questions: tuple[str, ...]
    reads: bool | None


class _Looked(NamedTuple):
    table: Table
    columns: list[Column]
    clock: Clock
    parts: Parts
    matched: Matched | None
    transitions: bool


def draft(files: Sequence[str], shown: Sequence[str], folder: Path, model: Source | None) -> Draft:
    """Look at files and write what a data YAML can say of them.

    Args:
        files: names or patterns, as typed.
        shown: the same as the YAML is to name them.
        folder: that relative names start from.
        model: simulator to compare the columns with.

    Raises:
        ConfigError, DataError: a file is not there, or cannot be read.
    """
    looked = _looked(files, folder, model)
    node, lines, asked = _keys(shown, looked, model)
    recording = fault = None
    if len(looked.clock.starts) and looked.parts.episode is None:
        fault = "its episodes have no names, see the questions"
    elif model is not None:
        try:
            trial: dict[str, Any] = {
                k: tuple(v) if isinstance(v, list) else v for k, v in (node | {"path": list(files)}).items()
            }
            recording = read(Measurements(**trial), model, folder, 0)
        except SimpelError as error:
            fault = " ".join(str(error).split())
    notes = list(looked.table.notes)
    if recording is not None:
        notes += [f"{check.name}: {check.detail}" for check in recording.checks if not check.ok]
    else:
        notes += _differences(looked)
    verdict = ""
    if model is not None:
        ends = f"reads: {split_summary(recording)}" if recording is not None else f"does not read yet: {fault}"
        verdict = f"With sim {model.name} it {ends}"
    text = yaml_of(lines, _listed(looked), notes, asked, verdict)
    said = _said(looked)
    if model is not None:
        said.append(("reads", split_summary(recording) if recording is not None else f"not yet: {fault}"))
    return Draft(text, tuple(said), tuple(asked), None if model is None else recording is not None)


def _looked(files: Sequence[str], folder: Path, model: Source | None) -> _Looked:
    found = [file for name in files for file in locate(name, folder)]
    table = read_table(tuple(file.path for file in found), [file.named for file in found])
    columns = columns_of(table)
    names = {column.name for column in columns}
    transitions = any(name.removeprefix("next_") in names for name in names if name.startswith("next_"))
    clock = Clock(None) if transitions else clock_of(columns, table.file, None if model is None else model.dt)
    parts = parts_of(table, columns, clock)
    ends = np.flatnonzero(table.file[1:] != table.file[:-1]) + 1
    columns = with_jumps(columns, np.union1d(ends, parts.starts))
    taken = {clock.column, parts.episode, parts.split}
    free = [c for c in columns if c.name not in taken and not (transitions and c.name.startswith("next_"))]
    return _Looked(table, columns, clock, parts, None if model is None else match(model, free), transitions)


def _keys(shown: Sequence[str], looked: _Looked, model: Source | None) -> tuple[dict[str, Any], list[Line], list[str]]:
    """The keys as a node, as lines of YAML, and the questions."""
    clock, parts, matched = looked.clock, looked.parts, looked.matched
    asked = [q for column in looked.columns for q in column.questions] + [*clock.questions, *parts.questions]
    node: dict[str, Any] = {"path": shown[0] if len(shown) == 1 else list(shown)}
    lines = [Line("path", node["path"])]
    computed = dict(matched.computed) if matched is not None else {}
    time, hint = _time(clock, parts, computed, asked)
    if computed:
        node["computed"] = computed
        lines.append(Line("computed", computed))
    if time is not None:
        node["time"] = time
        lines.append(Line("time", time, f"s; {_steps(clock)}"))
    elif hint:
        lines.append(Line("time", hint, "see the questions", active=False))
    if parts.episode is not None:
        node["episode"] = parts.episode
        lines.append(Line("episode", parts.episode, f"{parts.episodes} episodes"))
    if matched is not None:
        asked += matched.questions
        states = [q.name for q in model.states] if model is not None else []
        nothing = (
            not any(matched.columns.get(q.name) for q in (*model.states, *model.outputs))
            if model is not None
            else False
        )
        columns = {
            quantity: column
            for quantity, column in matched.columns.items()
            if column != quantity and (column is not None or quantity in states)
        }
        if nothing:
            template = ", ".join(f"{quantity}: {column or 'COLUMN'}" for quantity, column in matched.columns.items())
            lines.append(Line("columns", f"{{{template}}}", "see the questions", active=False))
        elif columns:
            node["columns"] = columns
            lines.append(Line("columns", columns))
    else:
        lines.append(
            Line("columns", "{QUANTITY: COLUMN, ...}", "which column is which quantity of your simulator", active=False)
        )
    if looked.transitions:
        node["layout"] = "transitions"
        lines.append(Line("layout", "transitions", "rows do not follow each other: there are columns next_..."))
    node["split"] = _split(parts, looked.transitions or (model is not None and not model.states))
    lines.append(Line("split", node["split"]))
    lines += _resampling(clock, time, model)
    return node, lines, asked


def _time(clock: Clock, parts: Parts, computed: dict[str, str], asked: list[str]) -> tuple[str | None, str]:
    """Column of the time in s; None: none is sure, and the column to propose."""
    if clock.column is None:
        return None, ""
    if len(clock.starts) and parts.episode is None:
        return None, clock.column
    if clock.unit == "s":
        return clock.column, ""
    if not is_usable(clock.column):
        asked.append(
            f"{clock.column} is in {clock.unit}, and time is read in s. Give the column a name of letters and digits, e.g. "
            f"clock, and write `computed: {{time_s: clock*{clock.factor:g}}}`, `time: time_s`."
        )
        return None, clock.column
    computed["time_s"] = f"{clock.column}*{clock.factor:g}"
    return "time_s", ""


def _split(parts: Parts, rows_stand_alone: bool) -> dict[str, Any]:
    if parts.split is not None:
        return {"column": parts.split}
    return {"test_fraction": 0.25, "by": "episode" if parts.episodes > 1 or rows_stand_alone else "time"}


def _resampling(clock: Clock, time: str | None, model: Source | None) -> list[Line]:
    if time is None or clock.dt is None:
        return []
    lines = []
    if model is None:
        lines.append(Line("resample", "DT", f"the dt of your simulator, s, if it is not {clock.dt:.4g}", active=False))
    elif abs(clock.dt / model.dt - 1) > 0.02:
        lines.append(
            Line("resample", model.dt, f"the dt of {model.name}; the rows are {clock.dt:.4g} s apart", active=False)
        )
    if clock.irregular > IRREGULAR and clock.gaps:
        lines.append(Line("max_gap", float(f"{3 * clock.dt:.2g}"), "s; longer steps cut an episode", active=False))
    return lines


def _steps(clock: Clock) -> str:
    text = f"steps of {clock.dt:.4g}"
    if clock.irregular > IRREGULAR:
        text += f" (median; {clock.irregular:.0%} differ)"
    return text + (f", {clock.gaps} gaps" if clock.gaps else "")


def _listed(looked: _Looked) -> list[tuple[str, str, str, str]]:
    """Name, unit, range and remarks of every column."""
    reasons = looked.matched.reasons if looked.matched is not None else {}
    of = {column: q for q, column in (looked.matched.columns if looked.matched is not None else {}).items() if column}
    sources = {
        new: formula.partition("*")[0] for new, formula in (looked.matched.computed if looked.matched else {}).items()
    }
    of |= {sources[new]: q for new, q in list(of.items()) if new in sources}
    roles = {looked.clock.column: "time", looked.parts.episode: "episode", looked.parts.split: "split"}
    rows = []
    for c in looked.columns:
        role = roles.get(c.name) or (f"is {of[c.name]}, {reasons[of[c.name]]}" if c.name in of else "")
        span = "" if c.values is None else f"{np.nanmin(c.values):.4g} to {np.nanmax(c.values):.4g}"
        rows.append((c.name, c.unit, span, "; ".join(filter(None, (role, *c.remarks)))))
    return rows


def _differences(looked: _Looked) -> list[str]:
    """Say which columns are plain differences of another one: they are no measurements of their own."""
    clock, table = looked.clock, looked.table
    numbers = [c for c in looked.columns if c.values is not None and not c.constant and np.isfinite(c.values).all()]
    numbers = [c for c in numbers if c.name not in (clock.column, looked.parts.episode)]
    if clock.column is None or len(numbers) > MOST_COMPARED:
        return []
    changes = np.flatnonzero(table.file[1:] != table.file[:-1]) + 1
    cuts = sorted({0, *changes.tolist(), *looked.parts.starts.tolist(), len(table)})
    time = table.numbers(clock.column) * clock.factor
    pieces = [slice(a, b) for a, b in pairwise(cuts) if b - a > 2]
    found = []
    for p, v in permutations(numbers, 2):
        motion = Motion(p.name, v.name, v.unit, [(time[s], p.values[s], v.values[s]) for s in pieces])  # type: ignore[index]
        if pieces and (kind := difference_kind(motion)):
            found.append(f"{v.name} is the {kind} difference of {p.name}, and no measurement of its own (`derived`)")
    return found


def _said(looked: _Looked) -> list[tuple[str, str]]:
    clock, parts, table = looked.clock, looked.parts, looked.table
    files = table.sheets[0].path.name if len(table.sheets) == 1 else f"{len(table.sheets)} files"
    lines = [("read", f"{files}   {len(table)} rows, {len(looked.columns)} columns")]
    lines.append(("time", "not sure" if clock.column is None else f"{clock.column}, {clock.unit}; {_steps(clock)} s"))
    named = f"{parts.episodes}, named by {parts.episode}" if parts.episode else f"{parts.episodes}"
    lines.append(("episodes", named))
    for quantity, column in (looked.matched.columns if looked.matched is not None else {}).items():
        reason = looked.matched.reasons.get(quantity, "") if looked.matched is not None else ""
        lines.append(
            ("matched" if column else "open", f"{quantity}: {column}   {reason}".rstrip() if column else quantity)
        )
    return lines
