"""Checkpoints of anything that learns: a tree of arrays, by the path of every leaf."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from simpel_cli.errors import ConfigError
from simpel_cli.runs.arrays import load_checkpoint, save_checkpoint


def keep(directory: Path, tree: Any, facts: dict[str, Any]) -> None:
    """Write the checkpoint of a run, atomically.

    Args:
        directory: of the run.
        tree: of arrays.
        facts: what else is to be known, fit for JSON.
    """
    arrays = {jax.tree_util.keystr(p): np.asarray(v) for p, v in jax.tree_util.tree_leaves_with_path(tree)}
    save_checkpoint(directory / "checkpoint", arrays, facts)


def restored(directory: Path, shape: Any) -> tuple[Any, dict[str, Any]]:
    """Return the tree that a run's checkpoint holds, and its facts.

    Args:
        directory: of the run.
        shape: tree of shapes and dtypes that this configuration needs.

    Raises:
        ConfigError: no checkpoint, a damaged one, or one of another configuration.
    """
    arrays, facts = load_checkpoint(directory / "checkpoint")
    paths, structure = jax.tree_util.tree_flatten_with_path(shape)
    found = []
    for path, expected in paths:
        name = jax.tree_util.keystr(path)
        array = arrays.get(name)
        if array is None or array.shape != expected.shape or array.dtype != expected.dtype:
            what = "missing" if array is None else f"{array.dtype}{list(array.shape)}"
            raise ConfigError(
                f"{directory / 'checkpoint'}: `{name}` is {what}; this configuration needs "
                f"{expected.dtype}{list(expected.shape)}. The checkpoint belongs to another configuration."
            )
        found.append(jax.numpy.asarray(array))
    return jax.tree_util.tree_unflatten(structure, found), facts
