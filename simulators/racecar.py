"""A race car in the plane: kinematic bicycle, or single-track model with Pacejka tyres, blended into it at low speed.

State: position (m), heading theta (rad) and velocity (m/s) in the world frame, turn rate omega (rad/s). A tracking marker may
be mounted at an angle theta_0 to the car: psi = theta + theta_0 is where the car points. Everything is integrated in
(p, psi, v_x, v_y, omega), v in the body frame.

    delta = delta_max steer,   F_x = c_m1 throttle - c_m2^2 v_x - c_d^2 v_x |v_x|,   k = tan(delta)/(l_f + l_r)

Sources: Kabzan et al. (2020, AMZ Driverless, arXiv 1905.05150); Pacejka and Bakker (1992); Liniger et al. (2015).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import casadi

from simulators.built import FIDELITIES, Built
from simulators.expression import Symbol
from simulators.model import Coordinates
from simulators.quantity import check_word

STATES = ("x", "y", "theta", "vx", "vy", "omega")
INPUTS = ("steer", "throttle")
CHASSIS = ("m", "l_f", "l_r", "theta_0", "c_m1", "c_m2", "c_d", "delta_max", "tau_k")
TYRES = ("I_z", "B_f", "C_f", "D_f", "B_r", "C_r", "D_r", "v_b", "w_b", "g")
SLOWEST = 0.05  # m/s; below, slip angles are those of this speed
Known = Mapping[str, Symbol]


class Body(NamedTuple):
    """Velocities of the centre of mass along and across the car, m/s, and turn rate, rad/s; or their rates."""

    along: Symbol
    across: Symbol
    turn: Symbol


@dataclass(frozen=True)
class RaceCar(Built):
    """A race car.

    Args:
        fidelity: `low`: kinematic bicycle, off whose manifold motion settles within `tau_k`; `high`: tyres that slip.
        blend_on: `absolute`: tyres act at speeds |v_x| above `v_b`, fully so from `v_b + w_b` on; `signed`: at v_x, so that
            the car is a kinematic bicycle in reverse (as published).
        states: x, y (m), theta (rad, periodic), vx, vy (m/s, world frame), omega (rad/s).
        inputs: steer, throttle in -1..1; what is beyond is clipped. They may have a `delay`.
        parameters: m (kg), l_f, l_r (m), theta_0 (rad), c_m1 (N), c_m2 ((kg/s)^1/2), c_d ((kg/m)^1/2), delta_max (rad),
            tau_k (s); for tyres also I_z (kg m^2), B_f, C_f, B_r, C_r, D_f, D_r (kg: peak side force over g), v_b, w_b (m/s),
            g (m/s^2).

    """

    fidelity: str = "high"
    blend_on: str = "absolute"

    def __post_init__(self) -> None:
        """Refuse words that are not allowed."""
        check_word("sim.fidelity", self.fidelity, FIDELITIES)
        check_word("sim.blend_on", self.blend_on, ("absolute", "signed"))

    def needed(self) -> dict[str, tuple[str, ...]]:
        """Return the names that the equations use."""
        tyres = TYRES if self.fidelity == "high" else ()
        return {"states": STATES, "inputs": INPUTS, "parameters": (*CHASSIS, *tyres)}

    def accelerations(self, v: Body, known: Known) -> Body:
        """Return d(v)/dt in the body frame, whose axes turn with the car."""
        steer, throttle = (casadi.fmin(casadi.fmax(known[name], -1), 1) for name in INPUTS)
        delta = known["delta_max"] * steer
        force = known["c_m1"] * throttle - (known["c_m2"] ** 2 + known["c_d"] ** 2 * casadi.fabs(v.along)) * v.along
        rolling = _rolling(v, delta, force, known)
        if self.fidelity == "low":
            return rolling
        speed = casadi.fabs(v.along) if self.blend_on == "absolute" else v.along
        share = casadi.fmin(casadi.fmax((speed - known["v_b"]) / known["w_b"], 0), 1)
        slipping = _slipping(v, delta, force, known)
        return Body(*(share * a + (1 - share) * b for a, b in zip(slipping, rolling, strict=True)))

    def rates(self, known: Known) -> list[Symbol]:
        """Return d(state)/dt in the world frame."""
        psi = known["theta"] + known["theta_0"]
        c, s = casadi.cos(psi), casadi.sin(psi)
        vx, vy, omega = known["vx"], known["vy"], known["omega"]
        v = Body(c * vx + s * vy, c * vy - s * vx, omega)
        a = self.accelerations(v, known)
        along, across = a.along - omega * v.across, a.across + omega * v.along  # of a frame that does not turn
        rate = dict(zip(STATES, (vx, vy, omega, c * along - s * across, s * along + c * across, a.turn), strict=True))
        return [rate[name] for name in self.states]

    def own_coordinates(self, known: Callable[[Symbol, Symbol, Symbol], dict[str, Symbol]]) -> Coordinates:
        """Return position, direction of the car, velocities in its frame and turn rate."""
        order = list(self.states)

        def named(column: Symbol, p: Symbol, u: Symbol | None = None) -> dict[str, Symbol]:
            return known(column, casadi.SX.zeros(len(self.inputs)) if u is None else u, p)

        def enter(x: Symbol, p: Symbol) -> Symbol:
            k = named(x, p)
            psi = k["theta"] + k["theta_0"]
            c, s = casadi.cos(psi), casadi.sin(psi)
            return casadi.vertcat(k["x"], k["y"], psi, c * k["vx"] + s * k["vy"], c * k["vy"] - s * k["vx"], k["omega"])

        def rhs(z: Symbol, u: Symbol, p: Symbol) -> Symbol:
            c, s, v = casadi.cos(z[2]), casadi.sin(z[2]), Body(z[3], z[4], z[5])
            a = self.accelerations(v, named(z, p, u))
            return casadi.vertcat(c * v.along - s * v.across, s * v.along + c * v.across, v.turn, *a)

        def leave(z: Symbol, p: Symbol) -> Symbol:
            c, s = casadi.cos(z[2]), casadi.sin(z[2])
            theta = z[2] - named(z, p)["theta_0"]
            rows = (z[0], z[1], theta, c * z[3] - s * z[4], s * z[3] + c * z[4], z[5])
            after = dict(zip(STATES, rows, strict=True))
            return casadi.vertcat(*(after[name] for name in order))

        return Coordinates(len(STATES), enter, rhs, leave)


def _rolling(v: Body, delta: Symbol, force: Symbol, known: Known) -> Body:
    """Kinematic bicycle: rolling asks for turn = k along, across = l_r turn; what is off it settles within tau_k.

    The first terms are the derivatives of that constraint with the steering held, so that it is kept exactly.
    """
    l_r, tau = known["l_r"], known["tau_k"]
    curvature = casadi.tan(delta) / (known["l_f"] + l_r)
    along = force / known["m"]
    return Body(
        along,
        l_r * curvature * along + (l_r * curvature * v.along - v.across) / tau,
        curvature * along + (curvature * v.along - v.turn) / tau,
    )


def slip_angles(v: Body, delta: Symbol, known: Known) -> tuple[Symbol, Symbol]:
    """Return the slip angles of front and rear tyres, rad; in reverse the steered wheel points the other way."""
    speed = casadi.fmax(casadi.fabs(v.along), SLOWEST)
    front = casadi.sign(v.along) * delta - casadi.atan((v.across + known["l_f"] * v.turn) / speed)
    return front, -casadi.atan((v.across - known["l_r"] * v.turn) / speed)


def _slipping(v: Body, delta: Symbol, force: Symbol, known: Known) -> Body:
    """Single-track model with Pacejka tyres."""
    m, l_f, l_r = known["m"], known["l_f"], known["l_r"]
    front, rear = (
        known[f"D_{end}"] * known["g"] * casadi.sin(known[f"C_{end}"] * casadi.atan(known[f"B_{end}"] * alpha))
        for end, alpha in zip("fr", slip_angles(v, delta, known), strict=True)
    )
    return Body(
        (force - front * casadi.sin(delta)) / m + v.across * v.turn,
        (rear + front * casadi.cos(delta)) / m - v.along * v.turn,
        (l_f * front * casadi.cos(delta) - l_r * rear) / known["I_z"],
    )
