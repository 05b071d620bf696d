"""`simpel export RUN_DIR`: the simulator for CasADi and as C, the posterior for numpy; an MPC or a rig needs no simpel.

export/simulator.yaml        the `sim:` node, as `simpel` reads it
export/simulator.json        names, units, ranges and values of x, u, p and of what comes out
export/simulator.casadi      casadi.Function.load: (x, u, p) -> (next, y), one transition
export/simulator.c, .h       the same in C, without dependencies
export/posterior.json, posterior.safetensors, predictor.py      networks, see `simpel_cli.export.predictor`
"""

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi
import jax.numpy as jnp
import numpy as np

from simpel_cli.config.nodes import build
from simpel_cli.config.resolved import dump, load, of_run
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError
from simpel_cli.export import predictor
from simpel_cli.runs.arrays import load_checkpoint, write_arrays
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, typed
from simpel_cli.runs.files import replacing, write_text
from simpel_cli.runs.manifest import read_manifest
from simpel_cli.runs.settings import Settings
from simulators.model import Model, ModelError

VERBS = {"fit": ".", "discover": ".", "rl-offline": "posterior"}
NETWORKS = ("['state']", "['state'].networks")  # where a checkpoint has them


def export(run: Path, out: Path | None = None, seed: int | None = None) -> None:
    """Write the files.

    Args:
        run: directory of a fit, a discovery or a policy.
        out: folder; None: `export` in the run's own.
        seed: of several that a run has fitted; None: the first.

    Raises:
        ConfigError: not a finished run, or none of that seed.
    """
    record = read_manifest(run)
    verb = str(record.get("command"))
    if verb not in VERBS:
        raise ConfigError(
            f"{run}: made by `simpel {verb}`; export takes the directory of {', '.join(VERBS)}. Every round of an online run "
            "has one, rounds/NNN/posterior."
        )
    if record.get("status") != "done":
        raise ConfigError(
            f"{run}: {record.get('status')}, not done. Go on with it first: simpel {verb} --resume {typed(run)}"
        )
    folder = run / VERBS[verb]
    config = of_run(folder)
    settings = build(config.get("run") or {}, "run", default=Settings)
    into = make_directory(out if out is not None else run / "export", "--out")
    terminal = Terminal(quiet=False)
    sim, values, told = _simulator_of(run, config, verb)
    source = _built(sim, settings)
    if isinstance(source, Model):
        _write_simulator(into, source, sim, values)
        terminal.line(f"{into / 'simulator.casadi'}, .c, .h, .json, .yaml ({told})", "simulator")
    else:
        terminal.line("a world without equations: there is nothing to write for CasADi and C", "simulator")
    if verb != "discover":
        index = _index(settings, seed)
        _write_posterior(into, folder, config, source, settings, index)
        terminal.line(f"{into / 'posterior.safetensors'}, .json, predictor.py (numpy only)", "posterior")


def _simulator_of(run: Path, config: dict[str, Any], verb: str) -> tuple[dict[str, Any], dict[str, float], str]:
    """Return the `sim:` node, values of its parameters, and what it is."""
    if verb != "discover":
        return config["sim"], {}, "as declared: its parameters are uncertain, values are the middle of their ranges"
    try:
        verdict = json.loads((run / "verdict.json").read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{run / 'verdict.json'}: not readable ({error}).") from error
    values = {name: own["after"]["value"] for name, own in (verdict.get("parameters") or {}).items()}
    for effect in verdict.get("effects") or []:
        values |= {name: own["value"] for name, own in (effect.get("parameters") or {}).items()}
    written = verdict.get("corrected_sim")
    if not written:
        return config["sim"], values, f"verdict `{verdict.get('verdict')}`: nothing was added; parameters as calibrated"
    path = run / "conf" / "sim" / Path(written).name
    return load(path), values, "corrected; parameters as identified"


def _built(sim: dict[str, Any], settings: Settings) -> Any:
    try:
        return build(sim, "sim", settings.plugins).model()
    except ModelError as error:
        raise ConfigError(str(error)) from error


def _write_simulator(into: Path, model: Model, sim: dict[str, Any], values: Mapping[str, float]) -> None:
    from simulators.step import one_step

    step = one_step(model)
    write_text(into / "simulator.yaml", dump(sim))
    write_text(into / "simulator.json", json.dumps(_facts(model, values), indent=1))
    with replacing(into / "simulator.casadi") as temporary:
        step.save(str(temporary))
    with tempfile.TemporaryDirectory(dir=into, prefix=".c-") as name:
        code = casadi.CodeGenerator("simulator.c", {"with_header": True})
        code.add(step)
        code.generate(f"{name}/")
        for made in Path(name).iterdir():
            made.replace(into / made.name)


def _facts(model: Model, values: Mapping[str, float]) -> dict[str, Any]:
    def told(group: tuple[Any, ...]) -> list[dict[str, Any]]:
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
        }
        for q in model.params
    ]
    return {
        "format": "simpel simulator 1",
        "name": model.name,
        "function": f"{model.name}_step",
        "signature": "(x, u, p) -> (next, y), columns",
        "dt": model.dt,
        "x": told(model.states),
        "u": told(model.inputs),
        "past_inputs": model.past(),
        "u_order": "inputs of the past_inputs steps before and of this one, oldest first",
        "p": parameters,
        "next": "x one dt later; an angle is not wrapped",
        "y": told(model.outputs),
        "known": model.fixed,
    }  # fmt: skip


