"""What can be planted: the exam's own formulas of missing physics, with the size that each has at full strength.

Names and parameter labels are those of the tool's catalogue, since they are what an answer is compared with; formulas are not
taken from there. Dry friction is a ramp here, a stop is a stiff spring, and nothing is smoothed for an optimiser's sake.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from tests.exam.formulas import (
    asymmetric,
    beyond,
    cogging,
    constant,
    coulomb,
    coupling,
    crowding,
    cubic,
    exchange,
    grip,
    inertia,
    leak,
    outflow,
    overflow,
    quadratic,
    ramp,
    rolling,
    spring,
    stop,
    stribeck,
    swing,
    tilt,
    understeer,
    viscous,
)

RATE, INPUT, SENSOR, DELAY, LAG, LATE_SENSOR = "rate", "input", "sensor", "delay", "lag", "late sensor"
OWN_RATE, PLAY, SLOW_SENSOR = "own rate", "play", "slow sensor"
ONE, SHAPE, OUTSIDE, ABSORBED = "one", "shape", "outside", "absorbed"

Knobs = Mapping[str, float]
Formula = Callable[..., np.ndarray]


class Effect(NamedTuple):
    """Something that a simulator can lack.

    Args:
        name: of the catalogue; a name of the exam's where the catalogue has none.
        acts_on: state, input or measured quantity.
        kind: RATE: formula(v, s, t, knobs, x, u) is added to the rate of `acts_on` (v itself, s the position or other
            state); OWN_RATE: formula(rate, knobs, x) stands in its place; INPUT, SENSOR: formula(value, knobs) likewise;
            DELAY, LAG, LATE_SENSOR, SLOW_SENSOR: one knob, s; PLAY: one knob, half of its width.
        full: knobs at full strength; those in `sized` are proportional to the strength, the others fixed.
        sized: names of knobs that the strength scales. A knob `limit` shrinks instead, `_most` is divided by it.
        formula: see `kind`.
        group: ONE: in the catalogue; SHAPE: of a similar shape as the names in `accept`; OUTSIDE: nothing of the kind;
            ABSORBED: the parameters of the simulator take it in, so that nothing is missing.
        accept: names that are right.
        both: only where position and velocity (all states) are measured.
    """

    name: str
    acts_on: str
    kind: str
    full: dict[str, float]
    sized: tuple[str, ...]
    formula: Formula | None = None
    group: str = ONE
    accept: tuple[str, ...] = ()
    both: bool = False

    @property
    def key(self) -> str:
        """Name and place."""
        return f"{self.name}@{self.acts_on}"

    def knobs(self, strength: float) -> dict[str, float]:
        """Return the parameters at a strength within 0..1."""
        return (
            {n: v * strength if n in self.sized else v for n, v in self.full.items()}
            | ({"limit": self.full["limit"] * (1 - 0.7 * strength)} if "limit" in self.full else {})
            | ({"_most": self.full["_most"] / strength} if "_most" in self.full else {})
        )


def friction(place: str, tau: float, width: float, v_s: float) -> list[Effect]:
    """Dry friction of three kinds; tau is its acceleration at full strength."""
    return [
        Effect("coulomb_friction", place, RATE, {"tau_c": tau, "_width": width}, ("tau_c",), coulomb),
        Effect(
            "stribeck_friction", place, RATE, {"tau_c": 0.6 * tau, "tau_s": tau, "v_s": v_s, "_width": width},
            ("tau_c", "tau_s"), stribeck,
        ),
        Effect(
            "asymmetric_friction", place, RATE, {"tau_p": tau, "tau_n": 0.25 * tau, "_width": width},
            ("tau_p", "tau_n"), asymmetric,
        ),
    ]  # fmt: skip


def commands(place: str, largest: float, delay: float, lag: float, *, signed: bool = True) -> list[Effect]:
    """Faults of an actuator whose command reaches `largest`; those that need both signs, or a zero, only if `signed`."""
    found = [
        Effect("input_delay", place, DELAY, {"d": delay}, ("d",)),
        Effect("input_lag", place, LAG, {"tau": lag}, ("tau",)),
        Effect("input_saturation", place, INPUT, {"limit": largest}, (), lambda u, k: np.clip(u, -k["limit"], k["limit"])),
        Effect("quadratic_input", place, INPUT, {"c": 0.6 / largest}, ("c",), lambda u, k: u + k["c"] * u * np.abs(u)),
        Effect(
            "tanh_saturation", place, INPUT, {"_limit": largest, "_over": 1.0}, ("_over",),
            lambda u, k: k["_limit"] / k["_over"] * np.tanh(u * k["_over"] / k["_limit"]), SHAPE,
            ("input_saturation", "quadratic_input"),
        ),
    ]  # fmt: skip
    if not signed:
        return found
    return [
        *found,
        Effect("input_backlash", place, PLAY, {"c": 0.3 * largest}, ("c",)),
        Effect("input_dead_zone", place, INPUT, {"d": 0.33 * largest}, ("d",), lambda u, k: beyond(u, k["d"])),
        Effect("input_gain_asymmetry", place, INPUT, {"a": 0.4}, ("a",), lambda u, k: u + k["a"] * np.abs(u)),
        Effect("input_offset", place, INPUT, {"b": 0.3 * largest}, ("b",), lambda u, k: u + k["b"]),
        Effect(
            "soft_dead_zone", place, INPUT, {"_d": 0.3 * largest}, ("_d",), lambda u, k: u**3 / (u**2 + k["_d"] ** 2),
            SHAPE, ("input_dead_zone",),
        ),
    ]  # fmt: skip


def bias(place: str, size: float) -> Effect:
    """A sensor that is off by a constant."""
    return Effect("sensor_bias", place, SENSOR, {"b": size}, ("b",), lambda y, k: y + k["b"])


def scale(place: str, size: float) -> Effect:
    """A sensor that is off by a factor; the other sensors must tell."""
    return Effect("sensor_scale", place, SENSOR, {"a": size}, ("a",), lambda y, k: y * (1 + k["a"]), both=True)


def late(place: str, size: float) -> Effect:
    """A sensor that reports late; with the others in time."""
    return Effect("sensor_delay", place, LATE_SENSOR, {"d": size}, ("d",), both=True)


def slow(place: str, size: float) -> Effect:
    """A sensor that follows with a first-order lag; with the others in time."""
    return Effect("sensor_lag", place, SLOW_SENSOR, {"tau": size}, ("tau",), both=True)


def rate(name: str, place: str, formula: Formula, sized: str, **full: float) -> Effect:
    """A term of the catalogue in a rate; `sized` is the knob that the strength scales."""
    return Effect(name, place, RATE, full, (sized,), formula)


def shape(name: str, place: str, accept: tuple[str, ...], size: float, formula: Formula) -> Effect:
    """A term of a shape that the catalogue has not, near those in `accept`."""
    return Effect(name, place, RATE, {"_k": size}, ("_k",), formula, SHAPE, accept)


def outside(name: str, place: str, size: float, formula: Formula) -> Effect:
    """A term that no name of the catalogue is near."""
    return Effect(name, place, RATE, {"_k": size}, ("_k",), formula, OUTSIDE)


def beat(place: str, size: float, period: float) -> Effect:
    """A force that swings with time, whatever the state does."""
    return Effect(
        "periodic_force",
        place,
        RATE,
        {"_force": size, "_period": period, "_phase": 0.7},
        ("_force",),
        swing,
        OUTSIDE,
    )


_DRAG = ("quadratic_drag", "viscous_friction")

EFFECTS: dict[str, list[Effect]] = {
    "pendulum": [
        rate("viscous_friction", "omega", viscous, "b", b=0.8), *friction("omega", 2.0, 0.01, 0.8),
        rate("quadratic_drag", "omega", quadratic, "c", c=0.3), rate("constant_load", "omega", constant, "c", c=2.0),
        rate("linear_stiffness", "omega", spring, "k", k=3.0), rate("cubic_stiffness", "omega", cubic, "k_3", k_3=0.6),
        Effect("cogging", "omega", RATE, {"a": 1.0, "b": 1.0, "n": 4.0}, ("a", "b"), cogging),
        rate("gravity_tilt", "omega", tilt, "a", a=1.5),
        Effect("added_inertia", "omega", RATE, {"alpha": 0.6}, ("alpha",), inertia),
        *commands("u", 2.5, 0.12, 0.15), bias("phi", 0.15), scale("omega", 0.25), late("omega", 0.08),
        slow("omega", 0.08),
        shape("wide_ramp_friction", "omega", ("coulomb_friction",), 2.0, lambda v, s, t, k, x, u: -k["_k"] * ramp(v, 0.3)),
        shape("drag_of_power_1.5", "omega", _DRAG, 0.5, lambda v, s, t, k, x, u: -k["_k"] * v * np.sqrt(np.abs(v))),
        outside("friction_of_position", "omega", 4.0, lambda v, s, t, k, x, u: -k["_k"] * np.sin(s) ** 2 * ramp(v, 0.05)),
        outside("angle_times_speed", "omega", 1.2, lambda v, s, t, k, x, u: k["_k"] * np.sin(s) * v),
        beat("omega", 3.0, 1.1),
    ],
    "cart": [
        *friction("v", 1.5, 0.003, 0.25), rate("quadratic_drag", "v", quadratic, "c", c=3.0),
        rate("constant_load", "v", constant, "c", c=2.0), rate("cubic_stiffness", "v", cubic, "k_3", k_3=600.0),
        rate("end_stop", "v", stop, "k", k=300.0, s_max=0.13),
        Effect("viscous_friction", "v", RATE, {"b": 0.4}, ("b",), viscous, ABSORBED),
        Effect("linear_stiffness", "v", RATE, {"k": 3.0}, ("k",), spring, ABSORBED),
        Effect("added_inertia", "v", RATE, {"alpha": 0.07}, ("alpha",), inertia, ABSORBED),
        *commands("u", 3.0, 0.1, 0.12), bias("s", 0.03), scale("v", 0.25), late("v", 0.06), slow("v", 0.05),
        shape("wide_ramp_friction", "v", ("coulomb_friction",), 1.5, lambda v, s, t, k, x, u: -k["_k"] * ramp(v, 0.06)),
        shape("drag_of_power_1.5", "v", ("quadratic_drag",), 3.0, lambda v, s, t, k, x, u: -k["_k"] * v * np.sqrt(np.abs(v))),
        shape("spring_of_power_5", "v", ("cubic_stiffness", "end_stop"), 8000.0, lambda v, s, t, k, x, u: -k["_k"] * s**5),
        outside("friction_of_position", "v", 120.0, lambda v, s, t, k, x, u: -k["_k"] * s**2 * v),
        outside("position_times_speed", "v", 16.0, lambda v, s, t, k, x, u: k["_k"] * s * v),
        beat("v", 3.0, 0.7),
    ],
    "tanks": [
        rate("leak", "h_1", leak, "k", k=0.02), rate("leak", "h_2", leak, "k", k=0.02),
        rate("outflow_exponent", "h_2", outflow, "k", k=0.004, n=1.5),
        rate("overflow", "h_1", overflow, "k", k=0.2, x_max=38.0), rate("overflow", "h_2", overflow, "k", k=0.2, x_max=20.0),
        rate("ambient_exchange", "h_2", exchange, "k", k=0.04, x_a=30.0),
        rate("constant_inflow", "h_1", constant, "c", c=0.6), rate("constant_inflow", "h_2", constant, "c", c=0.6),
        rate("crowding", "h_1", crowding, "k", k=4e-4),
        *commands("u", 6.0, 10.0, 12.0, signed=False), bias("h_2", 3.0), scale("h_2", 0.15), late("h_1", 8.0),
        slow("h_1", 8.0),
        shape("weir", "h_1", ("overflow",), 0.06, lambda v, s, t, k, x, u: -k["_k"] * np.maximum(v - 35.0, 0.0) ** 1.5),
        shape("outflow_of_power_0.8", "h_2", ("outflow_exponent", "leak"), 0.06,
              lambda v, s, t, k, x, u: -k["_k"] * np.maximum(v, 0.0) ** 0.8),
        outside("pump_against_head", "h_1", 0.006, lambda v, s, t, k, x, u: -k["_k"] * v * u[..., 0]),
        beat("h_2", 0.6, 60.0),
    ],
    "thermal": [
        rate("thermal_coupling", "T_1", coupling, "k", k=0.008), rate("constant_inflow", "T_1", constant, "c", c=0.12),
        rate("constant_inflow", "T_2", constant, "c", c=0.12), rate("crowding", "T_1", crowding, "k", k=1e-4),
        rate("overflow", "T_1", overflow, "k", k=0.03, x_max=42.0),
        *commands("u", 1.0, 30.0, 40.0, signed=False), bias("T_2", 4.0), scale("T_1", 0.15), late("T_1", 20.0),
        slow("T_1", 20.0),
        Effect("input_dead_zone", "u", INPUT, {"d": 0.3}, ("d",), lambda u, k: beyond(u, k["d"])),
        Effect("input_offset", "u", INPUT, {"b": 0.3}, ("b",), lambda u, k: u + k["b"]),
        shape("radiation", "T_1", ("radiation", "crowding"), 0.25,
              lambda v, s, t, k, x, u: -k["_k"] * (((v + 273) / 320) ** 4 - 0.7)),
        outside("product_of_temperatures", "T_2", 1.5e-4, lambda v, s, t, k, x, u: -k["_k"] * (v - 20) * (s - 20)),
        outside("fan_with_heater", "T_1", 0.02, lambda v, s, t, k, x, u: -k["_k"] * (v - 20) * u[..., 0]),
        beat("T_1", 0.25, 140.0),
    ],
    "car": [
        *friction("v", 2.0, 0.02, 0.6), rate("quadratic_drag", "v", quadratic, "c", c=0.5),
        rate("constant_load", "v", constant, "c", c=1.5),
        Effect("viscous_friction", "v", RATE, {"b": 0.15}, ("b",), viscous, ABSORBED),
        *commands("steer", 1.0, 0.15, 0.2), *commands("throttle", 1.0, 0.15, 0.2),
        bias("theta", 0.15), bias("v", 0.3), scale("v", 0.2), late("v", 0.1), slow("v", 0.1),
        rate("rolling_resistance", "v", rolling, "c", c=2.3, _width=0.02),
        Effect("traction_limit", "v", OWN_RATE, {"_most": 3.5}, (), grip),
        Effect("tyre_slip", "theta", OWN_RATE, {"K": 0.15}, ("K",), understeer),
        shape("drag_of_power_1.5", "v", ("quadratic_drag",), 0.9, lambda v, s, t, k, x, u: -k["_k"] * v * np.sqrt(np.abs(v))),
        outside("drag_in_turns", "v", 1.5, lambda v, s, t, k, x, u: -k["_k"] * v * u[..., 0] ** 2),
        outside("wind", "v", 2.5, lambda v, s, t, k, x, u: k["_k"] * np.sin(x[..., 2] + 0.4)),
        beat("v", 3.0, 0.9),
    ],
}  # fmt: skip


def by_key(system: str, key: str) -> Effect:
    """Find an effect of a system."""
    return next(e for e in EFFECTS[system] if e.key == key)
