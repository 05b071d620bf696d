"""What a simulator's YAML says, in lines for a reader: equations, tables, sensors, roles of the states."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simulators.effects import structure
from simulators.model import Model
from simulators.quantity import READING
from simulators.table_files import READ_FROM


def equations(sim: Mapping[str, Any]) -> list[str]:
    """Return `name = expression` of derived parameters, intermediates, tables, rates and readings.

    Where terms are added to another simulator (`simulators.extended`), its equations come first.
    """
    base = sim.get("base")
    if isinstance(base, Mapping):
        lines = equations(base)
        inputs = {k: v for k, v in (sim.get("inputs") or {}).items() if isinstance(v, Mapping) and "value" in v}
        lines += [f"{name} acts as {node['value']}" for name, node in inputs.items()]
        lines += [f"d{name}/dt = rate_{name} + {term}" for name, term in (sim.get("dynamics") or {}).items()]
        return lines + of_sensors(sim)
    parameters = sim.get("parameters") or {}
    lines = [f"{name} = {node}" for name, node in parameters.items() if isinstance(node, str)]
    lines += [f"{name} = {_expression(node)}{_unit(node)}" for name, node in (sim.get("intermediates") or {}).items()]
    for name, node in (sim.get("tables") or {}).items():
        lines.append(f"{name} = table of {', '.join(map(str, node['inputs']))}{_unit(node)}")
    lines += [f"d{name}/dt = {formula}" for name, formula in (sim.get("dynamics") or {}).items()]
    return lines + [_reading(name, node) for name, node in (sim.get("outputs") or {}).items()] + of_sensors(sim)


def tables(sim: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for each table: name, unit, inputs, method, nodes, values, file."""
    base = sim.get("base")
    rows: list[tuple[str, ...]] = tables(base) if isinstance(base, Mapping) else []
    for name, node in (sim.get("tables") or {}).items():
        nodes = " x ".join(str(len(axis)) for axis in node["axes"])
        values = [float(value) for row in node["values"] for value in (row if isinstance(row, list | tuple) else [row])]
        rows.append((
            name,
            str(node.get("unit", "1")),
            ", ".join(map(str, node["inputs"])),
            str(node.get("method", "linear")),
            nodes,
            f"{min(values):g} to {max(values):g}",
            Path(str((node.get(READ_FROM) or {}).get("file", ""))).name,
        ))  # fmt: skip
    return rows


def roles_of(model: Any) -> dict[str, str]:
    """Return the role of each state, and that it was inferred where it was not declared. First-order ones have none."""
    if not isinstance(model, Model):
        return {}
    read = structure(model)
    roles = dict.fromkeys(read.kinematic, "position") | dict.fromkeys(read.velocity, "velocity")
    roles = {name: f"{role} (inferred: {read.inferred[name]})" for name, role in roles.items() if name in read.inferred}
    said = {q.name: "lagging reading" if q.role == READING else q.role for q in model.states if q.role}
    return roles | said


def _expression(node: Any) -> str:
    return str(node.get("expression", "") if isinstance(node, Mapping) else node)


def _unit(node: Any) -> str:
    unit = node.get("unit") if isinstance(node, Mapping) else None
    return f"   [{unit}]" if unit and unit != "1" else ""


def _reading(name: str, node: Any) -> str:
    """Return what is read: scale*(expression) + bias, its ends and its lag."""
    own = node if isinstance(node, Mapping) else {}
    text = _expression(node)
    if "scale" in own:
        text = f"{own['scale']}*{text if text.isidentifier() else f'({text})'}"
    bias = str(own.get("bias", 0))
    text = f"{text} - {bias[1:]}" if bias.startswith("-") else text if bias == "0" else f"{text} + {bias}"
    extra = []
    if "saturates" in own:
        low, high = ("no end" if end is None else str(end) for end in own["saturates"])
        extra.append(f"saturates at {low} and {high}")
    extra += [f"follows with a lag of {_seconds(own['lag'])}"] if "lag" in own else []
    return f"{name} = {text}{_unit(node)}" + (f"   ({'; '.join(extra)})" if extra else "")


def of_sensors(sim: Mapping[str, Any]) -> list[str]:
    """Return what the columns of states and outputs show: `the sensor of NAME shows VALUE`, its lag and its delay."""
    lines = []
    for name, node in (sim.get("sensors") or {}).items():
        extra = [f"follows with a lag of {_seconds(node['lag'])}"] if "lag" in node else []
        extra += [f"is late by {_seconds(node['delay'])}"] if "delay" in node else []
        lines.append(
            f"the sensor of {name} shows {node.get('value', name)}" + (f"   ({'; '.join(extra)})" if extra else "")
        )
    return lines


def _seconds(time: Any) -> str:
    return str(time) if isinstance(time, str) else f"{time} s"
