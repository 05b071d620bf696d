"""The systems of the exam as they are without anything planted: own right-hand sides, own excitation, own controllers.

The tool gets the same equations in YAML (`nominal/`); a test compares the two. Every function works on a batch.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

GRAVITY = 9.81  # m/s^2
AXLES = 0.3  # m
AMBIENT = 20.0  # degC
MIDDLE = 0.7  # of a parameter's range in which the truth lies

Parameters = Mapping[str, float]


class System(NamedTuple):
    """One system.

    Args:
        dt: s, distance of the rows.
        states, inputs: names.
        ranges: parameter -> the range that the tool is told.
        limits: (low, high) per input.
        held: rows for which a command stays, (least, most).
        position: what is measured where "only the position" is.
        driven: states that process noise acts on.
        velocity: derived velocity -> the position that it is the rate of.
        rate: (x (..., nx), u (..., nu), parameters) -> dx/dt (..., nx).
        low, high: of the first state.
        feedback: (x (..., nx), reference (..., nu) within -1..1) -> u (..., nu); cut to the limits later.
    """

    name: str
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    ranges: dict[str, tuple[float, float]]
    limits: tuple[tuple[float, float], ...]
    held: tuple[int, int]
    position: tuple[str, ...]
    driven: tuple[str, ...]
    velocity: dict[str, str]
    rate: Callable[[np.ndarray, np.ndarray, Parameters], np.ndarray]
    low: tuple[float, ...]
    high: tuple[float, ...]
    feedback: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def parameters(self, random: np.random.Generator) -> dict[str, float]:
        """Draw the true parameters from the middle of their ranges."""
        return {n: (a + b) / 2 + MIDDLE * (b - a) * random.uniform(-0.5, 0.5) for n, (a, b) in self.ranges.items()}

    def start(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Draw first states, (count, nx)."""
        return random.uniform(self.low, self.high, (count, len(self.states)))

    def commands(self, random: np.random.Generator, count: int, rows: int) -> np.ndarray:
        """Draw commands that are held for a while, (count, rows, nu)."""
        u = np.empty((count, rows, len(self.inputs)))
        for episode in range(count):
            for j, (low, high) in enumerate(self.limits):
                lengths = random.integers(self.held[0], self.held[1] + 1, rows)
                u[episode, :, j] = np.repeat(random.uniform(low, high, rows), lengths)[:rows]
        return u


def _pendulum(x: np.ndarray, u: np.ndarray, p: Parameters) -> np.ndarray:
    push = GRAVITY / p["l"] * np.sin(x[..., 0]) + p["C_m"] * u[..., 0] / (p["m"] * p["l"] ** 2)
    return np.stack([x[..., 1], push], -1)


def _cart(x: np.ndarray, u: np.ndarray, p: Parameters) -> np.ndarray:
    return np.stack([x[..., 1], (p["K_m"] * u[..., 0] - p["K"] * x[..., 0] - p["b"] * x[..., 1]) / p["M"]], -1)


def _tanks(x: np.ndarray, u: np.ndarray, p: Parameters) -> np.ndarray:
    over = p["c_1"] * np.sqrt(np.maximum(x[..., 0] - x[..., 1], 0.0))
    return np.stack([p["k_u"] * u[..., 0] - over, over - p["c_2"] * np.sqrt(np.maximum(x[..., 1], 0.0))], -1)


def _thermal(x: np.ndarray, u: np.ndarray, p: Parameters) -> np.ndarray:
    first, second = x[..., 0], x[..., 1]
    heat = p["k_h"] * u[..., 0] - p["a_1"] * (first - AMBIENT)
    return np.stack([heat, p["k_12"] * (first - second) - p["a_2"] * (second - AMBIENT)], -1)


def _car(x: np.ndarray, u: np.ndarray, p: Parameters) -> np.ndarray:
    theta, v = x[..., 2], x[..., 3]
    turn = v * np.tan(p["delta_max"] * u[..., 0]) / AXLES
    return np.stack([v * np.cos(theta), v * np.sin(theta), turn, p["a_max"] * u[..., 1] - p["b"] * v], -1)


def _hang(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    """PD about an angle near hanging, which the reference moves by up to 1 rad."""
    error = np.angle(np.exp(1j * (x[..., :1] - np.pi - r)))
    return -2.0 * error - 0.6 * x[..., 1:]


def _track(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    return 15.0 * (0.12 * r - x[..., :1]) - 0.5 * x[..., 1:] + 1.0 * r


def _level(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    return 3.75 + 0.15 * (25.0 + 8.0 * r - x[..., 1:])


def _warm(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    return 0.5 + 0.06 * (40.0 + 12.0 * r - x[..., 1:])


def _drive(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Hold a heading and a speed, both of which change sign."""
    heading = np.sin(2.0 * r[..., 0] - x[..., 2]) * np.where(x[..., 3] < 0, -1.0, 1.0)
    return np.stack([1.2 * heading, 0.5 * (3.0 * r[..., 1] - x[..., 3])], -1)


SYSTEMS: dict[str, System] = {
    s.name: s
    for s in (
        System(
            "pendulum", 0.05, ("phi", "omega"), ("u",),
            {"m": (0.6, 1.4), "l": (0.95, 1.05), "C_m": (0.98, 1.02)}, ((-2.5, 2.5),), (3, 9),
            ("phi",), ("omega",), {"omega": "phi"}, _pendulum, (-3.0, -1.0), (3.0, 1.0), _hang,
        ),
        System(
            "cart", 0.04, ("s", "v"), ("u",),
            {"M": (1.0, 1.8), "K": (40.0, 80.0), "K_m": (3.92, 4.08), "b": (0.5, 5.0)}, ((-3.0, 3.0),), (3, 9),
            ("s",), ("v",), {"v": "s"}, _cart, (-0.2, -0.5), (0.2, 0.5), _track,
        ),
        System(
            "tanks", 4.0, ("h_1", "h_2"), ("u",),
            {"k_u": (0.3, 0.5), "c_1": (0.15, 0.45), "c_2": (0.15, 0.45)}, ((1.5, 6.0),), (4, 12),
            ("h_2",), ("h_1", "h_2"), {}, _tanks, (25.0, 8.0), (50.0, 20.0), _level,
        ),
        System(
            "thermal", 10.0, ("T_1", "T_2"), ("u",),
            {"k_h": (0.25, 0.55), "a_1": (0.004, 0.02), "k_12": (0.002, 0.012), "a_2": (0.001, 0.01)}, ((0.0, 1.0),),
            (4, 14), ("T_2",), ("T_1", "T_2"), {}, _thermal, (20.0, 18.0), (60.0, 45.0), _warm,
        ),
        System(
            "car", 0.05, ("x", "y", "theta", "v"), ("steer", "throttle"),
            {"a_max": (4.0, 8.0), "b": (0.3, 2.5), "delta_max": (0.15, 0.5)}, ((-1.0, 1.0), (-1.0, 1.0)), (3, 10),
            ("x", "y", "theta"), ("v",), {}, _car, (-2.0, -2.0, -3.0, -2.0), (2.0, 2.0, 3.0, 2.0), _drive,
        ),
    )
}  # fmt: skip
