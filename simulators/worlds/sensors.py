"""What sensors make of the true values, in this order: noise, wrapped angles, steps, ends, missing cells."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi
import numpy as np

from simulators.model import ModelError, Quantity
from simulators.quantity import check_word, read_term
from simulators.worlds.streams import Streams

LAWS = ("gaussian", "student_t")
Ends = tuple[float | None, ...]


@dataclass(frozen=True)
class NoiseLaw:
    """The law of a sensor's noise; its scale is `noise_std`.

    Args:
        law: `gaussian`, or `student_t`, which has heavy tails.
        degrees_of_freedom: of student_t, above 0; the smaller, the heavier the tails. The standard deviation is
            noise_std * sqrt(degrees_of_freedom/(degrees_of_freedom - 2)), infinite at 2 or less.

    """

    law: str = "gaussian"
    degrees_of_freedom: float | None = None

    def check(self, path: str) -> None:
        """Refuse what is not allowed."""
        check_word(f"{path}.law", self.law, LAWS)
        given = self.degrees_of_freedom
        if self.law == "gaussian" and given is not None:
            raise ModelError(f"{path}.degrees_of_freedom: {given:g} given, but gaussian noise has none; leave it out")
        if self.law == "student_t" and (given is None or not 0 < given < math.inf):
            raise ModelError(f"{path}.degrees_of_freedom: {given} is not allowed; give a number above 0, e.g. 4")

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw n values of scale 1."""
        if self.degrees_of_freedom is None:
            return rng.normal(size=n)
        return rng.standard_t(self.degrees_of_freedom, size=n)

    def described(self) -> dict[str, Any]:
        """Return what the card says."""
        more = {} if self.degrees_of_freedom is None else {"degrees_of_freedom": self.degrees_of_freedom}
        return {"law": self.law} | more


@dataclass(frozen=True)
class Sensors:
    """The sensors of a data set.

    Args:
        streams: the randomness.
        noise_std: quantity -> scale of its noise, in its unit, or an expression of the true values at that instant;
            0 where left out.
        noise: quantity -> law; Gaussian where left out.
        quantisation: quantity -> step, in its unit.
        saturates: quantity -> lowest and highest value that it records, in its unit; None: no end.
        missing: quantity -> share of the cells that are NaN.

    """

    streams: Streams
    noise_std: Mapping[str, float | str] = field(default_factory=dict)
    noise: Mapping[str, NoiseLaw] = field(default_factory=dict)
    quantisation: Mapping[str, float] = field(default_factory=dict)
    saturates: Mapping[str, Ends] = field(default_factory=dict)
    missing: Mapping[str, float] = field(default_factory=dict)

    def check(self) -> None:
        """Refuse values that are not allowed; names are checked against the source (`check_expressions`)."""
        for name, std in self.noise_std.items():
            if not isinstance(std, str) and not 0 <= std < math.inf:
                raise ModelError(
                    f"simulation.noise_std.{name}: {std:g} is no standard deviation; give 0 or more, or an expression"
                )
        for name, law in self.noise.items():
            law.check(f"simulation.noise.{name}")
            if self.noise_std.get(name, 0) == 0:
                raise ModelError(
                    f"simulation.noise.{name}: a law without a scale; give simulation.noise_std.{name}, or leave it out"
                )
        for name, step in self.quantisation.items():
            if not 0 < step < math.inf:
                raise ModelError(f"simulation.quantisation.{name}: {step:g} is no step; give a number above 0")
        for name, ends in self.saturates.items():
            low, high = ends if len(ends) == 2 else (math.nan, math.nan)
            if not (-math.inf if low is None else low) < (math.inf if high is None else high):
                raise ModelError(
                    f"simulation.saturates.{name}: {list(ends)!r} is not allowed; write [low, high] with low < high, null "
                    "for no end"
                )
        for name, share in self.missing.items():
            if not 0 <= share < 1:
                raise ModelError(f"simulation.missing.{name}: {share:g} is no share; give 0 <= share < 1")

    def check_expressions(self, names: list[str]) -> None:
        """Read every expression of a scale once, in the names of states, inputs and outputs."""
        for name, std in self.noise_std.items():
            if isinstance(std, str):
                read_term(f"simulation.noise_std.{name}", std, {each: casadi.SX.sym(each) for each in names})

    def read(self, quantity: Quantity, true: Mapping[str, np.ndarray], number: int = 0, part: str = "") -> np.ndarray:
        """Return what the sensor of a quantity records, NaN where a cell is missing.

        Args:
            quantity: what is measured.
            true: name -> true values, (m,), of it and of all others at the same instants.
            number: of the episode.
            part: begins the names of the random streams; empty, or `next_` of the next states of layout transitions.

        """
        name, exact = quantity.name, true[quantity.name]
        law = self.noise.get(name, NoiseLaw())
        noise = law.draw(self.streams.of(f"{part}noise.{name}", number), len(exact))
        values = wrapped(quantity, exact + self._scale(name, true) * noise)
        if name in self.quantisation:
            step = self.quantisation[name]
            values = step * np.round(values / step) + 0.0  # no -0.0
        if name in self.saturates:  # after the steps, so that the ends are recorded as they are declared
            values = np.clip(values, *self._ends(name))
        if name in self.missing:
            lost = self.streams.of(f"{part}missing.{name}", number).uniform(size=len(values)) < self.missing[name]
            values = np.where(lost, np.nan, values)
        return values

    def planted(self, measured: list[str]) -> dict[str, Any]:
        """Return what the card says about the sensors of measured quantities: what is planted."""
        card: dict[str, Any] = {
            "noise": {name: law.described() for name, law in self.noise.items() if name in measured},
            "quantisation": {name: step for name, step in self.quantisation.items() if name in measured},
            "saturates": {name: list(ends) for name, ends in self.saturates.items() if name in measured},
            "missing": {name: share for name, share in self.missing.items() if name in measured},
        }
        return {key: value for key, value in card.items() if value}

    def _ends(self, name: str) -> tuple[float, float]:
        low, high = self.saturates[name]
        return -math.inf if low is None else low, math.inf if high is None else high

    def _scale(self, name: str, true: Mapping[str, np.ndarray]) -> float | np.ndarray:
        """Return the scale of the noise, one number or one per value."""
        given = self.noise_std.get(name, 0.0)
        if not isinstance(given, str):
            return given
        symbols = {each: casadi.SX.sym(each) for each in true}
        formula = read_term(f"simulation.noise_std.{name}", given, symbols)
        function = casadi.Function("scale", [casadi.vertcat(*symbols.values())], [formula])
        columns = casadi.DM(np.array([*true.values()]))
        found: np.ndarray = function.map(columns.shape[1])(columns).full()[0]
        bad = np.flatnonzero(~((found >= 0) & np.isfinite(found)))
        if len(bad):
            where = ", ".join(f"{each} = {values[bad[0]]:g}" for each, values in true.items() if each in given)
            raise ModelError(
                f"simulation.noise_std.{name}: {given} is {found[bad[0]]:g}{f' at {where}' if where else ''}; a scale is 0 "
                "or more, e.g. of abs(...)"
            )
        return found


def wrapped(quantity: Quantity, values: np.ndarray) -> np.ndarray:
    """Return an angle in [-pi, pi), anything else as it is."""
    return (values + np.pi) % (2 * np.pi) - np.pi if quantity.periodic else values
