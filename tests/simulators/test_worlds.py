"""MuJoCo worlds against independent integrations of the equations of motion, and what a declaration may get wrong."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from simulators.model import ModelError, Quantity
from simulators.parameters import draw
from simulators.worlds import compiled_world
from simulators.worlds.compiled_world import CompiledWorld
from simulators.worlds.mujoco_world import MujocoWorld

PENDULUM = Path(__file__).parents[2] / "conf" / "sim" / "pendulum_world.yaml"
G = 9.81
AIR, RADIUS = 1.2, 0.18  # kg/m^3, m: the ball of pendulum.xml
SIZES = [(1.0, 1.0, 1.0), (0.6, 1.4, 1.1), (1.4, 0.55, 0.85)]  # m, l, C_m
TIMESTEP = {"range": [1, 2], "element": "option", "field": "timestep"}
STARTS = np.array([[0.3, 1.2], [3.1, 4.5], [-2.0, -3.0], [1.5, 0.0]])


def declaration(**changes: Any) -> dict[str, Any]:
    node = yaml.safe_load(PENDULUM.read_text())
    assert node.pop("_target_") == "simulators.worlds.mujoco_world.MujocoWorld"
    return node | changes


@pytest.fixture(scope="module")
def world() -> CompiledWorld:
    return MujocoWorld(**declaration()).model()


def vector(size: tuple[float, float, float], friction: float = 0, damping: float = 0, drag: float = 0) -> np.ndarray:
    return np.array([*size, friction, damping, drag])


def roll(world: CompiledWorld, start: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
    """States (n, T + 1, 2) under inputs (T,), the same parameters in every row."""
    path = [start]
    for u in inputs:
        path.append(world.step(path[-1], np.full((len(start), 1), u), np.tile(params, (len(start), 1))))
    return np.stack(path, axis=1)


def oracle(start: np.ndarray, inputs: np.ndarray, params: np.ndarray, dt: float) -> np.ndarray:
    """The same from the textbook: I phi'' = m g l sin(phi) + C_m u - brake, the brake being what each law says."""
    m, l, c_m, friction, damping, drag = params  # noqa: E741 (the paper's symbol)
    newton = AIR * drag * np.pi * RADIUS**2 * l**3

    def rate(_: float, x: np.ndarray, u: float) -> np.ndarray:
        phi, omega = x
        brake = friction * np.sign(omega) + damping * omega + newton * omega * np.abs(omega)
        return np.array([omega, (m * G * l * np.sin(phi) + c_m * u - brake) / (m * l**2)])

    path = [start]
    for u in inputs:
        path.append(solve_ivp(rate, (0, dt), path[-1], args=(u,), method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1])
    return np.array(path)


@pytest.mark.parametrize("size", SIZES)
def test_agrees_with_the_textbook_over_two_seconds(world: CompiledWorld, size: tuple[float, float, float]) -> None:
    inputs = 2.5 * np.sin(np.arange(40))
    paths = roll(world, STARTS, inputs, vector(size))
    expected = np.stack([oracle(start, inputs, vector(size), world.dt) for start in STARTS])
    np.testing.assert_allclose(paths, expected, atol=1e-6)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("effect", [{"damping": 0.1}, {"drag": 0.5}])
def test_damping_and_drag_follow_their_laws(
    world: CompiledWorld, size: tuple[float, float, float], effect: dict[str, float]
) -> None:
    params, inputs = vector(size, **effect), 2.5 * np.cos(np.arange(20))
    paths = roll(world, STARTS, inputs, params)
    expected = np.stack([oracle(start, inputs, params, world.dt) for start in STARTS])
    np.testing.assert_allclose(paths, expected, atol=1e-6)
    without = np.stack([oracle(start, inputs, vector(size), world.dt) for start in STARTS])
    assert np.abs(paths - without).max() > 0.05  # the law is seen, not only allowed


@pytest.mark.parametrize("size", SIZES)
def test_friction_is_a_constant_torque_against_the_motion(
    world: CompiledWorld, size: tuple[float, float, float]
) -> None:
    start, params = np.array([[0.3, 3.0], [0.3, -3.0]]), vector(size, friction=0.2)
    after = roll(world, start, np.zeros(1), params)[:, 1]
    expected = np.stack([oracle(row, np.zeros(1), params, world.dt)[1] for row in start])
    np.testing.assert_allclose(after, expected, atol=1e-6)


def late(delay: float, **changes: Any) -> CompiledWorld:
    return MujocoWorld(
        **declaration(inputs={"u": {"unit": "V", "range": [-2.5, 2.5], "actuator": "motor", "delay": delay}}, **changes)
    ).model()


@pytest.mark.parametrize(("delay", "waiting"), [(0.016, 1), (0.05, 1), (0.076, 2), (0.1, 2)])
def test_late_commands_act_when_they_arrive(delay: float, waiting: int) -> None:
    """Against the textbook with the inputs switched at `delay` after the transition begins, past ones first."""
    world = late(delay)
    assert [q.name for q in world.states] == ["phi", "omega", *[f"u_{i + 1}" for i in range(waiting)]]
    assert {(q.unit, q.low, q.high) for q in world.states[2:]} == {("V", -2.5, 2.5)}
    inputs, past = 2.5 * np.sin(np.arange(20)), np.array([[1.5, -0.5], [0, 0], [2, 2], [-1, 1]])[:, :waiting]
    paths = roll(world, np.column_stack([STARTS, past]), inputs, vector(SIZES[0]))
    np.testing.assert_array_equal(paths[:, 3:, 2], np.tile(inputs[2:], (4, 1)))
    given = np.column_stack(
        [past[:, ::-1], np.tile(inputs, (4, 1))]
    )  # one column per transition, `waiting` of them past
    n, fine = world.dt / 0.002, np.arange(20 * 25)
    arriving = given[:, ((fine + 0.5 - delay / 0.002) // n).astype(int) + waiting]
    expected = [oracle(x, u, vector(SIZES[0]), 0.002)[::25] for x, u in zip(STARTS, arriving, strict=True)]
    np.testing.assert_allclose(paths[:, :, :2], expected, atol=1e-6)


def test_a_delay_of_nothing_is_none(world: CompiledWorld) -> None:
    same = late(0)
    assert same.states == world.states
    np.testing.assert_array_equal(same.step(*queries(world, 9)), world.step(*queries(world, 9)))


def test_friction_holds_the_pendulum_where_gravity_is_weaker(world: CompiledWorld) -> None:
    start = np.array([[0.015, 0.0]])  # gravity 0.147 N m
    held = roll(world, start, np.zeros(20), vector(SIZES[0], friction=0.2))[0, -1]
    free = roll(world, start, np.zeros(20), vector(SIZES[0]))[0, -1]
    assert abs(held[0] - 0.015) < 3e-3 < 0.1 < free[0]


@pytest.mark.parametrize("effect", [{"friction": 0.2}, {"damping": 0.1}, {"drag": 0.5}])
def test_every_effect_is_odd_and_dissipates_in_both_directions(world: CompiledWorld, effect: dict[str, float]) -> None:
    n = 50
    rng = np.random.default_rng(0)
    states = np.column_stack([rng.uniform(-3, 3, n), rng.choice([-1, 1], n) * rng.uniform(1, 5, n)])
    inputs, params = rng.uniform(-2.5, 2.5, (n, 1)), np.tile(vector(SIZES[1], **effect), (n, 1))
    np.testing.assert_allclose(world.step(-states, -inputs, params), -world.step(states, inputs, params), atol=1e-9)
    m, l, _ = SIZES[1]  # noqa: E741

    def energy(x: np.ndarray) -> np.ndarray:
        return m * l**2 * x[:, 1] ** 2 / 2 + m * G * l * np.cos(x[:, 0])

    loss = energy(states) - energy(world.step(states, np.zeros((n, 1)), params))
    assert loss.min() > 1e-4
    np.testing.assert_allclose(
        energy(states), energy(world.step(states, np.zeros((n, 1)), np.tile(vector(SIZES[1]), (n, 1)))), atol=1e-6
    )


def queries(world: CompiledWorld, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return draw(world.states, rng, n), draw(world.inputs, rng, n), draw(world.params, rng, n)


def test_each_query_uses_its_own_parameters(world: CompiledWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    states, inputs, params = queries(world, 30)
    together = world.step(states, inputs, params)
    order = np.random.default_rng(2).permutation(30)
    np.testing.assert_array_equal(world.step(states[order], inputs[order], params[order]), together[order])
    for i in (0, 7):
        alone = world.step(states[i : i + 1], inputs[i : i + 1], params[i : i + 1])
        np.testing.assert_array_equal(alone[0], together[i])
    for j in range(len(world.params)):
        changed = params.copy()
        changed[3, j] *= 1.05
        moved = np.any(world.step(states, inputs, changed) != together, axis=1)
        assert moved.nonzero()[0].tolist() == [3]
    monkeypatch.setattr(compiled_world, "CHUNK", 7)
    np.testing.assert_array_equal(world.step(states, inputs, params), together)


def test_the_number_of_threads_does_not_matter(world: CompiledWorld) -> None:
    two = MujocoWorld(**declaration(threads=2)).model()
    np.testing.assert_array_equal(two.step(*queries(world, 20)), world.step(*queries(world, 20)))


def test_known_parameters_are_set_and_not_asked_for(world: CompiledWorld) -> None:
    parameters = declaration()["parameters"]
    for name, value in (("friction_loss", 0), ("damping", 0.1), ("drag", 0)):
        del parameters[name]["range"]
        parameters[name]["value"] = value
    known = MujocoWorld(**declaration(parameters=parameters)).model()
    assert [q.name for q in known.params] == ["m", "l", "C_m"]
    states, inputs, params = queries(known, 5)
    full = np.column_stack([params, np.tile([0, 0.1, 0], (5, 1))])
    np.testing.assert_array_equal(known.step(states, inputs, params), world.step(states, inputs, full))


def test_a_query_that_is_not_finite_answers_nan_alone(world: CompiledWorld) -> None:
    states, inputs, params = queries(world, 4)
    expected = world.step(states, inputs, params)
    states[1, 0], inputs[2, 0] = np.nan, np.inf
    after = world.step(states, inputs, params)
    assert np.isnan(after[1:3]).all()
    np.testing.assert_array_equal(after[[0, 3]], expected[[0, 3]])


def test_an_unstable_simulation_answers_nan(
    world: CompiledWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log there
    states, inputs, params = queries(world, 2)
    states[0, 1] = 1e12
    after = world.step(states, inputs, params)
    assert np.isnan(after[0]).all()
    assert np.isfinite(after[1]).all()


def test_a_refused_parameter_is_an_error_with_its_value(world: CompiledWorld) -> None:
    states, inputs, params = queries(world, 1)
    params[0, 0] = -1
    with pytest.raises(ModelError, match=r"MuJoCo refuses m = -1, l = .*mass and inertia"):
        world.step(states, inputs, params)


def _set(*path: str, to: Any) -> Callable[[dict[str, Any]], None]:
    def change(node: dict[str, Any]) -> None:
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = to

    return change


def _clash(node: dict[str, Any]) -> None:
    node["inputs"]["u"]["delay"] = 0.05
    node["states"]["u_1"] = node["states"].pop("omega")


@pytest.mark.parametrize(
    ("change", "fragment"),
    [
        (_set("xml", to="pendulm.xml"), r"sim\.xml: no file pendulm\.xml .* Did you mean pendulum\.xml\?"),
        (_set("dt", to=0.0511), r"sim\.dt: 0\.0511 s is no whole number of MuJoCo's time steps of 0\.002 s"),
        (_set("timestep", to=-1), r"sim\.timestep: -1 s is not positive"),
        (_set("threads", to=0), r"sim\.threads: 0 is not allowed"),
        (
            _set("states", "phi", "joint", to="hinje"),
            r"sim\.states\.phi\.joint: no joint 'hinje' .* Did you mean hinge\?",
        ),
        (_set("states", "phi", "of", to="positon"), r"sim\.states\.phi\.of: .* Did you mean position\?"),
        (_set("states", "phi", "of", to="velocity"), r"velocity of joint hinge is already the state phi"),
        (_set("states", "phi", to=3), r"sim\.states\.phi: 3 is not a mapping; write \{unit: "),
        (_set("states", "phi", "jiont", to="hinge"), r"sim\.states\.phi\.jiont: unknown key; .* Did you mean joint\?"),
        (_set("states", "phi", "range", to=[1, 0]), r"sim\.states\.phi\.range: low = 1 is not below high = 0; swap"),
        (_set("states", to={}), r"sim\.states: neither states nor outputs"),
        (
            _set("inputs", "v", to={"range": [0, 1], "actuator": "motor"}),
            r"inputs\.v\.actuator: motor is already driven",
        ),
        (_set("parameters", "m", to=TIMESTEP), r"sim\.parameters\.m\.field: option has no number 'timestep'"),
        (_set("inputs", "u", "delay", to=-0.1), r"sim\.inputs\.u\.delay: -0\.1 is no delay; give 0 s or more"),
        (_set("inputs", "u", "delay", to="fast"), r"sim\.inputs\.u\.delay: 'fast' is no delay"),
        (
            _set("inputs", "u", "delay", to=0.033),
            r"u\.delay: 0\.033 s is no whole number of MuJoCo's time steps of 0\.0",
        ),
        (_clash, r"sim\.states\.u_1: so is a command on its way called"),
        (_set("inputs", "u", "actuator", to="moter"), r"sim\.inputs\.u\.actuator: .* Did you mean motor\?"),
        (
            _set("parameters", "m", to=1.0),
            r"sim\.parameters\.m: 1\.0 is not a mapping; write \{.*element: \.\.\., field",
        ),
        (_set("parameters", "m", "element", to="bdy bob"), r"'bdy' is no kind of element; .* Did you mean body\?"),
        (_set("parameters", "m", "element", to="body bop"), r"no body 'bop' in the XML; known: world, rod, bob"),
        (_set("parameters", "m", "field", to="masss"), r"sim\.parameters\.m\.field: .* Did you mean mass\?"),
        (_set("parameters", "m", "field", to="name"), r"body has no number 'name'"),
        (_set("parameters", "m", "index", to=0), r"sim\.parameters\.m\.index: mass is a single number"),
        (_set("parameters", "l", "index", to=3), r"sim\.parameters\.l\.index: pos holds 3 numbers, 3 is none of them"),
        (_set("parameters", "m", "range", to=[-1, 1]), r"sim\.parameters\.m: MuJoCo refuses -1: .*mass"),
        (_set("parameters", "m", "element", to="geom ball"), r"sim\.parameters\.m: mass changes nothing"),
        (_set("gap", "phy", to=1), r"sim\.gap\.phy: .* Did you mean phi\?"),
    ],
)
def test_errors_name_the_key_and_the_cure(change: Callable[[dict[str, Any]], None], fragment: str) -> None:
    node = copy.deepcopy(declaration())
    change(node)
    with pytest.raises(ModelError, match=f"(?s){fragment}"):
        MujocoWorld(**node).model()


BALL = '<body><joint name="hinge" type="ball"/><geom size="0.1"/></body>'
SLIDER = (
    '<body><joint name="hinge" type="hinge"/><joint name="slider" type="slide" axis="1 0 0"/><geom size="0.1"/></body>'
)
FILTERED = (
    '</worldbody><actuator><general name="motor" joint="hinge" dyntype="filter" dynprm="1"/></actuator><worldbody>'
)


@pytest.mark.parametrize(
    ("body", "fragment"),
    [
        (BALL, "joint 'hinge' is neither hinge nor slide"),
        (SLIDER, "the position of joint slider is no state, but decides the future"),
        (SLIDER.replace('"slider"', '"s"') + FILTERED, "an actuator or plug-in has a state of its own"),
        ("<bdy/>", "MuJoCo refuses .*unrecognized element"),
    ],
)
def test_worlds_that_no_query_could_fix(tmp_path: Path, body: str, fragment: str) -> None:
    path = tmp_path / "own.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(ModelError, match=f"(?s){fragment}"):
        MujocoWorld(**declaration(xml=str(path), inputs={}, parameters={})).model()


def test_a_world_of_the_users_own(tmp_path: Path) -> None:
    """A mass falls: the XML is the user's, gravity is a parameter, and there is no input."""
    path = tmp_path / "fall.xml"
    path.write_text(
        '<mujoco><option integrator="RK4"/><worldbody><body><joint name="z" type="slide" axis="0 0 1"/>'
        '<geom size="0.1"/></body></worldbody></mujoco>'
    )
    world = MujocoWorld(
        name="fall",
        dt=0.1,
        xml=str(path),
        states={
            "v": {"unit": "m/s", "range": [-1, 1], "joint": "z", "of": "velocity"},
            "z": {"unit": "m", "range": [-1, 1], "joint": "z", "of": "position"},
        },
        parameters={"a": {"unit": "m/s^2", "range": [-12, -5], "element": "option", "field": "gravity", "index": 2}},
    ).model()
    after = world.step(np.array([[1.0, 2.0], [0.0, 0.0]]), np.zeros((2, 0)), np.array([[-10.0], [-5.0]]))
    np.testing.assert_allclose(after, [[0.0, 2.05], [-0.5, -0.025]], atol=1e-9)


@pytest.mark.parametrize(
    ("prior", "mean", "sd"),
    [
        ("uniform", 3.0, 2 / np.sqrt(3)),
        ("normal", 3.0, 1.0),
        ("lognormal", np.exp(np.log(5) / 2 + (np.log(5) / 4) ** 2 / 2), None),
    ],
)
def test_draws_have_the_declared_moments(prior: str, mean: float, sd: float | None) -> None:
    n = 20_000
    values = draw((Quantity("a", "", 1.0, 5.0, prior=prior),), np.random.default_rng(3), n)
    assert values.shape == (n, 1)
    assert abs(values.mean() - mean) < 4 * values.std() / np.sqrt(n)
    if sd is None:
        sd = mean * np.sqrt(np.exp((np.log(5) / 4) ** 2) - 1)
    assert abs(values.std() / sd - 1) < 0.03
    assert (values.min() >= 1 and values.max() <= 5) == (prior == "uniform")


def test_draws_without_parameters_are_empty() -> None:
    assert draw((), np.random.default_rng(0), 3).shape == (3, 0)
