"""The race car: numbers of SYSTEMS.md, section 7, through both integrators, and what no car may break."""

from collections.abc import Mapping
from dataclasses import replace

import casadi
import jax.numpy as jnp
import numpy as np
import pytest
from systems import model

from simpel_cli.dynamics.transition import encoding_of, transition
from simulators.model import Model, ModelError
from simulators.racecar import Body, RaceCar, slip_angles
from simulators.worlds.rk4 import RK4

TYRES = {"I_z": 0.06, "B_f": 2.75, "C_f": 1.45, "D_f": 0.4, "B_r": 5.0, "C_r": 1.3, "D_r": 0.3, "v_b": 0.1, "w_b": 0.2}
CHASSIS = {"m": 1.65, "l_f": 0.13, "l_r": 0.17, "theta_0": 0.0}
LOW = CHASSIS | {"c_m1": 8.0, "c_m2": 1.5, "c_d": 0.0, "delta_max": 0.3, "tau_k": 1 / 90}
HIGH = CHASSIS | TYRES | {"c_m1": 8.2, "c_m2": 1.25, "delta_max": 0.6, "tau_k": 1 / 90}
CASES = {
    "C1": ("low", {}, [0.2, -0.1, 0.3, 1.5, 0.4, 0.2], [0.5, 0.8], [1.5, 0.4, 0.2, 1.763497675, 17.61073328, 53.22128819],
           [0.2494217025, -0.08164689665, 0.3203969674, 1.486473671, 0.6282157647, 0.7814085444]),
    "C2": ("low", {}, [0, 0, 1, 0, 0, 0], [1, 0], [0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0]),
    "C3": ("low", {}, [0, 0, 0, -1.2, 0, 0], [-0.7, -0.5], [-1.2, 0, 0, -0.7878787879, 13.13947816, 77.29104801],
           [-0.04046220749, 0.003034627337, 0.01972507293, -1.228213459, 0.1166023809, 0.8282630999]),
    "C4": ("low", {"theta_0": 0.1, "c_d": 0.3}, [0, 0, 3.1, -1, 0.2, 0.5], [1.7, -1.4],
           [-1, 0.2, 0.5, -6.246971263, 37.69300692, 40.11781206],
           [-0.02933427211, -0.002667982299, 3.12492865, -0.771027345, -0.1806188246, 0.7819484895]),
    "H1": ("high", {}, [0.2, -0.1, 0.3, 1.8, 0.6, 1], [0.5, 0.8], [1.8, 0.6, 1, 1.736904427, 0.4019508086, 2.155605141],
           [0.2605012005, -0.07850779157, 0.3345179566, 1.829393748, 0.6894170112, 1.070553459]),
    "H2": ("high", {}, [0, 0, 0, -1.5, 0.2, -0.5], [0.6, -0.4], [-1.5, 0.2, -0.5, 0.1379492519, -4.370965885, -0.7241656527],
           [-0.04988721076, 0.00474565903, -0.01732004608, -1.493838103, 0.08795672267, -0.5480498804]),
    "H3": ("high", {}, [0, 0, 0, 0.2, 0.05, 0.1], [-0.8, 0.1], [0.2, 0.05, 0.1, -0.2373539335, -6.705578325, -20.9018835],
           [0.006579205743, -0.0005214849203, -0.004584962858, 0.1972069443, -0.0491728712, -0.2810927357]),
    "H4": ("high", {}, [0, 0, -2, 0, 0, 0], [-1, 1], [0, 0, 0, 4.96969697, -1.92663982, -11.33317541],
           [-0.002094313081, -0.002042339446, -2.006153327, -0.1234743477, -0.12230755, -0.3551957044]),
    "H5": ("high", {"theta_0": -0.05}, [1.42, -1.04, 3.13, -1.5, 1.5, 2.5], [-1.3, 0.5],
           [-1.5, 1.5, 2.5, -2.549889276, -2.242164785, -8.30578825],
           [1.369351356, -0.9910358151, -3.074122466, -1.540273009, 1.434807902, 2.25305902]),
    "H6": ("high", {}, [0, 0, 0.7, 0, 0, 0], [1, 0], [0, 0, 0, 0, 0, 0], [0, 0, 0.7, 0, 0, 0]),
}  # fmt: skip


