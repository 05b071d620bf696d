"""A policy as files: weights as safetensors, a contract as JSON, and a runner that needs numpy and safetensors only."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from simpel_cli.control.agents.policy import Policy
from simpel_cli.control.plants import runner
from simpel_cli.control.task import Goal
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError
from simpel_cli.runs.arrays import read_arrays, write_arrays
from simpel_cli.runs.files import write_text


def contract(encoding: Encoding, goal: Goal, memory: int, dt: float) -> dict[str, Any]:
    """Return what a rig has to know of a policy: observations, actions, their order, units and limits."""
    return {
        "format": "simpel policy 1",
        "dt": dt,
        "states": [{"name": q.name, "unit": q.unit, "angle": q.periodic} for q in encoding.states],
        "commands": [
            {
                "name": q.name,
                "unit": q.unit,
                "low": low,
                "high": high,
                "between_rows": "linear" if i in encoding.linear else "held",
            }
            for i, (q, low, high) in enumerate(zip(encoding.inputs, goal.low, goal.high, strict=True))
        ],
        "past_commands": memory,
        "between_rows": "held: applied at once and kept for dt; linear: reached dt later, along a straight line",
        "observation": "every state in order, an angle as its sine and cosine; then the past commands, oldest first",
        "action": "tanh of the first half of the network's outputs, from [-1, 1] onto [low, high]",
    }


def save_policy(folder: Path, policy: Policy, facts: dict[str, Any]) -> None:
    """Write a policy and the runner beside it.

    Args:
        folder: made if missing.
        policy: one, not several.
        facts: its contract.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {"mean": policy.mean, "std": policy.std}
    for i, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel_{i}": kernel, f"bias_{i}": bias}
    write_arrays(folder / "policy.safetensors", {name: np.asarray(a, np.float32) for name, a in arrays.items()}, {})
    write_text(folder / "policy.json", json.dumps(facts, indent=1))
    shutil.copyfile(Path(runner.__file__), folder / "run_policy.py")


def load_policy(folder: Path) -> tuple[Policy, dict[str, Any]]:
    """Read a policy.

    Raises:
        ConfigError: it is missing or damaged.
    """
    try:
        facts = json.loads((folder / "policy.json").read_text())
        arrays = {name: jnp.asarray(a) for name, a in read_arrays(folder / "policy.safetensors")[0].items()}
        layers = tuple(
            (arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(sum(n.startswith("kernel_") for n in arrays))
        )
        return Policy(layers, arrays["mean"], arrays["std"]), facts
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(f"{folder}: holds no policy ({type(error).__name__}: {error}).") from error
