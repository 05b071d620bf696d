"""The filter's course along windows, without errors ahead: one compiled program."""

from functools import lru_cache, partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from simpel_cli.filtering.likelihood.coordinates import Coordinates
from simpel_cli.filtering.likelihood.filter import MOST_KEPT
from simpel_cli.filtering.likelihood.track import Filter, Track
from simpel_cli.filtering.measurements.windows import Windows
from simpel_cli.filtering.setup import Setup
from simpel_cli.runs.programs import Program


@runtime_checkable
class Tracking(Protocol):
    """Whatever runs a setup's filter along windows."""

    plan: Setup

    def track(self, z: np.ndarray, windows: Windows) -> Track:
        """Return the track of the model at unit coordinates z, (W, T, ...) each."""
        ...


class Tracks:
    """Runs one model's filter along windows."""

    def __init__(self, plan: Setup) -> None:
        self.plan = plan
        self._program = _program(plan.rule, plan.coordinates.layout)

    def track(self, z: np.ndarray, windows: Windows) -> Track:
        """Return the track of the model at unit coordinates z, (W, T, ...) each."""
        bounds = tuple(jnp.asarray(a) for a in self.plan.coordinates.bounds)
        with jax.enable_x64(True):
            found: Track = jax.tree.map(np.asarray, self._program(bounds, jnp.asarray(z), *windows.arrays))
        return found


@lru_cache(maxsize=MOST_KEPT)
def _program(rule: Filter, layout: tuple[Any, ...]) -> Program:
    every = jax.vmap(partial(_window, rule, layout), in_axes=(None, None, 0, 0, 0, 0, 0))
    return Program(every, f"track of {rule.name} {layout}", (Track,))


def _window(rule: Filter, layout: tuple[Any, ...], bounds: tuple[Array, ...], z: Array, *window: Array) -> Track:
    return rule.track(*Coordinates.of(bounds, layout).physical(z), *window)[0]
