"""Regressors for the rivals: what the equations of each rig are linear in, and the catalogue's shapes as further columns.

A shape with a parameter of its own comes as a few columns with that parameter on a grid. Effects of sensors are not linear in
anything, and added inertia is a change of the known columns; no regression on derivatives can name them.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from tests.exam.plants import AMBIENT, SYSTEMS

MERGED = {  # columns that together are one effect of the catalogue
    frozenset({"coulomb_friction", "stribeck_friction"}): "stribeck_friction",
    frozenset({"coulomb_friction", "asymmetric_friction"}): "asymmetric_friction",
    frozenset({"coulomb_friction", "constant_load"}): "asymmetric_friction",
    frozenset({"leak", "constant_inflow"}): "ambient_exchange",
}

Signals = Mapping[str, np.ndarray]


class Column(NamedTuple):
    """One candidate regressor: the effect that it stands for, where that acts, and its values.

    Where the effect has a parameter of its own, `at` is its value on the grid; columns with one `at` belong together.
    """

    effect: str
    acts_on: str
    values: np.ndarray
    at: float = 0.0


def known(system: str, x: Signals) -> dict[str, np.ndarray]:
    """Return, per rate, the columns (N, n) that the rig's own equation is linear in."""

    def columns(*given: np.ndarray) -> np.ndarray:
        return np.stack(given, -1)

    if system == "pendulum":
        return {"omega": columns(np.sin(x["phi"]), x["u"])}
    if system == "cart":
        return {"v": columns(x["u"], x["s"], x["v"])}
    if system == "tanks":
        over = np.sqrt(np.maximum(x["h_1"] - x["h_2"], 0))
        return {"h_1": columns(x["u"], over), "h_2": columns(over, np.sqrt(np.maximum(x["h_2"], 0)))}
    if system == "thermal":
        return {"T_1": columns(x["u"], x["T_1"] - AMBIENT), "T_2": columns(x["T_1"] - x["T_2"], x["T_2"] - AMBIENT)}
    steer = x["steer"]
    return {"theta": columns(x["v"] * steer, x["v"] * steer**3), "v": columns(x["throttle"], x["v"])}


def candidates(system: str, x: Signals) -> dict[str, list[Column]]:
    """Return, per rate, the columns of what may be missing.

    Args:
        system: name.
        x: every state and input, (episodes, rows) each.
    """
    told = SYSTEMS[system]
    found: dict[str, list[Column]] = {}
    inputs = {"car": {"theta": ("steer",), "v": ("throttle",)}}.get(system, {})
    for place in known(system, x):
        if system in ("tanks", "thermal"):
            other = next(n for n in told.states if n != place)
            found[place] = [Column(n, place, c, at) for n, at, c in _first_order(x[place], x[other])]
            driven = ("u",) if place == told.states[0] else ()
        else:
            rows = _velocity(x[place], x.get(told.velocity.get(place, "")), angle=system == "pendulum")
            found[place] = [] if place == "theta" else [Column(n, place, c, at) for n, at, c in rows]
            driven = inputs.get(place, ("u",))
        gain = x["v"] if place == "theta" else np.ones_like(x[place])
        for name in driven:
            found[place] += [Column(n, name, gain * c, at) for n, at, c in _input(x[name])]
        if system == "cart":  # the rig has a spring and a damper of its own
            found[place] = [c for c in found[place] if c.effect not in ("viscous_friction", "linear_stiffness")]
        if system == "car":
            found[place] = [c for c in found[place] if c.effect != "viscous_friction"]
    return found


def merged(names: set[str]) -> set[str]:
    """Return the effects that a set of columns stands for."""
    for parts, whole in MERGED.items():
        if parts <= names:
            names = names - parts | {whole}
    return names


def _velocity(v: np.ndarray, s: np.ndarray | None, *, angle: bool) -> Iterator[tuple[str, float, np.ndarray]]:
    largest = np.abs(v).max()
    side = np.tanh(v / (0.02 * largest))
    yield "viscous_friction", 0.0, v
    yield "coulomb_friction", 0.0, side
    yield "stribeck_friction", 0.0, side * np.exp(-((v / (0.2 * largest)) ** 2))
    yield "asymmetric_friction", 0.0, np.abs(side)
    yield "quadratic_drag", 0.0, v * np.abs(v)
    yield "constant_load", 0.0, np.ones_like(v)
    if s is None:
        return
    yield "linear_stiffness", 0.0, s
    yield "cubic_stiffness", 0.0, s**3
    for share in (0.8, 0.6):
        yield "end_stop", share, s - np.clip(s, -share * np.abs(s).max(), share * np.abs(s).max())
    if angle:
        yield "gravity_tilt", 0.0, np.cos(s)
        for n in (2, 3, 4, 6, 8):
            yield "cogging", n, np.sin(n * s)
            yield "cogging", n, np.cos(n * s)


def _first_order(x: np.ndarray, other: np.ndarray) -> Iterator[tuple[str, float, np.ndarray]]:
    yield "leak", 0.0, x
    yield "outflow_exponent", 0.0, np.maximum(x, 0.0) ** 1.5
    yield "crowding", 0.0, x**2
    yield "constant_inflow", 0.0, np.ones_like(x)
    yield "thermal_coupling", 0.0, other - x
    for share in (0.9, 0.7):
        yield "overflow", share, np.maximum(x - share * x.max(), 0.0)


def _input(u: np.ndarray) -> Iterator[tuple[str, float, np.ndarray]]:
    largest = np.abs(u).max()

    def earlier(rows: int) -> np.ndarray:
        return np.concatenate([np.repeat(u[:, :1], rows, axis=1), u[:, : u.shape[1] - rows]], axis=1)

    yield "quadratic_input", 0.0, u * np.abs(u)
    if u.min() < 0:
        yield "input_gain_asymmetry", 0.0, np.abs(u)
    for share in (0.1, 0.2, 0.3):
        yield "input_dead_zone", share, u - np.clip(u, -share * largest, share * largest)
    for share in (0.8, 0.5):
        yield "input_saturation", share, np.clip(u, -share * largest, share * largest)
    for rows in (1, 2):
        yield "input_delay", rows, earlier(rows)
    for rows in (1.0, 3.0):
        slow, decay = u.copy(), np.exp(-1 / rows)
        for k in range(1, u.shape[1]):
            slow[:, k] = decay * slow[:, k - 1] + (1 - decay) * u[:, k - 1]
        yield "input_lag", rows, slow