STATES = {name: {"range": [-1, 1]} for name in ("x", "y", "theta", "vx", "vy", "omega")}
INPUTS = {name: {"range": [-1, 1]} for name in ("steer", "throttle")}


def car(fidelity: str, **other: float) -> Model:
    """The nominal car, six steps a transition."""
    known = (LOW if fidelity == "low" else HIGH) | other
    found = model("racecar_published" if fidelity == "low" else "racecar_high_fidelity", **known)
    assert (found.substeps, found.params) == (6, ())
    return found


def after(source: Model, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """One transition of n cars."""
    return RK4(source).step(states, inputs, np.zeros((len(states), 0)))


def wrapped(states: np.ndarray) -> np.ndarray:
    states = states.copy()
    states[:, 2] = (states[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return states


@pytest.mark.parametrize("case", CASES)
def test_check_values(case: str) -> None:
    fidelity, other, state, action, rates, following = CASES[case]
    source = car(fidelity, **other)
    x, u = np.array([state], float), np.array([action], float)
    close = {"rtol": 1.01e-9, "atol": 1e-12}
    np.testing.assert_allclose(wrapped(after(source, x, u)), [following], **close)
    flow = source.flow()
    assert flow.enter is not None
    z = flow.enter(casadi.DM(state), casadi.DM(0, 1))
    found = np.asarray(flow.rhs(z, casadi.DM(action), casadi.DM(0, 1))).ravel()
    # positions move along the world's axes, the rest is told in the car's own frame
    np.testing.assert_allclose(found, rates, **close)
    encoding = encoding_of(source)
    inputs = jnp.asarray(encoding.to_x(x[0], u[0]))
    y = transition(source, encoding).step(inputs, jnp.zeros(0))
    np.testing.assert_allclose(encoding.decode(np.asarray(inputs[:7] + y)), following, **close)


@pytest.mark.parametrize(
    ("case", "angles"),
    [
        ("H1", (0.2099579216, 0.0677611789)),
        ("H2", (-0.4497581742, -0.1877619465)),
        ("H3", (-0.7851608246, -0.1635266188)),
    ],
)
def test_slip_angles(case: str, angles: tuple[float, float]) -> None:
    _, _, state, action, _, _ = CASES[case]
    c, s = np.cos(state[2]), np.sin(state[2])
    along, across = c * state[3] + s * state[4], c * state[4] - s * state[3]
    known: Mapping[str, float] = HIGH
    found = slip_angles(Body(along, across, state[5]), HIGH["delta_max"] * action[0], known)
    np.testing.assert_allclose([float(a) for a in found], angles, rtol=1e-9)


def test_without_settling_time_the_car_rolls() -> None:
    """tau_k -> 0: within a transition the motion is on the manifold of pure rolling; numbers of the algebraic form (C1)."""
    known = LOW | {"tau_k": 1e-4}
    source = model("racecar_published", **known)
    fine = RK4(replace(source, substeps=4000))
    _, _, state, action, _, _ = CASES["C1"]
    found = fine.step(np.array([state], float), np.array([action], float), np.zeros((1, 0)))
    expected = [0.2487170876, -0.07947721404, 0.3265353834, 1.47948397, 0.6464983853, 0.810427394]
    np.testing.assert_allclose(found[0], expected, rtol=2e-3)
    psi = found[0, 2]
    along = np.cos(psi) * found[0, 3] + np.sin(psi) * found[0, 4]
    assert found[0, 5] == pytest.approx(np.tan(0.3 * 0.5) / 0.3 * along, rel=1e-3)


def random_cars(n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    low, high = np.array([-2, -2, -np.pi, -2, -2, -3]), np.array([2, 2, np.pi, 2, 2, 3])
    return rng.uniform(low, high, (n, 6)), rng.uniform(-1, 1, (n, 2))


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_the_plane_has_no_origin_and_no_direction(fidelity: str) -> None:
    source, (x, u) = car(fidelity, theta_0=0.07), random_cars()
    turn, shift = 0.8, np.array([3.0, -5.0])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def moved(x: np.ndarray) -> np.ndarray:
        return np.column_stack([x[:, :2] @ rotation.T + shift, x[:, 2] + turn, x[:, 3:5] @ rotation.T, x[:, 5]])

    np.testing.assert_allclose(after(source, moved(x), u), moved(after(source, x, u)), rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_left_and_right_are_alike(fidelity: str) -> None:
    source, (x, u) = car(fidelity), random_cars()
    mirror, flip = np.array([1, -1, -1, 1, -1, -1.0]), np.array([-1.0, 1])
    np.testing.assert_allclose(after(source, x * mirror, u * flip), after(source, x, u) * mirror, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("theta_0", [-0.15, 0.0, 0.1])
def test_positions_move_with_the_velocity_however_the_marker_is_mounted(theta_0: float) -> None:
    source, (x, u) = car("high", theta_0=theta_0), random_cars(20)
    rates = np.asarray(source.function().map(20)(x.T, u.T, np.zeros((0, 20)))[0])
    np.testing.assert_allclose(rates[:2], x[:, 3:5].T, rtol=1e-12)
    np.testing.assert_allclose(rates[2], x[:, 5], rtol=1e-12)


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_rates_of_the_states_are_those_of_its_own_coordinates(fidelity: str) -> None:
    """Effects attach to the rates in the world frame, transitions are integrated in the car's frame: one law."""
    source, (x, u) = car(fidelity, theta_0=0.1), random_cars(20)
    fine = replace(source, dt=1e-5, substeps=1)
    rates = np.asarray(source.function().map(20)(x.T, u.T, np.zeros((0, 20)))[0]).T
    np.testing.assert_allclose((after(fine, x, u) - x) / 1e-5, rates, rtol=5e-3, atol=5e-2)


def test_tyres_take_energy() -> None:
    """Without throttle or drag the kinetic energy of a slipping car never rises."""
    source = car("high", c_m2=0.0)
    x, u = random_cars()
    body = np.abs(np.cos(x[:, 2]) * x[:, 3] + np.sin(x[:, 2]) * x[:, 4])
    x = x[body > 0.6]  # tyres alone: below, the bicycle's constraint does work
    u = np.zeros((len(x), 2))

    def energy(x: np.ndarray) -> np.ndarray:
        return 1.65 / 2 * (x[:, 3] ** 2 + x[:, 4] ** 2) + 0.06 / 2 * x[:, 5] ** 2

    assert (energy(after(source, x, u)) <= energy(x) + 1e-9).all()
    assert (energy(after(source, x, u)) < energy(x) - 1e-3).mean() > 0.5


def test_slow_cars_roll_and_fast_ones_slip() -> None:
    """Below v_b high fidelity is the bicycle of the same constants; above v_b + w_b it is not."""
    both = HIGH | {"c_d": 0.0}
    high = model("racecar_high_fidelity", **both)
    low = model("racecar_published", **{k: v for k, v in both.items() if k not in TYRES})
    u = np.array([[0.7, 0.0]])
    slow, fast = np.array([[0, 0, 0, 0.08, 0.01, 0.1]]), np.array([[0, 0, 0, 1.5, 0.01, 0.1]])
    np.testing.assert_allclose(after(high, slow, u), after(low, slow, u), rtol=1e-12)
    assert abs(after(high, fast, u)[0, 5] - after(low, fast, u)[0, 5]) > 0.3


def test_published_blend_is_kinematic_in_reverse() -> None:
    known = {k: v for k, v in HIGH.items() if k not in ("v_b", "w_b")} | {"ub": 0.13, "lb": 0.03}
    signed = model("racecar_published_high_fidelity", **known)
    low = model("racecar_published", **{k: v for k, v in HIGH.items() if k not in TYRES} | {"c_d": 0.0})
    u = np.array([[0.7, 0.0]])
    back, forth = np.array([[0, 0, 0, -1.5, 0.1, 0.1]]), np.array([[0, 0, 0, 1.5, 0.1, 0.1]])
    np.testing.assert_allclose(after(signed, back, u), after(low, back, u), rtol=1e-12)
    assert abs(after(signed, forth, u)[0, 5] - after(low, forth, u)[0, 5]) > 0.3


def test_wrong_words_are_refused() -> None:
    with pytest.raises(ModelError, match=r"sim\.fidelity: 'medium' is not allowed, only low or high"):
        RaceCar(name="car", dt=0.1, fidelity="medium")
    with pytest.raises(ModelError, match=r"sim\.parameters: no m, which the equations of RaceCar use; add `m: \.\.\.`"):
        RaceCar(name="car", dt=0.1, fidelity="low", states=STATES, inputs=INPUTS).model()
    with pytest.raises(
        ModelError, match=r"sim\.parameters\.delta_mx: the equations of RaceCar do not use it; .* Did you mean"
    ):
        model("racecar", delta_mx=1.0)
    with pytest.raises(ModelError, match=r"sim\.dynamics: the equations of RaceCar are its own"):
        RaceCar(name="car", dt=0.1, states=STATES, dynamics={"x": "vx"}).model()


def test_late_commands_act_exactly_between_two_arrivals() -> None:
    """Delay of 80 ms at 30 Hz (section 8): of a transition the first 0.4 belong to the command before the one that acts."""
    known = HIGH | {"T_steer": 0.08, "T_throttle": 0.08}
    source = model("rc_car_high_fidelity", **known)
    assert RK4(source).past(np.zeros((1, 0))) == source.past() == 3
    state = np.array([CASES["H1"][2]], float)
    history = np.array([[[-0.5, 0.2], [0.3, 0.6], [0.9, 0.1], [0.0, 0.0]]])  # oldest first, the last one is given now
    expected = [0.259727743, -0.08018340884, 0.3293868673, 1.794395705, 0.6189708571, 0.8517342585]
    np.testing.assert_allclose(RK4(source).follow(state, history, np.zeros((1, 0)))[0], expected, rtol=1.01e-9)
    # the mean of both commands, which the reference takes, is not the same
    mean = car("high")
    mixed = [0.2602009594, -0.07994285285, 0.3297624144, 1.811202275, 0.605883126, 0.7908822413]
    np.testing.assert_allclose(after(mean, state, np.array([[-0.02, 0.44]]))[0], mixed, rtol=1.01e-9)
    # in a learning problem the delay is continuous: the mean over the substep in which a command arrives
    noise = np.array([1.1e-3, 1.1e-3, 1.8e-3, 8.2e-3, 8.2e-3, 3.7e-2])
    np.testing.assert_array_less(np.abs(in_jax(source, state, history) - expected), noise / 3)
    fine = in_jax(replace(source, substeps=30), state, history)  # the arrival lies between two substeps
    np.testing.assert_allclose(fine, expected, rtol=1e-5)
    assert (np.abs(np.array(mixed) - expected) > noise).any()


def in_jax(source: Model, state: np.ndarray, history: np.ndarray) -> np.ndarray:
    encoding = encoding_of(source, stack=3)
    x = jnp.asarray(encoding.to_x(state[0], history[0].ravel()))
    y = transition(source, encoding).step(x, jnp.zeros(0))
    return np.asarray(encoding.decode(np.asarray(x[:7] + y)))


def test_delays_apart_and_uncertain() -> None:
    """Each query has its own delays, each input its own: three intervals; a whole number of rows is no sliver of another."""
    source = model("rc_car_high_fidelity", **HIGH)
    names = [q.name for q in source.params]
    assert names == ["T_steer", "T_throttle"]
    state = np.repeat(np.array([CASES["H1"][2]], float), 3, axis=0)
    random = np.random.default_rng(0)
    history = np.repeat(random.uniform(-1, 1, (1, 8, 2)), 3, axis=0)
    found = RK4(source).follow(state, history, np.array([[0.1, 0.1], [0.1, 0.15], [0.08, 0.2]]))
    held = after(car("high"), state[:1], history[:1, -4])  # both are three rows old
    np.testing.assert_allclose(found[:1], held, rtol=1e-12)
    dt, plain = 1 / 30, car("high")
    shorter = replace(plain, dt=dt / 2, substeps=12)  # half a row after half a row: the throttle of 4.5 rows ago
    first = RK4(shorter).step(state[:1], np.array([[history[0, -4, 0], history[0, -6, 1]]]), np.zeros((1, 0)))
    second = RK4(shorter).step(first, np.array([[history[0, -4, 0], history[0, -5, 1]]]), np.zeros((1, 0)))
    np.testing.assert_allclose(found[1:2], second, rtol=1e-6)
    assert np.abs(found[2] - found[1]).max() > 1e-3


def test_a_lag_has_no_end() -> None:
    with pytest.raises(
        ModelError, match=r"sim\.inputs\.steer\.lag: a simulator asked for single transitions cannot lag inputs"
    ):
        RK4(replace(car("high"), lag={"steer": 0.1}))
