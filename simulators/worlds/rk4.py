"""A symbolic model asked like a world: one transition is `substeps` steps of the classical Runge-Kutta method."""

from dataclasses import dataclass
from functools import cached_property

import casadi
import numpy as np

from simulators.model import Model, ModelError


@dataclass(frozen=True, eq=False)
class RK4:
    """Integrator of a symbolic model, vectorised over queries.

    Args:
        model: the symbolic model.

    """

    model: Model

    def __post_init__(self) -> None:
        """Refuse inputs with a memory: a query has no past."""
        for key, times in (("delay", self.model.delay), ("lag", self.model.lag)):
            for name in times:
                raise ModelError(
                    f"sim.inputs.{name}.{key}: a simulator asked for single transitions cannot hold inputs back; leave the "
                    f"{key} out, or take a MuJoCo world, whose inputs may have one"
                )

    def step(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Integrate n queries over dt: states (n, dx), inputs (n, du), params (n, dp) -> (n, dx), not wrapped."""
        h = self.model.dt / self.model.substeps
        x = np.asarray(states, float)
        for _ in range(self.model.substeps):
            k1 = self._evaluate(x, inputs, params)[0]
            k2 = self._evaluate(x + h / 2 * k1, inputs, params)[0]
            k3 = self._evaluate(x + h / 2 * k2, inputs, params)[0]
            k4 = self._evaluate(x + h * k3, inputs, params)[0]
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    def measure(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Return the outputs at n points, (n, dy)."""
        return self._evaluate(states, inputs, params)[1]

    @cached_property
    def _function(self) -> casadi.Function:
        return self.model.function()

    def _evaluate(self, *arguments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = len(arguments[0])
        dx, y = self._function.map(n)(*(casadi.DM(np.asarray(a, float).T) for a in arguments))
        return dx.full().T, y.full().T
