"""Effects of drives, tyres, supplies, overflows and heat against models that others derived."""

from dataclasses import dataclass

import casadi
import numpy as np
import pytest
import yaml
from test_effects import (
    CARS,
    LIFTER,
    MEASURED,
    PENDULUM,
    ROOM,
    SINGLE,
    TANKS,
    WORLD,
    along,
    catalogue,
    lifter,
    push,
    term_on,
    values,
)

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.filtering.likelihood.augmented import augment
from simulators.effects import Expression, Scales, Term
from simulators.effects.structure import drives
from simulators.extended import Extended
from simulators.model import Declared, Model, ModelError


def unit_scales(model: Model) -> Scales:
    return Scales({q.name: 1.0 for q in (*model.states, *model.inputs)}, {q.name: 1.0 for q in model.states}, model.dt)


def attached(name: str, model: Model) -> list[Term]:
    return catalogue(name).attach(model, unit_scales(model), tuple(q.name for q in model.states))


def test_a_drive_that_weakens_with_speed_is_that_of_the_race_cars() -> None:
    """The car of Liniger, Domahidi and Morari (2015): m dv/dt = (C_m1 - C_m2 v) d - C_r - C_d v^2."""
    mass, c_m1, c_m2, c_r, c_d = 0.041, 0.287, 0.0545, 0.0518, 0.00035
    lacking = Declared(
        "race", dt=0.02, states={"v": {"unit": "m/s", "range": [0, 4]}}, inputs={"d": {"unit": "1", "range": [0, 1]}},
        dynamics={"v": f"({c_m1}*d - {c_r} - {c_d}*v**2)/{mass}"},
    ).model()  # fmt: skip
    (term,) = attached("motor_back_emf", lacking)
    assert term.parameters[0].unit == "1/s"
    assert term.dissipative
    for v, d in ((0.0, 1.0), (1.5, 0.4), (3.0, 0.9)):
        rate = values(lacking, term, [v], [d], [c_m2 / mass])[0][0]
        np.testing.assert_allclose(rate, ((c_m1 - c_m2 * v) * d - c_r - c_d * v**2) / mass, rtol=1e-9)


def test_motors_drive_and_steering_does_not() -> None:
    assert drives(PENDULUM) == {"omega": ("u",)}
    assert drives(SINGLE) == {"v": ("throttle",)}
    assert drives(WORLD) == {"vx": ("throttle",), "vy": ("throttle",), "omega": ()}
    assert drives(TANKS) == {}
    assert not attached("motor_back_emf", TANKS)


@pytest.mark.parametrize("model", CARS, ids=["world", "body", "single"])
def test_a_car_s_motor_weakens_along_its_heading(model: Model) -> None:
    (term,) = attached("motor_back_emf", model)
    v, turn = ([-1.5], np.eye(1)) if model is SINGLE else along(model, 0.7, -1.5, 0.4)
    x = [0.1, 0.2, 0.7, *v, *([] if model is SINGLE else [0.3])]
    change = turn @ push(model, term, x, [0.5, -0.8], [2.0])[3 : 3 + len(v)]
    np.testing.assert_allclose(change, [2.0 * 1.5 * 0.8, 0.0][: len(v)], atol=1e-9)


def single_track(forces: tuple[str, str]) -> Model:
    """A dynamic single-track car with small steering angles; forces: of the front and the rear axle, N."""
    f, r = (f"({force})" for force in forces)
    return Declared(
        "single_track", dt=0.02,
        states={n: {"unit": u, "range": [-3, 3]} for n, u in
                {"x": "m", "y": "m", "theta": "rad", "v": "m/s", "w": "m/s", "r": "rad/s"}.items()},
        inputs={"steer": {"unit": "rad", "range": [-0.4, 0.4]}, "throttle": {"range": [-1, 1]}},
        parameters={"m": 1.65, "I": 0.06, "l_f": 0.13, "l_r": 0.17, "C_f": 16.0, "C_r": 19.0, "D_f": 3.9, "D_r": 2.9, "C": 1.4},
        dynamics={"x": "v*cos(theta) - w*sin(theta)", "y": "v*sin(theta) + w*cos(theta)", "theta": "r",
                  "v": "4*throttle + w*r", "w": f"({f} + {r})/m - v*r", "r": f"(l_f*{f} - l_r*{r})/I"},
    ).model()  # fmt: skip


ALPHA = ("(steer - atan((w + l_f*r)/v))", "-atan((w - l_r*r)/v)")  # slip angles


