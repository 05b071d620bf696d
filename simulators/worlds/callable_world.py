"""Any Python function as a world: a simulator of the user's own that only answers queries."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from simulators.definitions import UNCERTAIN
from simulators.model import Declared, ModelError, Quantity
from simulators.quantity import VARIABLE
from simulators.sections import GAP, NUMBER, keys, named

Function = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class CallableWorld:
    """A function as a YAML file declares it; the fields are the YAML keys.

    Args:
        name: letters, digits and single underscores.
        dt: duration of one transition, s.
        function: `package.module.function`; from YAML, its package must be named in `run.plugins`. It maps states
            (n, ds), inputs (n, du) and parameters (n, dp), in the order of the declaration, to the states dt later.
        batched: the function takes n queries at once; false: one query at a time, as vectors (ds,), (du,), (dp,).
        states: name: {unit, range, periodic}.
        inputs: name: {unit, range}.
        parameters: name: {unit, range, prior}.
        gap: state: expected error of one transition, in its unit.

    """

    name: str
    dt: float
    function: Callable[..., Any]
    batched: bool = True
    states: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    gap: dict[str, Any] = field(default_factory=dict)

    sections: ClassVar[dict[str, Any]] = {  # JSON schemas of fields
        "dt": NUMBER,
        "states": named(keys(VARIABLE, ("range",))),
        "inputs": named(keys(VARIABLE, ("range",))),
        "parameters": named(keys(UNCERTAIN, ("range",))),
        "gap": GAP,
    }

    def model(self) -> "QueriedFunction":
        """Check everything and build the world.

        Raises:
            ModelError: names the key, what it holds, what is allowed and the cure.

        """
        # units, ranges, priors, names and gap obey the rules of a model: let it read them
        q = Declared(
            self.name,
            self.dt,
            states=self.states,
            inputs=self.inputs,
            parameters=self.parameters,
            dynamics=dict.fromkeys(self.states, "0"),
            gap=self.gap,
        ).model()
        if q.fixed:
            raise ModelError(
                f"sim.parameters.{next(iter(q.fixed))}: a known number is no matter of a function's parameters; "
                "give a range, or put the number into the function"
            )
        return QueriedFunction(q.name, q.dt, q.states, q.inputs, q.params, q.gap, self.function, self.batched)


@dataclass(frozen=True)
class QueriedFunction:
    """A function that answers queries; see `simulators.worlds.world.World` and `CallableWorld` for the fields."""

    name: str
    dt: float
    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    params: tuple[Quantity, ...]
    gap: dict[str, float]
    function: Function
    batched: bool

    outputs: tuple[Quantity, ...] = ()

    def step(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Answer n queries; see `World.step`.

        Raises:
            ModelError: the function returns another shape than (n, ds).

        """
        if self.batched:
            after = np.asarray(self.function(states, inputs, params), dtype=float)
        else:
            rows = zip(states, inputs, params, strict=True)
            after = np.array([np.asarray(self.function(*row), dtype=float) for row in rows])
        if after.shape != states.shape:
            raise ModelError(
                f"sim.function: {self.name} returned an array of shape {after.shape} for {len(states)} queries of "
                f"{[q.name for q in self.states]}; it must return {states.shape}. Is `batched` right?"
            )
        return after