def _write_posterior(
    into: Path, folder: Path, config: dict[str, Any], source: Any, settings: Settings, index: int
) -> None:
    leaves, facts = load_checkpoint(folder / "checkpoint")
    root = next((root for root in NETWORKS if f"{root}.particles[0][0]" in leaves), None)
    if root is None:
        raise ConfigError(
            f"{folder}: method={config['choices'].get('method')} has no networks alone that could be written; export takes "
            "simpel, fsvgd, map, repulsive, pathwise, svgd and ensemble. (The simulator was written.)"
        )
    method = build(config["method"], "method", settings.plugins)
    scale = {
        name: leaves[f"['problem']['normaliser'].{name}"][index] for name in ("x_mean", "x_std", "y_mean", "y_std")
    }
    rho, floor = (jnp.asarray(leaves[name][index]) for name in (f"{root}.noise", "['problem']['noise_floor']"))
    arrays = scale | {"noise_std": np.asarray(method.noise.std(rho, floor)) * scale["y_std"]}
    count = sum(name.startswith(f"{root}.particles[") for name in leaves) // 2
    for i in range(count):
        arrays[f"kernel_{i}"] = leaves[f"{root}.particles[{i}][0]"][index]
        arrays[f"bias_{i}"] = leaves[f"{root}.particles[{i}][1]"][index]
    encoding = _encoding(config, source, len(scale["y_mean"]))
    told = {
        "format": "simpel posterior 1",
        "dt": source.dt,
        "states": [{"name": q.name, "unit": q.unit, "angle": q.periodic} for q in encoding.states],
        "inputs": [{"name": q.name, "unit": q.unit} for q in encoding.inputs],
        "outputs": [{"name": q.name, "unit": q.unit} for q in encoding.outputs],
        "past_inputs": encoding.stack,
        "negative_slope": method.network.negative_slope,
        "network_inputs": "every state in order, an angle as its sine and cosine; then the inputs, oldest first",
        "network_outputs": [
            {"name": name, "unit": unit, "kind": kind}
            for name, unit, kind in zip(encoding.y_names, encoding.y_units, encoding.y_kinds, strict=True)
        ],
        "networks": len(arrays["bias_0"]),
        "seed": settings.all_seeds[index],
        "step": facts.get("step"),
    }
    write_arrays(into / "posterior.safetensors", {name: np.asarray(a, np.float32) for name, a in arrays.items()}, {})
    write_text(into / "posterior.json", json.dumps(told, indent=1))
    shutil.copyfile(Path(predictor.__file__), into / "predictor.py")


def _encoding(config: dict[str, Any], source: Any, width: int) -> Encoding:
    """Return the coordinates that the networks have: which outputs were measured shows in the columns of the data."""
    stack = int(config["data"].get("stack_actions") or 0)
    for measured in (
        source.outputs,
        tuple(q for q in source.outputs if q.name in (config["data"].get("columns") or {})),
    ):
        encoding = Encoding(states=source.states, inputs=source.inputs, outputs=measured, stack=stack)
        if encoding.dim_y == width:
            return encoding
    raise ConfigError(f"sim.outputs: which of them the networks predict cannot be told from {width} targets.")


def _index(settings: Settings, seed: int | None) -> int:
    if seed is None:
        return 0
    if seed not in settings.all_seeds:
        raise ConfigError(f"--seed: got {seed}; the run has {', '.join(map(str, settings.all_seeds))}.")
    return settings.all_seeds.index(seed)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
