"""Input signals that excite a system."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from simulators.model import ModelError, Quantity


class Excitation(Protocol):
    """A law of input signals."""

    def signal(self, rng: np.random.Generator, n_steps: int, dt: float, quantity: Quantity) -> np.ndarray:
        """Draw one signal.

        Args:
            rng: source of randomness.
            n_steps: its length.
            dt: s between two values, each of which is held.
            quantity: the input; the signal stays within its range.

        Returns:
            The signal, (n_steps,), in the unit of the input.

        """


@dataclass(frozen=True)
class Zero:
    """No excitation: a system that moves by itself."""

    def signal(self, rng: np.random.Generator, n_steps: int, dt: float, quantity: Quantity) -> np.ndarray:
        """Return zeros, (n_steps,)."""
        return np.zeros(n_steps)


@dataclass(frozen=True)
class HeldRandom:
    """Values uniform on the range of the input, each held for a random time.

    Args:
        shortest: least holding time, s.
        longest: greatest holding time, s.

    Raises:
        ModelError: not 0 < shortest <= longest.

    """

    shortest: float = 0.05
    longest: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.shortest <= self.longest:
            raise ModelError(
                f"excitation: shortest = {self.shortest:g} s, longest = {self.longest:g} s; "
                "give 0 < shortest <= longest"
            )

    def signal(self, rng: np.random.Generator, n_steps: int, dt: float, quantity: Quantity) -> np.ndarray:
        """Draw a signal, (n_steps,); a longer one begins with the shorter."""
        shortest, longest = (max(1, round(hold / dt)) for hold in (self.shortest, self.longest))
        values: list[float] = []
        while len(values) < n_steps:
            values += [rng.uniform(quantity.low, quantity.high)] * int(rng.integers(shortest, longest + 1))
        return np.array(values[:n_steps])


@dataclass(frozen=True)
class Multisine:
    """Sum of sines of equal amplitude and random phase, scaled so that its peak touches the range of the input.

    Args:
        lowest: least frequency, Hz.
        highest: greatest frequency, Hz; below 1/(2 dt).
        count: number of sines, their frequencies spaced geometrically.

    Raises:
        ModelError: not 0 < lowest < highest, or count < 2.

    """

    lowest: float = 0.1
    highest: float = 2.0
    count: int = 8

    def __post_init__(self) -> None:
        if not 0 < self.lowest < self.highest:
            raise ModelError(
                f"excitation: lowest = {self.lowest:g} Hz, highest = {self.highest:g} Hz; give 0 < lowest < highest"
            )
        if self.count < 2:
            raise ModelError(f"excitation.count: {self.count} sines; give at least 2")

    def signal(self, rng: np.random.Generator, n_steps: int, dt: float, quantity: Quantity) -> np.ndarray:
        """Draw a signal, (n_steps,).

        Raises:
            ModelError: `highest` is not below 1/(2 dt).

        """
        if self.highest >= 0.5 / dt:
            raise ModelError(
                f"excitation.highest: {self.highest:g} Hz cannot be held in steps of {dt:g} s; "
                f"give less than 1/(2 dt) = {0.5 / dt:g} Hz"
            )
        frequencies = np.geomspace(self.lowest, self.highest, self.count)
        phases = rng.uniform(0, 2 * np.pi, self.count)
        wave = np.sin(2 * np.pi * frequencies * dt * np.arange(n_steps)[:, None] + phases).sum(axis=1)
        middle, half = (quantity.high + quantity.low) / 2, (quantity.high - quantity.low) / 2
        # rounding must not carry the peak out of the range
        return np.clip(middle + half * wave / np.abs(wave).max(), quantity.low, quantity.high)


@dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """A noise that is pulled towards a mean which is drawn anew now and then: somebody at the wheel.

        u_{k+1} = clip(u_k + pull dt (mean - u_k) + noise sqrt(dt) N(0, 1)),   u_0 = 0

    Everything in halves of the input's range about its middle.

    Args:
        pull: 1/s.
        noise: per square root of a second.
        hold: s, for which a mean is held.
        means: input -> the means are uniform within so much of its range, 0 to 1; left out: 1.

    Raises:
        ModelError: a value that is not allowed.

    """

    pull: float = 3.0
    noise: float = 1.3693
    hold: float = 4 / 3
    means: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse values that are not allowed."""
        for key in ("pull", "noise", "hold"):
            if not getattr(self, key) > 0:
                raise ModelError(f"excitation.{key}: {getattr(self, key):g} is not positive")
        for name, share in self.means.items():
            if not 0 <= share <= 1:
                raise ModelError(
                    f"excitation.means.{name}: {share:g} is not allowed; give 0 to 1, a share of the range"
                )

    def signal(self, rng: np.random.Generator, n_steps: int, dt: float, quantity: Quantity) -> np.ndarray:
        """Draw a signal, (n_steps,); a longer one begins with the shorter."""
        held = max(1, round(self.hold / dt))
        share = self.means.get(quantity.name, 1.0)
        values, value, mean = np.empty(n_steps), 0.0, 0.0
        for k in range(n_steps):
            if k % held == 0:
                mean = rng.uniform(-share, share)
            value += self.pull * dt * (mean - value) + self.noise * np.sqrt(dt) * rng.normal()
            value = min(max(value, -1.0), 1.0)
            values[k] = value
        middle, half = (quantity.high + quantity.low) / 2, (quantity.high - quantity.low) / 2
        return np.clip(middle + half * values, quantity.low, quantity.high)
