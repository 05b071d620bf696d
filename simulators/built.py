"""A simulator whose equations are written in Python; its YAML declares quantities, ranges and fidelity."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from simulators.expression import ExpressionError, Symbol, symbols_used
from simulators.model import Declared, ModelError
from simulators.quantity import refuse_unknown
from simulators.sections import SECTIONS

FIDELITIES = ("low", "high")
SENSOR = ("scale", "bias", "lag")  # keys of an output that may name a parameter


@dataclass(frozen=True)
class Built(Declared, ABC):
    """Base of simulators in Python: the fields of `Declared`, without `dynamics`.

    A subclass says which names its equations use (`needed`) and returns the rates (`rates`), and, if a transition is not
    integrated in the states, its own coordinates (`own_coordinates`). Parameters that only others are derived from may
    have any name.
    """

    @abstractmethod
    def needed(self) -> dict[str, tuple[str, ...]]:
        """Return the names that the equations use: section (states, inputs, parameters) -> names, in any order."""

    @abstractmethod
    def rates(self, known: Mapping[str, Symbol]) -> list[Symbol]:
        """Return d(state)/dt in the order of the states, from what every name stands for."""

    sections: ClassVar[dict[str, Any]] = SECTIONS | {"dynamics": {"type": "object", "maxProperties": 0}}

    def _check_dynamics(self) -> None:
        kind = type(self).__name__
        if self.dynamics:
            raise ModelError(f"sim.dynamics: the equations of {kind} are its own; leave dynamics out")
        for section, names in self.needed().items():
            given = getattr(self, section)
            for name in names:
                if name not in given:
                    raise ModelError(f"sim.{section}: no {name}, which the equations of {kind} use; add `{name}: ...`")
            if section == "parameters":
                used = self._used()
                spare = [name for name in given if name not in names and name not in used]
            else:
                spare = [name for name in given if name not in names]
            if spare:
                refuse_unknown(f"sim.{section}.{spare[0]}", f"the equations of {kind} do not use it", spare[0], names)

    def _used(self) -> set[str]:
        """Return the names that derived parameters, intermediates, tables, outputs, delays and lags refer to, and sensors."""
        named = [*self.intermediates.values(), *self.outputs.values()]
        formulas = [node for node in self.parameters.values() if isinstance(node, str)]
        formulas += [str(node.get("expression", "") if isinstance(node, dict) else node) for node in named]
        formulas += [str(name) for node in self.tables.values() for name in dict(node).get("inputs", ())]
        times = [node.get(key) for node in self.inputs.values() for key in ("delay", "lag") if isinstance(node, dict)]
        numbers = [node.get(key) for node in self.outputs.values() for key in SENSOR if isinstance(node, dict)]
        times += [number for number in numbers if isinstance(number, str)]
        seen = [node for node in self.sensors.values() if isinstance(node, dict)]
        formulas += [str(node["value"]) for node in seen if "value" in node]
        times += [node.get(key) for node in seen for key in ("delay", "lag")]
        return {name for formula in formulas for name in symbols_in(formula)} | {t for t in times if isinstance(t, str)}


def symbols_in(formula: str) -> set[str]:
    """Return the names in a formula, none if it cannot be read: the message comes where it is used."""
    try:
        return symbols_used(formula)
    except ExpressionError:
        return set()
