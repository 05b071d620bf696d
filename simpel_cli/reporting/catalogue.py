"""`simpel sims` and `simpel effects`: what exists, with units and formulas, of simpel's own and of a user's folder."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from simpel_cli.config.groups import options
from simpel_cli.config.places import Layer, with_place
from simpel_cli.config.resolved import load
from simpel_cli.errors import ConfigError, SimpelError, did_you_mean
from simpel_cli.reporting.equations import equations, roles_of, tables
from simpel_cli.runs.console import Terminal, aligned
from simulators.quantity import ModelError
from simulators.table_files import with_files_read

WIDTH = 48  # of a list of names in the table
DECLARED = "simulators.model.Declared"


class Entry(NamedTuple):
    """An option of a group.

    Args:
        name: to choose it by.
        path: of its YAML.
        node: what that holds; empty: it is not readable, or only a list of others.
        comment: what the file says of itself in its first lines.
    """

    name: str
    path: Path
    node: dict[str, Any]
    comment: str


def sims(name: str | None, config_dir: Path | None, plugins: tuple[str, ...] = ()) -> None:
    """List the simulators, or show one with its equations.

    Raises:
        ConfigError: there is none of that name, or its YAML is wrong.
    """
    terminal = Terminal(quiet=False)
    every = _entries("sim", config_dir)
    if name is not None:
        _show_sim(terminal, _chosen("sim", name, every), plugins)
        return
    head = ("sim=", "states [unit]", "inputs [unit]", "uncertain", "description")
    rows = [
        (
            e.name,
            _listed(e.node.get("states") or e.node.get("outputs")),
            _listed(e.node.get("inputs")),
            _uncertain(e.node),
            _sentence(e.comment),
        )
        for e in every
        if e.node
    ]
    terminal.line(aligned(head, rows))
    terminal.line()
    terminal.line("simpel sims NAME shows ranges and equations; sim=NAME uses one.")


def effects(name: str | None, config_dir: Path | None) -> None:
    """List the effects that `discover` can add, or show one.

    Raises:
        ConfigError: there is none of that name.
    """
    terminal = Terminal(quiet=False)
    every = _entries("effect", config_dir)
    if name is not None:
        _show_effect(terminal, _chosen("effect", name, every))
        return
    head = ("effect", "acts on", "formula", "description")
    rows = [
        (e.name, _words(e.node.get("acts_on")), _formula(e.node), str(e.node.get("meaning", "")))
        for e in every
        if "name" in e.node
    ]
    terminal.line(aligned(head, rows))
    groups = [e.name for e in every if "name" not in e.node]
    terminal.line()
    terminal.line(f"effect=[NAME,...] limits the search to these effects; groups of effects: {', '.join(groups)}.")
    terminal.line("simpel effects NAME shows parameters and units.")


def _show_sim(terminal: Terminal, entry: Entry, plugins: tuple[str, ...]) -> None:
    from simpel_cli.config.build import build

    try:
        node = with_files_read(entry.node, [entry.path.parent, Path.cwd()])
        model = build(node, "sim", plugins).model()
    except (ModelError, ConfigError) as error:
        raise with_place(ConfigError(str(error)), [Layer(entry.path, ("sim",))]) from error
    terminal.line(entry.comment)
    terminal.line(str(entry.path), "file")
    terminal.line(f"{model.dt:g} s per transition, {getattr(model, 'substeps', 1)} substeps", "step")
    late = getattr(model, "delay", {}) | {f"{k} (lag)": v for k, v in getattr(model, "lag", {}).items()}
    if late:
        delays = ", ".join(f"{k} {v} s" if isinstance(v, float) else f"{k} {v}" for k, v in late.items())
        terminal.line(delays, "delays")
    roles = roles_of(model)
    for group in ("states", "inputs", "params", "outputs"):
        quantities = getattr(model, group, ())
        if quantities:
            terminal.line()
            head = ("parameter" if group == "params" else group[:-1], "unit", "from", "to", "")
            rows = [
                (
                    q.name,
                    q.unit,
                    _end(q.low),
                    _end(q.high),
                    ", ".join(filter(None, [_kind(q, roles), _given(q.name, model)])),
                )
                for q in quantities
            ]
            terminal.line(aligned(head, rows))
    if looked_up := tables(node):
        terminal.line()
        terminal.line(aligned(("table", "unit", "of", "method", "nodes", "values", "read from"), looked_up))
    fixed = getattr(model, "fixed", {})
    if fixed:
        terminal.line()
        terminal.line(", ".join(f"{k} = {v:g}" for k, v in fixed.items()), "known")
    terminal.line()
    target = str(entry.node.get("_target_", DECLARED))
    for line in equations(node):
        terminal.line(f"  {line}")
    if not entry.node.get("dynamics") and target != DECLARED:
        terminal.line(f"equations: {target}, in Python")
    if entry.node.get("gap"):
        terminal.line()
        terminal.line(", ".join(f"{k} {v:g}" for k, v in entry.node["gap"].items()), "gap")


def _show_effect(terminal: Terminal, entry: Entry) -> None:
    node = entry.node
    terminal.line(entry.comment)
    terminal.line(str(entry.path), "file")
    if "name" not in node:
        members = ", ".join(str(m) for m in node.get("defaults") or [])
        terminal.line(members, "group of")
        return
    terminal.line(_words(node.get("acts_on")), "acts on")
    if node.get("units"):
        terminal.line(_words(node["units"]), "units")
    terminal.line(_formula(node), "formula")
    rows = [
        (k, str(p.get("unit", "1")), *(str(end) for end in p.get("range", ("", ""))), str(p.get("neutral", 0)))
        for k, p in (node.get("parameters") or {}).items()
    ]
    terminal.line()
    terminal.line(aligned(("parameter", "unit", "from", "to", "no effect at"), rows))
    terminal.line(
        "Scales, computed from your data: A typical rate; V, S, X, U, Y largest velocity, position, state, input, measurement; "
        "W, Q largest and typical yaw rate of a vehicle; dt time between rows."
    )
    for key, meaning in (("same_as", "cannot be distinguished from"), ("generalises", "contains as a special case")):
        if node.get(key):
            terminal.line(f"{meaning}: {_words(node[key])}")


def _entries(group: str, config_dir: Path | None) -> list[Entry]:
    found = []
    for name, path in options(group, config_dir).items():
        node: dict[str, Any] = {}
        comment = ""
        try:
            node = load(path)
            comment = _comment(path)
        except SimpelError as error:
            comment = str(error)
        found.append(Entry(name, path, node, comment))
    return found


def _chosen(group: str, name: str, every: Sequence[Entry]) -> Entry:
    for entry in every:
        if entry.name == name:
            return entry if entry.node else entry._replace(node=load(entry.path))  # says what is wrong with the file
    names = [entry.name for entry in every]
    raise ConfigError(
        f"{group}: got {name}; there is no {group} of that name.{did_you_mean(name, names)} `simpel {group}s` lists them."
    )


def _comment(path: Path) -> str:
    """Return the comment that a YAML begins with, as one line."""
    lines = []
    for line in path.read_text().splitlines():
        if not line.startswith("#"):
            break
        if "@package" not in line and "yaml-language-server" not in line:
            lines.append(line.lstrip("# ").rstrip())
    return " ".join(filter(None, lines))


def _sentence(text: str) -> str:
    first = text.split(". ")[0].split(": ")[0].rstrip(".")
    return first if len(first) <= 2 * WIDTH else f"{first[: 2 * WIDTH]}..."


def _listed(quantities: Any) -> str:
    if not isinstance(quantities, Mapping):
        return "-"
    shown = []
    for name, node in quantities.items():
        unit = str(node.get("unit", "1")) if isinstance(node, Mapping) else "1"
        shown.append(name if unit == "1" else f"{name} [{unit}]")
    text = ""
    for i, word in enumerate(shown):
        if len(text) + len(word) > WIDTH:
            return f"{text}, and {len(shown) - i} more"
        text = f"{text}, {word}" if text else word
    return text or "-"


def _uncertain(node: Mapping[str, Any]) -> str:
    parameters = node.get("parameters")
    if not isinstance(parameters, Mapping):
        return "-"  # built in Python: `simpel sims NAME` lists them
    return str(sum(isinstance(p, Mapping) and "range" in p for p in parameters.values()))


def _formula(node: Mapping[str, Any]) -> str:
    term = node.get("term")
    if isinstance(term, Mapping):
        return "; ".join(f"{part}: {formula}" for part, formula in term.items())
    if term:
        return str(term)
    return f"{node.get('operator', '')}({', '.join(map(str, node.get('parameters') or {}))})"


def _words(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _end(value: float) -> str:
    return f"{value:g}" if math.isfinite(value) else "-"


def _given(name: str, model: Any) -> str:
    """Say what an input does between rows, which column knows it, or how late an output is recorded; nothing of others."""
    column = getattr(model, "covariates", {}).get(name)
    word = getattr(model, "between_rows", {}).get(name)
    if late := getattr(model, "latency", {}).get(name):
        return f"recorded {late:g} s after it is measured"
    if by := getattr(model, "per", {}).get(name):
        return f"differs per {by}"
    return f"known in every row: column {column}" if column else f"{word} between rows" if word else ""


def _kind(quantity: Any, roles: Mapping[str, str]) -> str:
    prior = getattr(quantity, "prior", "uniform")
    words = ["angle" if getattr(quantity, "periodic", False) else "", roles.get(quantity.name, "")]
    return ", ".join(filter(None, [*words, "" if prior == "uniform" else str(prior)]))