def test_tyres_that_saturate_are_the_magic_formula_on_each_axle() -> None:
    """Kabzan et al. (2019): F = D sin(C atan(B alpha)), front and rear, where the simulator has C_f alpha and C_r alpha."""
    linear = single_track((f"C_f*{ALPHA[0]}", f"C_r*{ALPHA[1]}"))
    magic = single_track((f"D_f*sin(C*atan(C_f/(C*D_f)*{ALPHA[0]}))", f"D_r*sin(C*atan(C_r/(C*D_r)*{ALPHA[1]}))"))
    (term,) = attached("pacejka_tyre", linear)
    assert [k.label for k in term.parameters] == ["D_f", "D_r", "C", "s", "j"]
    mass, inertia, length = 1.65, 0.06, 0.30
    own = [3.9 / mass, 2.9 / mass, 1.4, 0.17 / length, inertia / (mass * length)]
    gone = 0.0
    for w, r, steer in ((0.0, 0.0, 0.3), (0.4, -1.0, -0.35), (-0.9, 2.5, 0.1)):
        x, u = [0.1, 0.2, 0.7, 2.0, w, r], [steer, 0.5]
        wanted = np.asarray(magic.function()(x, u, [])[0]).ravel()
        gone = max(gone, float(np.abs(wanted - np.asarray(linear.function()(x, u, [])[0]).ravel()).max()))
        np.testing.assert_allclose(values(linear, term, x, u, own)[0], wanted, rtol=1e-9, atol=1e-9)
    assert gone > 3.0


def test_a_car_without_inertia_turns_no_tighter_than_its_tyres_hold() -> None:
    term = term_on("pacejka_tyre", SINGLE)
    assert [k.label for k in term.parameters] == ["D", "C"]
    hold, steer = 2.0, 0.4
    slow, fast = ((v, float(values(SINGLE, term, [0, 0, 0, v], [steer, 0], [hold, 1.0])[0][2])) for v in (0.01, 3.0))
    np.testing.assert_allclose(slow[1], slow[0] * np.tan(steer) / 0.3, rtol=1e-4)
    own = fast[0] ** 2 * np.tan(steer) / 0.3  # C = 1: sin(atan(a/D)) = a/sqrt(a^2 + D^2)
    np.testing.assert_allclose(fast[0] * fast[1], own / np.sqrt(1 + (own / hold) ** 2), rtol=1e-9)
    assert fast[0] * fast[1] < hold


@dataclass(frozen=True)
class Lifter:
    def model(self) -> Model:
        return lifter()


def test_a_shared_supply_sags_with_the_current_of_all_motors() -> None:
    """Two motors at standstill behind a resistance, by Kirchhoff: V_j = u_j (1 - R_i (I_1 + I_2)/V_0)."""
    (term,) = attached("voltage_sag", LIFTER)
    assert term.acts_on == "left, right"
    v_0, r_i, r_m = 8.0, 1e-4, 1.3
    for left, right in ((5.0, 2.0), (0.0, 6.0)):
        # duties d = u/V_0; battery V = V_0 - r_i sum(I_j), motor currents I_j = V_0 d_j/R_m
        v = v_0 - r_i * (left + right) / r_m
        told = [left * v / v_0, right * v / v_0]
        got = values(LIFTER, term, [0.0, 0.0], [left, right, 0.3], [2 * r_i / (r_m * v_0)])[0]
        np.testing.assert_allclose(got, [sum(told) - 9.81, 2 * (told[0] - told[1]) + 0.3], rtol=1e-12)
    assert not attached("voltage_sag", PENDULUM)
    assert not attached("voltage_sag", ROOM)  # temperatures are no commands
    assert not attached("voltage_sag", SINGLE)  # steering is no load


def test_a_term_on_two_inputs_reads_both_as_they_were_given_in_an_extended_simulator() -> None:
    (term,) = attached("voltage_sag", LIFTER)
    name, k = term.parameters[0].name, 0.05
    inputs = {signal: {"value": text.replace(name, "k_sag")} for signal, text in term.inputs.items()}
    extended = Extended("lifter_with_sag", Lifter(), parameters={"k_sag": k}, inputs=inputs).model()
    x, u = [0.3, 0.2], [5.0, 2.0, 0.1]
    wanted = values(LIFTER, term, x, u, [k])[0]
    np.testing.assert_allclose(np.asarray(extended.function()(x, u, [])[0]).ravel(), wanted, rtol=1e-12)


def test_an_overflow_reaches_the_other_tank_in_part() -> None:
    terms = {t.acts_on: t for t in attached("overflow_into", TANKS)}
    assert set(terms) == {"h, k", "k, h"}
    # no strength of an effect, whose range may widen: more than all of it cannot reach the other
    assert {k.label: k.neutral != 0 for k in terms["h, k"].parameters} == {
        "k": False,
        "x_max": True,
        "w": True,
        "s": True,
    }
    spill, share, sharp = 0.7 * (0.9 - 0.6), 0.4, 1e-9
    np.testing.assert_allclose(
        push(TANKS, terms["h, k"], [0.9, 0.2], [0.0], [0.7, 0.6, sharp, share]), [-spill, share * spill]
    )
    np.testing.assert_allclose(
        push(TANKS, terms["h, k"], [0.5, 0.9], [0.0], [0.7, 0.6, sharp, share]), [0, 0], atol=1e-12
    )
    np.testing.assert_allclose(push(TANKS, terms["k, h"], [0.5, 0.9], [0.0], [0.7, 0.6, sharp, 1.0]), [spill, -spill])
    (own,) = [t for t in catalogue("overflow").attach(TANKS, unit_scales(TANKS), ()) if t.acts_on == "h"]
    np.testing.assert_allclose(
        push(TANKS, terms["h, k"], [0.9, 0.2], [0.0], [0.7, 0.6, sharp, 0.0]),
        push(TANKS, own, [0.9, 0.2], [0.0], [0.7, 0.6, sharp]),
    )
    at_the_edge, far_below = (push(TANKS, own, [level, 0.2], [0.0], [0.7, 0.6, 0.1])[0] for level in (0.6, -2.0))
    assert at_the_edge == pytest.approx(-0.7 * 0.1 / 2)
    assert -1e-3 < far_below < 0
    assert attached("overflow_into", ROOM) == []  # heat does not overflow
    with pytest.raises(ModelError, match=r"effect.e.passes: goes with a `term` of `x` alone"):
        Expression("e", "", "first_order", "k*(other - x)", passes="0.5", parameters={"k": {"range": [0, 1]}})


