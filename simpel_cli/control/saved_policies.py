"""What a training of policies leaves on disk: how far it is, and the policies of every seed."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from simpel_cli.control.assignment import Assignment
from simpel_cli.control.plants.policy_files import contract, save_policy
from simpel_cli.control.training import TrainedPolicies
from simpel_cli.errors import ConfigError
from simpel_cli.runs.arrays import load_checkpoint
from simpel_cli.studies.fit import Learned


def save_policies(directory: Path, model: Learned, asked: Assignment, trained: TrainedPolicies) -> None:
    """Write the policies of every seed; that of the seed with the largest return in the model as `policy`."""
    study = model.study
    facts = contract(study.system.encoding, asked.goal, asked.memory, study.system.source.dt)
    best = int(np.argmax(trained.model_returns))
    for i, seed in enumerate(study.settings.all_seeds):
        folder = directory / "policy" if i == best else directory / f"policy_seed_{seed}"
        save_policy(folder, of_seed(trained.policies, i), facts)


def done_steps(directory: Path) -> int | None:
    """Return the steps of the world at the checkpoint, if there is one.

    Raises:
        ConfigError: it is damaged.
    """
    if not (directory / "checkpoint" / "state.safetensors").exists():
        return None
    try:
        return int(load_checkpoint(directory / "checkpoint")[1]["world_steps"])
    except ConfigError as error:
        raise ConfigError(
            f"{error} Or delete {directory / 'checkpoint'}, and the policy alone is trained anew on --resume."
        ) from error


def of_seed(tree: Any, i: int) -> Any:
    """Return the i-th of leaves (seeds, ...)."""
    return jax.tree.map(lambda a: a[i], tree)
