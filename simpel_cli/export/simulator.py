"""A simulator as files: CasADi function, C code, names and units as JSON, the `sim:` node as YAML."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from simpel_cli.config.resolved import dump
from simpel_cli.runs.files import replacing, write_text
from simulators.model import Model


def write_simulator(
    into: Path,
    model: Model,
    sim: dict[str, Any],
    values: Mapping[str, float],
    groups: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write one step of a simulator for CasADi and C, its names and units, and its YAML.

    Args:
        into: folder of the files.
        model: the simulator.
        sim: its node, written as YAML.
        values: of parameters, where they are not the middle of their ranges.
        groups: parameters that differ -> `per`, the column of their groups, and `values` by the name of the group.
    """
    from simulators.step import one_step

    step = one_step(model)
    write_text(into / "simulator.yaml", dump(sim))
    write_text(into / "simulator.json", json.dumps(_facts(model, values, groups or {}), indent=1))
    with replacing(into / "simulator.casadi") as temporary:
        step.save(str(temporary))
    with tempfile.TemporaryDirectory(dir=into, prefix=".c-") as name:
        code = casadi.CodeGenerator("simulator.c", {"with_header": True})
        code.add(step)
        code.generate(f"{name}/")
        for made in Path(name).iterdir():
            made.replace(into / made.name)


def _facts(model: Model, values: Mapping[str, float], groups: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    def described(group: tuple[Any, ...]) -> list[dict[str, Any]]:
        return [
            {"name": q.name, "unit": q.unit, "angle": q.periodic, "low": _finite(q.low), "high": _finite(q.high)}
            for q in group
        ]

    parameters = [
        {
            "name": q.name,
            "unit": q.unit,
            "low": q.low,
            "high": q.high,
            "value": float(values.get(q.name, (q.low + q.high) / 2)),
            **groups.get(q.name, {}),
        }
        for q in model.params
    ]
    return {
        "format": "simpel simulator 1",
        "name": model.name,
        "function": f"{model.name}_step",
        "signature": "(x, u, p) -> (next, y), columns",
        "dt": model.dt,
        "x": described(model.states),
        "u": described(model.inputs),
        "past_inputs": model.past(),
        "next_inputs": [model.inputs[i].name for i in model.linear],
        "u_order": "inputs of the past_inputs steps before and of this one, oldest first; then next_inputs of the step after, "
        "which are linear between rows (the others are held)",
        "p": parameters,
        "next": "x one dt later; an angle is not wrapped",
        "y": described(model.outputs),
        "known": model.fixed,
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