@pytest.mark.parametrize("unit", ["K", "degC"])
def test_radiation_is_that_of_stefan_and_boltzmann(unit: str) -> None:
    """A plate in a vacuum: C dT/dt = -eps sigma A (T^4 - T_a^4), sigma = 5.670374e-8 W/(m^2 K^4)."""
    eps, sigma, area, capacity, zero = 0.9, 5.670374e-8, 2e-3, 12.0, 0.0 if unit == "K" else -273.15
    plate = Declared(
        "plate", dt=1.0, states={"T": {"unit": unit, "range": [zero + 250, zero + 400]}},
        inputs={"u": {"unit": "W", "range": [0, 10]}}, dynamics={"T": f"u/{capacity}"},
    ).model()  # fmt: skip
    (term,) = attached("radiation", plate)
    linear = 4 * eps * sigma * area * 300**3 / capacity
    for kelvin, around in ((350.0, 293.0), (280.0, 300.0), (400.0, 293.0)):
        wanted = -eps * sigma * area * (kelvin**4 - around**4) / capacity
        found = values(plate, term, [kelvin + zero], [0.0], [linear, around + zero])[0][0]
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
    near = values(plate, term, [300.01 + zero], [0.0], [1.0, 300.0 + zero])[0][0]
    np.testing.assert_allclose(near, -0.01, rtol=1e-3)  # beside a linear loss of the same coefficient
    assert not attached("radiation", TANKS)


def test_a_clipped_reading_has_no_slope_and_both_ends_hold() -> None:
    (of_phi, _) = catalogue("sensor_saturation").attach(PENDULUM, unit_scales(PENDULUM), MEASURED["pendulum"])
    read = [float(values(PENDULUM, of_phi, [phi, 0.2], [0.0], [0.8, -0.5])[1][0]) for phi in (-2.0, 0.3, 1.0)]
    np.testing.assert_allclose(read, [-0.5, 0.3, 0.8])
    together = augment(PENDULUM, [of_phi], ["phi", "omega"])
    x, u, p = (casadi.SX.sym(n, k) for n, k in (("x", 2), ("u", 1), ("p", len(together.params))))
    slope = casadi.Function("s", [x, u, p], [casadi.jacobian(together.function(x, u, p)[1], x)])
    values_of = [*together.neutral[: len(PENDULUM.params)], 0.8, -0.5]
    found = [float(slope([phi, 0.2], [0.0], values_of)[0, 0]) for phi in (-2.0, 0.3, 1.0)]
    assert found == [0.0, 1.0, 0.0]


def test_the_catalogue_composes_with_all_names() -> None:
    listed = yaml.safe_load((conf_dir() / "effect" / "vehicle.yaml").read_text())["defaults"]
    for name in listed:
        assert (
            build(yaml.safe_load((conf_dir() / "effect" / f"{name}.yaml").read_text()), f"effect.{name}").name == name
        )


def test_an_outflow_through_a_long_pipe_is_linear_where_the_simulator_has_a_root() -> None:
    """Hagen and Poiseuille in place of Torricelli: with c = k sqrt(x_r) of the simulator nothing of the root is left."""
    tank = Declared(
        "tank", dt=1.0, states={"h": {"unit": "m", "range": [0, 1]}}, inputs={"u": {"unit": "m/s", "range": [0, 1]}},
        dynamics={"h": "u - 0.12*sqrt(h)"},
    ).model()  # fmt: skip
    (term,) = attached("linear_outflow", tank)
    k = 0.12 / np.sqrt(0.5)
    for level in (0.1, 0.5, 0.9):
        np.testing.assert_allclose(values(tank, term, [level], [0.2], [k, 0.5])[0][0], 0.2 - k * level, rtol=1e-12)
    (leak,) = attached("leak", tank)
    np.testing.assert_allclose(
        push(tank, term, [0.4], [0.2], [k, 0.0]), push(tank, leak, [0.4], [0.2], [k]), rtol=1e-12
    )
    assert not attached("linear_outflow", ROOM)
