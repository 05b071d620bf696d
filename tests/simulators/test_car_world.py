"""The RC car of MuJoCo against the textbook: motor, rolling, curves, the limit of grip, and symmetries of the plane."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from simpel_cli.config.build import build
from simulators.parameters import draw
from simulators.worlds.compiled_world import CompiledWorld

CONF = Path(__file__).parents[2] / "conf"
MEASURED = ["x", "y", "theta", "vx", "vy", "omega"]
WHEELS = ["front_left", "front_right", "rear_left", "rear_right"]
G, L_F, L_R, TRACK, RADIUS = 9.81, 0.13, 0.17, 0.2, 0.035  # m/s^2, m
WHEELS_MASS, SPINNING = 0.18, 4 * 3e-5 / RADIUS**2  # kg; what the wheels' spin adds to the mass
GRIP = 15.0  # N s/m, of a tyre below its limit
NOMINAL = {"m": 1.47, "motor": 8.0, "back_emf": 1.5, "friction": 0.3, "delta_max": 0.45, "mu": 0.6}


def node(group: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((CONF / group / "rc_car_world.yaml").read_text())
    return content


@pytest.fixture(scope="module")
def world() -> CompiledWorld:
    built: CompiledWorld = build(node("sim"), "sim").model()
    return built


def column(world: CompiledWorld, name: str) -> int:
    return [q.name for q in world.states].index(name)


def moving(world: CompiledWorld, speed: Any, heading: Any = 0.0, **others: Any) -> np.ndarray:
    """States (n, ds) of cars that roll straight ahead, with `others` on top."""
    vx, vy = speed * np.cos(heading), speed * np.sin(heading)
    values = {"theta": heading, "vx": vx, "vy": vy} | {f"spin_{w}": np.asarray(speed) / RADIUS for w in WHEELS} | others
    columns = np.broadcast_arrays(*[np.atleast_1d(value) for value in values.values()])
    states = np.zeros((len(columns[0]), len(world.states)))
    for name, value in zip(values, columns, strict=True):
        states[:, column(world, name)] = value
    return states


def drive(world: CompiledWorld, start: np.ndarray, steer: Any, throttle: Any, steps: int, **params: Any) -> np.ndarray:
    """States (n, steps + 1, ds); commands are numbers or broadcast to (n, steps), parameters to (n,)."""
    n = len(start)
    commands = np.stack([np.broadcast_to(command, (n, steps)) for command in (steer, throttle)], axis=-1)
    values = NOMINAL | params
    vector = np.stack([np.broadcast_to(values[q.name], n) for q in world.params], axis=1)
    path = [start]
    for j in range(steps):
        path.append(world.step(path[-1], commands[:, j], vector))
    return np.stack(path, axis=1)


def along(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity ahead and to the left, from states (..., ds)."""
    theta, vx, vy = path[..., 2], path[..., 3], path[..., 4]
    return vx * np.cos(theta) + vy * np.sin(theta), vy * np.cos(theta) - vx * np.sin(theta)


