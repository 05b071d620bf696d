"""The networks of a posterior as files for numpy, with the coordinates that they are in."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import encoding_of
from simpel_cli.errors import ConfigError
from simpel_cli.export import predictor
from simpel_cli.runs.arrays import load_checkpoint, write_arrays
from simpel_cli.runs.files import write_text
from simpel_cli.studies.declared import Declared

NETWORKS = ("['state']", "['state'].networks")  # where a checkpoint has them


def write_posterior(into: Path, folder: Path, declared: Declared, index: int) -> None:
    """Write networks, normaliser and noise of one seed, their names and units, and the predictor that reads them.

    Args:
        into: folder of the files.
        folder: of the fit.
        declared: configuration of the fit.
        index: which of its seeds.

    Raises:
        ConfigError: the checkpoint is damaged, or the method has something other than networks.
    """
    leaves, kept = load_checkpoint(folder / "checkpoint")
    root = next((root for root in NETWORKS if f"{root}.particles[0][0]" in leaves), None)
    if root is None:
        raise ConfigError(
            f"{folder}: method={declared.choices.get('method')} has no networks alone that could be written; export takes "
            "simpel, fsvgd, map, repulsive, pathwise, svgd and ensemble. (The simulator was written.)"
        )
    method: Any = declared.method
    scale = {
        name: leaves[f"['problem']['normaliser'].{name}"][index] for name in ("x_mean", "x_std", "y_mean", "y_std")
    }
    rho, floor = (jnp.asarray(leaves[name][index]) for name in (f"{root}.noise", "['problem']['noise_floor']"))
    law = leaves.get("['problem']['tail']")
    noise = np.asarray(method.noise.std(rho, floor)) * scale["y_std"]
    arrays = scale | {"noise_std": noise if law is None else noise / np.sqrt(1 - 2 * law[index])}
    if (typical := leaves.get("['problem']['noise_rms']")) is not None:
        arrays["noise_rms"] = typical[index]
    count = sum(name.startswith(f"{root}.particles[") for name in leaves) // 2
    for i in range(count):
        arrays[f"kernel_{i}"] = leaves[f"{root}.particles[{i}][0]"][index]
        arrays[f"bias_{i}"] = leaves[f"{root}.particles[{i}][1]"][index]
    encoding = _encoding(declared, len(scale["y_mean"]))
    facts = {
        "format": "simpel posterior 1",
        "dt": declared.source.dt,
        "states": [{"name": q.name, "unit": q.unit, "angle": q.periodic} for q in encoding.states],
        "inputs": [{"name": q.name, "unit": q.unit} for q in encoding.inputs],
        "outputs": [{"name": q.name, "unit": q.unit} for q in encoding.outputs],
        "past_inputs": encoding.stack,
        "next_inputs": [encoding.inputs[i].name for i in encoding.linear],
        "activation": method.network.activation,
        "negative_slope": method.network.negative_slope,
        "network_inputs": "every state in order, an angle as its sine and cosine; then the inputs, oldest first; then those of "
        "next_inputs one step later, which are linear between rows (the others are held)",
        "network_outputs": [
            {"name": name, "unit": unit, "kind": kind}
            for name, unit, kind in zip(encoding.y_names, encoding.y_units, encoding.y_kinds, strict=True)
        ],
        "noise": "noise_std is a standard deviation, of a typical row where noise_scale says how it goes with the row (over "
        "noise_rms, its typical value); of Student's t the scale is noise_std*sqrt(1 - 2/degrees_of_freedom)",
        "noise_scale": {name: str(formula) for name, formula in declared.measurements.noise_scale.items()},
        "degrees_of_freedom": None if law is None else [float(1 / tail) for tail in law[index]],
        "networks": len(arrays["bias_0"]),
        "seed": declared.settings.all_seeds[index],
        "step": kept.get("step"),
    }
    write_arrays(into / "posterior.safetensors", {name: np.asarray(a, np.float32) for name, a in arrays.items()}, {})
    write_text(into / "posterior.json", json.dumps(facts, indent=1))
    shutil.copyfile(Path(predictor.__file__), into / "predictor.py")


def _encoding(declared: Declared, width: int) -> Encoding:
    """Return the coordinates that the networks have: which outputs were measured shows in the columns of the data."""
    source, measurements = declared.source, declared.measurements
    for measured in (source.outputs, tuple(q for q in source.outputs if q.name in measurements.columns)):
        names = tuple(q.name for q in measured)
        encoding = encoding_of(source, names, measurements.stack_actions)
        if encoding.dim_y == width:
            return encoding
    raise ConfigError(f"sim.outputs: which of them the networks predict cannot be known from {width} targets.")
