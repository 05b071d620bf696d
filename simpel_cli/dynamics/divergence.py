"""The message for a simulator that returned NaN or inf: where it started, with which input and parameters."""

import numpy as np

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError
from simulators.model import Model, Quantity
from simulators.worlds.world import World


def divergence_error(
    source: Model | World, encoding: Encoding, x: np.ndarray, phi: np.ndarray, values: np.ndarray
) -> ConfigError:
    """Return the error; it names one point: of the draw that fails most often, the one least far out in the ranges.

    Args:
        source: the simulator.
        encoding: coordinates.
        x: inputs, (M, dx).
        phi: parameter draws, (n, dp).
        values: what came back, (n, M, anything).
    """
    bad = ~np.isfinite(values).all(axis=2)
    draw = int(bad.sum(axis=1).argmax())
    states, stacked = encoding.split_x(x)
    inputs = encoding.inputs_now(stacked)
    reach = np.concatenate([_reach(states, encoding.states), _reach(inputs, encoding.inputs)], axis=1).max(axis=1)
    point = int(np.where(bad[draw], reach, np.inf).argmin())
    start = "; ".join(
        f"{what} {_listed(group, row)}"
        for what, group, row in (
            ("state", encoding.states, states[point]),
            ("input", encoding.inputs, inputs[point]),
            ("parameters", source.params, phi[draw]),
        )
        if group
    )
    if isinstance(source, Model):
        cure = (
            "A root or logarithm of something negative, a division by zero, an integration that is unstable? Guard the "
            "expression, e.g. sqrt(max(h, 0)), raise sim.substeps, or narrow the ranges"
        )
    else:
        cure = "Narrow its ranges, or make it return finite states"
    return ConfigError(
        f"sim: {source.name} is not finite after one transition from {start} ({bad.sum()} of {bad.size} runs). {cure}."
    )


def _reach(values: np.ndarray, quantities: tuple[Quantity, ...]) -> np.ndarray:
    """How far values lie from the middle of their ranges, 1 at the ends, (n, len(quantities))."""
    low, high = (np.array([getattr(q, end) for q in quantities]) for end in ("low", "high"))
    return np.abs(2 * values - low - high) / np.maximum(high - low, 1e-300)


def _listed(quantities: tuple[Quantity, ...], row: np.ndarray) -> str:
    return ", ".join(f"{q.name} = {value:.6g} {q.unit}".rstrip() for q, value in zip(quantities, row, strict=True))