def random_commands(n: int, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Steer and throttle (n, steps), held for 10 transitions."""
    values = np.random.default_rng(seed).uniform(-1, 1, (2, n, -(-steps // 10)))
    steer, throttle = np.repeat(values, 10, axis=2)[:, :, :steps]
    return steer, throttle


def acceleration(world: CompiledWorld, path: np.ndarray) -> np.ndarray:
    """Size of the mean acceleration in the plane over each transition, (n, steps)."""
    return np.linalg.norm(np.diff(path[:, :, 3:5], axis=1), axis=2) / world.dt


def test_states_begin_with_those_of_the_bicycle(world: CompiledWorld) -> None:
    bicycle = yaml.safe_load((CONF / "sim" / "rc_car.yaml").read_text())
    assert [q.name for q in world.states][:6] == list(bicycle["states"]) == MEASURED
    assert [q.name for q in world.inputs] == list(bicycle["inputs"])
    assert (world.dt, set(world.gap)) == (bicycle["dt"], set(MEASURED))


def test_a_car_at_rest_stays_there(world: CompiledWorld) -> None:
    """Also a light and a heavy one, whose springs settle; turning the wheels on the spot moves it by next to nothing."""
    mass = np.array([1.3, 1.47, 1.65])
    path = drive(world, moving(world, np.zeros(3)), 0, 0, 60, m=mass)[:, :, :6]
    assert np.abs(path).max() < 1e-7
    turned = drive(world, moving(world, 0.0), 1, 0, 60)
    assert turned[0, -1, column(world, "steer_left")] > 0.4
    assert np.abs(turned[0, :, :6]).max(axis=0)[:3].max() < 2e-3
    assert np.abs(turned[0, -1, 3:6]).max() < 1e-4


@pytest.mark.parametrize(("start", "throttle"), [(0.0, 1.0), (3.0, 0.0), (-3.0, 0.0), (1.5, -0.5)])
def test_straight_ahead_it_obeys_motor_and_friction(world: CompiledWorld, start: float, throttle: float) -> None:
    """M v' = motor throttle - back_emf w - friction sgn(w), M with the wheels' spin; the command comes after 0.1 s.

    The wheels' rims run ahead of the car by what the tyres give way, w = v + M v' / (4 * 15 N s/m).
    """
    params = {
        "m": np.array([1.3, 1.47, 1.65, 1.47]),
        "motor": np.array([6.5, 8.0, 10.0, 8.0]),
        "back_emf": np.array([1.0, 1.5, 2.2, 1.5]),
        "friction": np.array([0.1, 0.3, 0.8, 0.8]),
    }
    steps, fine = 30, 100
    path = drive(world, moving(world, np.full(4, start)), 0, throttle, steps, mu=0.9, **params)
    mass, v, expected = params["m"] + WHEELS_MASS + SPINNING, np.full(4, start), []
    mass *= 1 + params["back_emf"] / (4 * GRIP)
    for i in range(steps * fine + 1):
        if i % fine == 0:
            expected.append(v)
        push = params["motor"] * throttle * (i >= 3 * fine) - params["back_emf"] * v
        v = v + world.dt / fine * (push - params["friction"] * np.tanh(1e3 * v)) / mass
    np.testing.assert_allclose(along(path)[0], np.transpose(expected), atol=0.05)
    assert np.abs(along(path)[0][:, -1] - start).min() > 1
    np.testing.assert_allclose(path[:, :, [1, 2, 4, 5]], 0, atol=1e-7)


def test_top_speed_is_where_back_electromotive_force_takes_all(world: CompiledWorld) -> None:
    motor, back_emf = np.array([8.0, 8.0, 6.5]), np.array([1.5, 2.2, 1.5])
    after = drive(world, moving(world, np.zeros(3)), 0, 1, 270, motor=motor, back_emf=back_emf, friction=0.3)[:, -1]
    np.testing.assert_allclose(after[:, 3], (motor - 0.3) / back_emf, rtol=1e-2)
    for wheel in WHEELS:
        np.testing.assert_allclose(after[:, column(world, f"spin_{wheel}")] * RADIUS, after[:, 3], rtol=1e-3)


def test_commands_act_a_tenth_of_a_second_late(world: CompiledWorld) -> None:
    path = drive(world, moving(world, 1.0), 1, 1, 5) - drive(world, moving(world, 1.0), 0, 0, 5)
    angle = column(world, "steer_left")
    assert np.abs(path[0, :4, [3, 5, angle]]).max() == 0
    assert path[0, 4, 3] > 0.05
    assert path[0, 4, angle] > 0.1


def test_the_axes_of_the_wheels_meet_in_one_point(world: CompiledWorld) -> None:
    """Ackermann: cot(right) - cot(left) = track / wheelbase in a curve to the left; their mean is what is asked for."""
    steer, lock = np.array([1.0, -1.0, 0.5, 1.0, 1.0]), np.array([0.45, 0.45, 0.45, 0.3, 0.65])
    after = drive(world, moving(world, np.zeros(5)), steer[:, None], 0, 45, delta_max=lock)[:, -1]
    left, right = after[:, column(world, "steer_left")], after[:, column(world, "steer_right")]
    np.testing.assert_allclose((left + right) / 2, steer * lock, rtol=1e-3)
    np.testing.assert_allclose(1 / np.tan(right) - 1 / np.tan(left), TRACK / (L_F + L_R), rtol=0.03)


def test_slow_curves_are_those_of_the_kinematic_bicycle(world: CompiledWorld) -> None:
    steer, lock = np.array([1.0, -1.0, 0.5, -0.5, 1.0, 1.0]), np.array([0.45, 0.45, 0.45, 0.45, 0.3, 0.65])
    path = drive(world, moving(world, np.full(6, 0.5)), steer[:, None], 0.13, 240, delta_max=lock)[:, 30:]
    ahead, aside = along(path)
    assert 0.3 < ahead.min() < ahead.max() < 0.6
    kinematic = (L_F + L_R) / np.tan(steer * lock)  # of the rear axle
    for k, row in enumerate(path):
        # least-squares circle through the positions, x^2 + y^2 = 2 a x + 2 b y + c
        x, y = row[:, 0], row[:, 1]
        a, b, c = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones(len(x))]), x**2 + y**2, rcond=None)[0]
        assert np.sqrt(c + a**2 + b**2) == pytest.approx(np.hypot(kinematic[k], L_R), rel=0.1)
    np.testing.assert_allclose(ahead / path[:, :, 5], np.tile(kinematic[:, None], ahead.shape[1]), rtol=0.1)
    # the rear axle goes where it points, but for what its tyres give way under their share of the centripetal force
    force = (NOMINAL["m"] + WHEELS_MASS) * ahead * path[:, :, 5] * L_F / (L_F + L_R)
    np.testing.assert_allclose(aside, L_R * path[:, :, 5] - force / (2 * GRIP), rtol=0.03)


def test_fast_curves_are_wider_and_their_force_is_that_of_friction(world: CompiledWorld) -> None:
    mu = np.array([0.4, 0.6, 0.9])
    path = drive(world, moving(world, np.full(3, 4.0)), 0.7, 1, 20, mu=mu)
    speed = np.hypot(path[:, 10:, 3], path[:, 10:, 4]).mean(axis=1)
    curvature = (path[:, 20, 2] - path[:, 10, 2]) / (10 * world.dt) / speed
    kinematic = np.tan(0.7 * NOMINAL["delta_max"]) / (L_F + L_R)
    assert np.all(speed**2 * kinematic > 1.4 * mu * G)  # more than friction can bear
    assert np.all(curvature < 0.8 * kinematic)
    assert np.all(np.diff(curvature) > 0.1)  # the slipperier the wider
    most = acceleration(world, path).max(axis=1) / (mu * G)
    assert np.all((most > 0.9) & (most < 1.05))


def test_free_rolling_keeps_its_direction(world: CompiledWorld) -> None:
    heading, speed = np.linspace(-3, 3, 7), np.array([-3.0, 3.0, 0.5, 1.0, 2.0, 4.0, 5.0])
    path = drive(world, moving(world, speed, heading), 0, 0, 60)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    moved = path[:, :, :2] - path[:, :1, :2]
    ahead = np.einsum("ntk,nk->nt", moved, direction)
    np.testing.assert_allclose(moved, ahead[:, :, None] * direction[:, None], atol=1e-6)
    np.testing.assert_allclose(path[:, :, 2], heading[:, None] + np.zeros(61), atol=1e-6)
    assert np.all(np.diff(np.abs(along(path)[0]), axis=1) <= 1e-9)


def test_energy_never_rises_without_throttle(world: CompiledWorld) -> None:
    """Also of cars that slide, spin and block their wheels."""
    rng, n = np.random.default_rng(0), 30
    start = moving(world, 0.0, rng.uniform(-3, 3, n), vx=rng.uniform(-4, 4, n), vy=rng.uniform(-4, 4, n))
    start[:, 5] = rng.uniform(-8, 8, n)
    spins = [column(world, f"spin_{wheel}") for wheel in WHEELS]
    start[:, spins] = rng.uniform(-100, 100, (n, 4))
    path = drive(world, start, 0, 0, 60)
    m = NOMINAL["m"] + WHEELS_MASS
    about_z = 0.03 + 4 * 2e-5 + 0.102 * (L_F**2 + TRACK**2 / 4) + 0.078 * (L_R**2 + TRACK**2 / 4)
    energy = (m * (path[:, :, 3:5] ** 2).sum(axis=2) + about_z * path[:, :, 5] ** 2) / 2
    energy += 3e-5 / 2 * (path[:, :, spins] ** 2).sum(axis=2)
    assert np.diff(energy, axis=1).max() < 1e-6
    assert np.all(energy[:, 15] < 0.9 * energy[:, 0])


def test_left_and_right_are_alike(world: CompiledWorld) -> None:
    n, steps = 6, 90
    steer, throttle = random_commands(n, steps, seed=1)
    speed = np.linspace(-3, 3, n)
    flip = np.array([1, -1, -1, 1, -1, -1])
    path = drive(world, moving(world, speed, 0.3), steer, throttle, steps)
    mirrored = drive(world, moving(world, speed, -0.3), -steer, throttle, steps)
    np.testing.assert_allclose(mirrored[:, :, :6], flip * path[:, :, :6], atol=1e-5)
    assert np.abs(path[:, -1, 5]).max() > 0.5
    for of in ("spin_front", "spin_rear"):
        left, right = column(world, f"{of}_left"), column(world, f"{of}_right")
        np.testing.assert_allclose(mirrored[:, :, left], path[:, :, right], atol=1e-3)


def test_every_place_and_direction_is_alike(world: CompiledWorld) -> None:
    n, steps, turn = 6, 90, 2.0
    steer, throttle = random_commands(n, steps, seed=2)
    speed = np.linspace(-3, 3, n)
    path = drive(world, moving(world, speed, 0.4), steer, throttle, steps)
    elsewhere = drive(world, moving(world, speed, 0.4 + turn, x=1.5, y=-2.5), steer, throttle, steps)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    np.testing.assert_allclose(elsewhere[:, :, :2], path[:, :, :2] @ matrix.T + np.array([1.5, -2.5]), atol=1e-5)
    np.testing.assert_allclose(elsewhere[:, :, 3:5], path[:, :, 3:5] @ matrix.T, atol=1e-5)
    np.testing.assert_allclose(elsewhere[:, :, 2], path[:, :, 2] + turn, atol=1e-5)
    np.testing.assert_allclose(elsewhere[:, :, 5], path[:, :, 5], atol=1e-5)


def test_any_driving_stays_finite_and_within_the_limit_of_grip(world: CompiledWorld) -> None:
    """10 s at random, from rest and from 3 m/s ahead and backwards, at full lock, with parameters over their ranges."""
    n, steps = 9, 300
    steer, throttle = random_commands(n, steps, seed=3)
    steer[:6], throttle[:3] = np.array([1, -1, 1, -1, 1, -1])[:, None], np.array([1, 1, -1])[:, None]
    params = dict(zip([q.name for q in world.params], draw(world.params, np.random.default_rng(4), n).T, strict=True))
    path = drive(world, moving(world, np.tile([0.0, 3.0, -3.0], 3)), steer, throttle, steps, **params)
    assert np.isfinite(path).all()
    assert np.abs(path[:, :, column(world, "z")]).max() < 3e-4
    assert np.hypot(path[:, :, 3], path[:, :, 4]).max() < 8
    most = acceleration(world, path).max(axis=1) / (params["mu"] * G)
    assert most.max() < 1.1


def test_any_query_has_an_answer(world: CompiledWorld) -> None:
    rng, n = np.random.default_rng(5), 300
    after = world.step(draw(world.states, rng, n), draw(world.inputs, rng, n), draw(world.params, rng, n))
    assert np.isfinite(after).all()


def test_smaller_time_steps_change_little(world: CompiledWorld) -> None:
    fine = build(node("sim") | {"timestep": world.dt / 64}, "sim").model()
    n, steps = 6, 60
    steer, throttle = random_commands(n, steps, seed=6)
    coarse, exact = (
        drive(w, moving(w, np.linspace(-3, 3, n)), steer, throttle, steps)[:, :, :6] for w in (world, fine)
    )
    assert np.sqrt(((coarse - exact) ** 2).mean(axis=(0, 1))).max() < 0.01
    assert np.ptp(exact, axis=1).max(axis=0).min() > 0.3


def test_simulate_hides_what_motion_capture_does_not_see(world: CompiledWorld) -> None:
    simulate = build(node("simulation"), "simulation")
    assert (simulate.episodes, simulate.steps * world.dt) == (12, pytest.approx(8))
    hidden = [q.name for q in world.states if q.name not in MEASURED]
    assert sorted(simulate.unmeasured) == sorted(hidden)
    assert set(simulate.initial) == {q.name for q in world.states}
    assert set(simulate.truth) == {q.name for q in world.params}
    for quantity in world.params:
        assert quantity.low < simulate.truth[quantity.name] < quantity.high
    columns = dataclasses.replace(simulate, episodes=3, steps=60).run(world).columns
    assert [*columns] == ["episode", "t", *MEASURED, "steer", "throttle", "split"]
    assert np.hypot(columns["vx"], columns["vy"])[columns["t"] == 0].max() < 0.12
    assert np.hypot(columns["vx"], columns["vy"]).max() > 0.5
