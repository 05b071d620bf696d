"""Named arrays with facts beside them: safetensors plus JSON, with a checksum. Nothing is ever unpickled."""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simpel_cli.errors import ConfigError
from simpel_cli.runs.files import replacing


def save_checkpoint(directory: Path, leaves: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
    """Write `state.safetensors` and the JSON facts inside its header, as one atomic file."""
    directory.mkdir(exist_ok=True)
    for stale in directory.glob(".*.tmp"):  # what a kill left of an earlier write
        stale.unlink(missing_ok=True)
    write_arrays(directory / "state.safetensors", leaves, facts)


def load_checkpoint(directory: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read a checkpoint's arrays and facts.

    Raises:
        ConfigError: missing, truncated or not a checkpoint of simpel.
    """
    path = directory / "state.safetensors"
    if not path.is_file():
        raise ConfigError(f"{path}: no checkpoint. The run stopped before its first one; start it again.")
    try:
        arrays, facts = read_arrays(path)
        if not facts:
            raise ValueError("it has no facts of a run")
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: damaged or not a checkpoint of simpel ({error}). Restore it or fit again."
        ) from error
    return arrays, facts


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write arrays as safetensors, atomically, with JSON facts and the SHA-256 of both in the header."""
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    contiguous = {name: np.asarray(a, order="C") for name, a in arrays.items()}
    # under one key: safetensors writes several in any order, and the same results are to be the same bytes
    header = {"simpel": json.dumps({**facts, "sha256": _digest(contiguous, facts)})}
    with replacing(path) as temporary:
        try:
            save_file(contiguous, temporary, metadata=header)
        except SafetensorError as error:
            if found := re.search(r"os error (\d+)", str(error)):  # of the disk, not of what is written
                raise OSError(int(found[1]), os.strerror(int(found[1])), str(path.parent)) from error
            raise


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read arrays and facts of `write_arrays`.

    Raises:
        OSError: it cannot be opened.
        ValueError: cut off, or changed since it was written.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            facts = json.loads((file.metadata() or {}).get("simpel", "{}"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            known = facts.pop("sha256", None)  # none in files of earlier versions
    except (SafetensorError, AttributeError, TypeError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    if known is not None and known != _digest(arrays, facts):
        raise ValueError("it is not what was written: the SHA-256 differs")
    return arrays, facts


def _digest(arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> str:
    """Return the SHA-256 of facts, and of every array's name, type, shape and values."""
    digest = hashlib.sha256(json.dumps(facts).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
