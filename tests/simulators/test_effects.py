"""The catalogue of effects: every YAML in conf/effect, at every place where it can act."""

import re
from dataclasses import replace

import casadi
import numpy as np
import pytest
import yaml

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.filtering.likelihood.augmented import augment
from simulators.effects import Expression, Scales, Term, structure, unnamed
from simulators.effects.term import INPUT, OPERATORS, RATE, SENSOR
from simulators.model import Declared, Model, ModelError

LISTS = ("all", "vehicle")
BY_NAME = ("voltage_sag",)  # tried where it is named
LIMITS = ("input_saturation", "pacejka_tyre", "sensor_saturation", "traction_limit")
NAMES = sorted(p.stem for p in (conf_dir() / "effect").glob("*.yaml") if p.stem not in LISTS)


def catalogue(name: str) -> Expression:
    return build(yaml.safe_load((conf_dir() / "effect" / f"{name}.yaml").read_text()), f"effect.{name}")


def pendulum() -> Model:
    return build(yaml.safe_load((conf_dir() / "sim" / "pendulum.yaml").read_text()), "sim").model()


def tanks() -> Model:
    return Declared(
        "tanks",
        dt=1.0,
        states={"h": {"unit": "m", "range": [0, 1]}, "k": {"unit": "m", "range": [0, 1]}},
        inputs={"u": {"unit": "V", "range": [0, 1]}},
        parameters={"a": {"unit": "1/s", "range": [0.1, 0.3]}},
        dynamics={"h": "u - a*h", "k": "a*h - a*k"},
    ).model()


def room() -> Model:
    """A room with a heated floor; outdoors and the heating water are measured, the fan is a number between 0 and 1."""
    return Declared(
        "room",
        dt=60.0,
        states={n: {"unit": "degC", "range": [0, 60]} for n in ("T", "floor")}
        | {"dust": {"unit": "1", "range": [0, 1]}},
        inputs={n: {"unit": "degC", "range": [-10, 60]} for n in ("T_o", "water")}
        | {"fan": {"unit": "1", "range": [0, 1]}},
        parameters={"a": {"unit": "1/s", "range": [1e-4, 3e-4]}},
        dynamics={"T": "a*(floor - T)", "floor": "0*a", "dust": "-a*fan*dust"},
    ).model()


def lifter() -> Model:
    """Two motors on one supply, and a flap."""
    return Declared(
        "lifter", dt=0.05,
        states={"v": {"unit": "m/s", "range": [-3, 3]}, "w": {"unit": "rad/s", "range": [-3, 3]}},
        inputs={n: {"unit": "V", "range": [0, 8]} for n in ("left", "right")} | {"flap": {"unit": "rad", "range": [-1, 1]}},
        dynamics={"v": "left + right - 9.81", "w": "2*(left - right) + flap"},
    ).model()  # fmt: skip


def car(frame: str) -> Model:
    """A car that turns where its wheels point: in the world frame, in its own frame, or with one speed."""
    if frame == "world":
        return build(yaml.safe_load((conf_dir() / "sim" / "rc_car.yaml").read_text()), "sim").model()
    spans = {"x": "m", "y": "m", "theta": "rad", "v": "m/s"} | ({"w": "m/s", "r": "rad/s"} if frame == "body" else {})
    bodies = {
        "body": {"x": "v*cos(theta) - w*sin(theta)", "y": "v*sin(theta) + w*cos(theta)", "theta": "r",
                 "v": "4*throttle - b*v", "w": "(0.1*v*steer - w)/b", "r": "(v*steer - r)/b"},
        "single": {"x": "v*cos(theta)", "y": "v*sin(theta)", "theta": "v*tan(steer)/0.3", "v": "4*throttle - b*v"},
    }  # fmt: skip
    return Declared(
        f"car_{frame}",
        dt=0.05,
        states={n: {"unit": u, "range": [-3, 3], "periodic": n == "theta"} for n, u in spans.items()},
        inputs={n: {"unit": "1", "range": [-1, 1]} for n in ("steer", "throttle")},
        parameters={"b": {"unit": "1/s", "range": [0.5, 1.5]}},
        dynamics=bodies[frame],
    ).model()


PENDULUM, TANKS, ROOM, LIFTER = pendulum(), tanks(), room(), lifter()
WORLD, BODY, SINGLE = CARS = tuple(car(frame) for frame in ("world", "body", "single"))
VEHICLE = ("pacejka_tyre", "rolling_resistance", "traction_limit", "tyre_slip")
OF_ROOMS = ("input_exchange", "radiation")  # of temperatures
SCALES = {
    "pendulum": Scales({"phi": 3.0, "omega": 4.0, "u": 2.0}, {"phi": 2.0, "omega": 6.0}, 0.05),
    "tanks": Scales({"h": 0.8, "k": 0.7, "u": 1.0}, {"h": 0.2, "k": 0.1}, 1.0),
} | {
    m.name: Scales({q.name: 2.0 for q in (*m.states, *m.inputs)}, {q.name: 3.0 for q in m.states}, m.dt)
    for m in (ROOM, LIFTER, *CARS)
}
MEASURED = {m.name: tuple(q.name for q in m.states) for m in (PENDULUM, TANKS, ROOM, LIFTER, *CARS)}


def terms_of(name: str) -> list[tuple[Model, Term]]:
    effect = catalogue(name)
    return [
        (model, term)
        for model in (
            PENDULUM,
            TANKS,
            *(CARS if name in VEHICLE else ()),
            *((ROOM,) if name in OF_ROOMS else ()),
            *((LIFTER,) if name == "voltage_sag" else ()),
        )
        for term in effect.attach(model, SCALES[model.name], MEASURED[model.name])
    ]


def values(
    model: Model, term: Term, x: list[float], u: list[float], parameters: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Rates of the model's own states and readings with one term, parameters in the middle of their ranges."""
    together = augment(model, [term], [q.name for q in model.states])
    begin = len(model.params)  # behind the parameters: constants
    p = np.concatenate([together.neutral[:begin], parameters, together.neutral[begin + len(parameters) :]])
    away = [0.7 * s.high for s in term.stores]  # what it brings along is not where the states are
    rates, y = together.function(casadi.DM([*x, *away]), casadi.DM(u), casadi.DM(p))
    return np.asarray(rates).ravel()[: len(x)], np.asarray(y).ravel()


def points(model: Model, seed: int = 0) -> list[tuple[list[float], list[float]]]:
    random = np.random.default_rng(seed)
    return [
        tuple([float(random.uniform(q.low, q.high)) for q in group] for group in (model.states, model.inputs))
        for _ in range(12)
    ]


def test_the_catalogue_is_that_of_the_plan() -> None:
    assert len(NAMES) >= 44
    listed = yaml.safe_load((conf_dir() / "effect" / "all.yaml").read_text())["defaults"]
    assert sorted([*listed, *BY_NAME]) == NAMES


@pytest.mark.parametrize("name", NAMES)
class TestEffect:
    def test_is_named_by_its_file_and_explained(self, name: str) -> None:
        effect = catalogue(name)
        assert effect.name == name
        assert len(effect.meaning) > 10
        assert all(other in NAMES for other in (*effect.same_as, *effect.generalises))

    def test_acts_somewhere(self, name: str) -> None:
        assert terms_of(name)

    def test_is_the_old_model_at_its_neutral_point(self, name: str) -> None:
        for model, term in terms_of(name):
            for x, u in points(model):
                old = np.asarray(model.function()(x, u, augment(model, [], MEASURED[model.name]).neutral)[0])
                rates, y = values(model, term, x, u, [k.neutral for k in term.parameters])
                np.testing.assert_allclose(rates, old.ravel(), rtol=1e-12, atol=1e-12)
                np.testing.assert_allclose(y, x, rtol=1e-12)

    def test_changes_the_model_at_its_starts(self, name: str) -> None:
        for model, term in terms_of(name):
            if term.kind in OPERATORS:
                continue
            starts = [k.starts[0] for k in term.parameters]
            change = 0.0
            for x, u in [*points(model), ([q.high for q in model.states], [q.high for q in model.inputs])]:
                old = values(model, term, x, u, [k.neutral for k in term.parameters])
                new = values(model, term, x, u, starts)
                change = max(change, *(np.abs(a - b).max() for a, b in zip(old, new, strict=True)))
            assert change > 0

    def test_starts_and_neutral_point_lie_in_the_range(self, name: str) -> None:
        for _, term in terms_of(name):
            for parameter in term.parameters:
                assert parameter.low < parameter.high
                assert all(parameter.low < s < parameter.high for s in parameter.starts)
                # a limit is neutral where nothing reaches it, beyond the range
                assert parameter.low <= parameter.neutral <= parameter.high or (
                    term.effect in LIMITS and not parameter.low < parameter.neutral < parameter.high
                )
                assert re.fullmatch(r"[\w^/() ]+", parameter.unit), parameter.unit

    def test_never_adds_energy_if_it_says_so(self, name: str) -> None:
        effect, random = catalogue(name), np.random.default_rng(1)
        if not effect.dissipative:
            return
        for model, term in terms_of(name):
            rows = [i for i, q in enumerate(model.states) if q.name in term.rates]
            for x, u in points(model):
                parameters = [float(random.uniform(k.low, k.high)) for k in term.parameters]
                off = values(model, term, x, u, [k.neutral for k in term.parameters])[0]
                assert (values(model, term, x, u, parameters)[0] - off)[rows] @ np.array(x)[rows] <= 0


@pytest.mark.parametrize("name", ["viscous_friction", "coulomb_friction", "stribeck_friction", "quadratic_drag"])
def test_friction_is_odd_in_speed(name: str) -> None:
    for model, term in terms_of(name):
        parameters = [k.starts[0] for k in term.parameters]
        for speed in (0.01, 0.5, 3.0):
            pushes = [
                values(model, term, [0.3, s], [0.0], parameters)[0][1]
                - values(model, term, [0.3, s], [0.0], [k.neutral for k in term.parameters])[0][1]
                for s in (speed, -speed)
            ]
            assert pushes[0] < 0
            np.testing.assert_allclose(pushes[0], -pushes[1], rtol=1e-9)


def term_on(name: str, model: Model) -> Term:
    (term,) = catalogue(name).attach(model, SCALES[model.name], MEASURED[model.name])
    return term


def push(model: Model, term: Term, x: list[float], u: list[float], parameters: list[float]) -> np.ndarray:
    off = values(model, term, x, u, [k.neutral for k in term.parameters])[0]
    return values(model, term, x, u, parameters)[0] - off


def along(model: Model, theta: float, long: float, lat: float) -> tuple[list[float], np.ndarray]:
    """Velocities of a car in the order of its states, and the matrix that turns their rates into its axes."""
    c, s = np.cos(theta), np.sin(theta)
    turn = np.array([[c, s], [-s, c]]) if model is WORLD else np.eye(2)
    return (turn.T @ [long, lat]).tolist(), turn


@pytest.mark.parametrize("name", VEHICLE)
def test_only_vehicles_have_tyres(name: str) -> None:
    quadrotor = Declared(  # two velocities and an angle, but no speed turns it
        "quadrotor", dt=0.1,
        states={n: {"unit": u, "range": [-1, 1]} for n, u in
                {"x": "m", "z": "m", "phi": "rad", "vx": "m/s", "vz": "m/s", "w": "rad/s"}.items()},
        inputs={"f": {"range": [0, 1]}, "m": {"range": [-1, 1]}},
        dynamics={"x": "vx", "z": "vz", "phi": "w", "vx": "-f*sin(phi)", "vz": "f*cos(phi) - 9.81", "w": "m"},
    ).model()  # fmt: skip
    cart = build(yaml.safe_load((conf_dir() / "sim" / "spring_cart.yaml").read_text()), "sim").model()
    for model in (quadrotor, cart, PENDULUM, TANKS):
        size = {q.name: 1.0 for q in (*model.states, *model.inputs)}
        assert not catalogue(name).attach(model, Scales(size, size, 0.1), ())
    assert [len(catalogue(name).attach(m, SCALES[m.name], ())) for m in CARS] == [1, 1, 1]


@pytest.mark.parametrize("theta", [0.0, 0.7, -2.5])
@pytest.mark.parametrize("model", [WORLD, BODY], ids=["world", "body"])
class TestCarWithTwoVelocities:
    def test_rolling_resistance_is_odd_and_along_the_heading(self, model: Model, theta: float) -> None:
        term = term_on("rolling_resistance", model)
        found = []
        for sign in (1, -1):
            v, turn = along(model, theta, sign * 1.5, 0.4)
            found.append(turn @ push(model, term, [0.1, 0.2, theta, *v, 0.3], [0.5, 0.5], [0.8, 0.05])[3:5])
        np.testing.assert_allclose(found, [[-0.8, 0], [0.8, 0]], atol=1e-9)

    def test_traction_limits_the_rate_of_the_forward_speed_alone(self, model: Model, theta: float) -> None:
        term, limit = term_on("traction_limit", model), 1.2
        v, turn = along(model, theta, 1.5, 0.4)
        x, u, yaw = [0.1, 0.2, theta, *v, 0.3], [0.5, 0.9], 0.3
        own = values(model, term, x, u, [k.neutral for k in term.parameters])[0]
        # d(long)/dt by a difference: a short time along the model's own rates
        after = np.array(x) + 1e-7 * own
        long = after[3] if model is BODY else after[3] * np.cos(after[2]) + after[4] * np.sin(after[2])
        wanted = (long - 1.5) / 1e-7
        assert abs(wanted) > limit
        change = push(model, term, x, u, [limit])
        np.testing.assert_allclose(
            turn @ change[3:5], [limit * np.tanh(wanted / limit) - wanted, 0], rtol=1e-5, atol=1e-9
        )
        assert yaw + change[5] == yaw

    def test_slip_does_not_depend_on_where_the_car_points(self, model: Model, theta: float) -> None:
        term = term_on("tyre_slip", model)
        v, turn = along(model, theta, -1.5, 0.4)
        change = push(model, term, [0.1, 0.2, theta, *v, 0.3], [0.5, 0.9], [0.2, 0.05])
        np.testing.assert_allclose(turn @ change[3:5], [0, -0.05 * -1.5 * 1.5 * 0.3], atol=1e-12)
        np.testing.assert_allclose(change[5], -0.2 * 1.5**2 * 0.3, rtol=1e-12)


def test_slip_settles_to_the_linear_single_track_model() -> None:
    """Against the steady state of the full model, by its own equations: forces of both axles, m, I, C_f, C_r."""
    l_f, l_r, mass, c_f, c_r, delta, v = 0.13, 0.17, 1.65, 30.0, 35.0, 0.05, 2.0
    matrix = np.array([  # m (dw/dt + v r) = F_f + F_r,   I dr/dt = l_f F_f - l_r F_r,   in w and r
        [-(c_f + c_r) / v, -(l_f * c_f - l_r * c_r) / v - mass * v],
        [-(l_f * c_f - l_r * c_r) / v, -(l_f**2 * c_f + l_r**2 * c_r) / v],
    ])  # fmt: skip
    w, r = np.linalg.solve(matrix, -np.array([c_f * delta, l_f * c_f * delta]))
    length, tau = l_f + l_r, 0.1
    understeer = mass * (l_r * c_r - l_f * c_f) / (length**2 * c_f * c_r)
    drift = mass * l_f / (length * c_r)
    k_yaw, k_lat = understeer / tau, (drift + l_r * understeer) / tau
    term = term_on("tyre_slip", BODY)
    x = [0, 0, 0, v, w, r]
    change = push(BODY, term, x, [0, 0], [k_yaw, k_lat])
    rolling = v * delta / length
    np.testing.assert_allclose((rolling - r) / tau + change[5], 0, atol=1e-9)
    np.testing.assert_allclose((l_r * rolling - w) / tau + change[4], 0, atol=1e-9)
    # and on a heading without inertia
    single = term_on("tyre_slip", SINGLE)
    steer = np.arctan(0.3 * rolling / v)
    np.testing.assert_allclose(values(SINGLE, single, [0, 0, 0, v], [steer, 0], [understeer])[0][2], r, rtol=1e-9)


def test_a_term_per_part_is_for_vehicles() -> None:
    with pytest.raises(ModelError, match="a term per part goes with `acts_on: planar` alone"):
        Expression("mine", acts_on="planar", term={"up": "-k"})
    with pytest.raises(ModelError, match="a term per part goes with `acts_on: planar` alone"):
        Expression("mine", acts_on="velocity", term={"long": "-k"})


def test_units_follow_from_the_model() -> None:
    units = {t.effect: t.parameters[0].unit for m, t in (pair for n in NAMES for pair in terms_of(n)) if m is PENDULUM}
    assert units["viscous_friction"] == "1/s"
    assert units["coulomb_friction"] == "rad/s^2"
    assert units["quadratic_drag"] == "1/rad"
    assert units["linear_stiffness"] == "1/s^2"
    assert units["input_delay"] == "s"
    assert units["input_dead_zone"] == "V"
    assert units["input_backlash"] == "V"
    assert [k.unit for k in term_on("tyre_slip", WORLD).parameters] == ["s/m^2", "s/(m rad)"]
    assert [k.unit for k in term_on("tyre_slip", SINGLE).parameters] == ["s^2/m^2"]


def test_roles_are_read_off_the_model() -> None:
    roles = structure(PENDULUM)
    assert roles.kinematic == ("phi",)
    assert roles.velocity == {"omega": "phi"}
    assert structure(TANKS).first_order == ("h", "k")
    car = build(yaml.safe_load((conf_dir() / "sim" / "rc_car.yaml").read_text()), "sim").model()
    assert structure(car).kinematic == ("x", "y", "theta")
    assert structure(car).velocity == {"vx": "x", "vy": "y", "omega": "theta"}


def test_a_users_own_effect() -> None:
    own = Expression(
        "swing_drag", acts_on="omega", term="-k*omega*abs(phi)", parameters={"k": {"range": [0, 5], "unit": "1/rad/s"}}
    )
    (term,) = own.attach(PENDULUM, SCALES["pendulum"], ("phi", "omega"))
    assert term.kind == RATE
    old, new = (values(PENDULUM, term, [0.5, 2.0], [0.0], [k])[0] for k in (0.0, 0.3))
    np.testing.assert_allclose(new - old, [0.0, -0.3 * 2.0 * 0.5], rtol=1e-9, atol=1e-12)


def test_unnamed_functions_reach_every_argument() -> None:
    found = unnamed(PENDULUM, SCALES["pendulum"], pairs=True)
    pairs = {("phi", "omega"), ("phi", "u"), ("omega", "u")}
    assert {t.depends_on for t in found} == {("phi",), ("omega",), ("u",)} | pairs
    two_inputs = dict.fromkeys(("x", "y", "theta", "v", "steer", "throttle"), 1.0)
    assert {len(t.depends_on) for t in unnamed(SINGLE, Scales(two_inputs, two_inputs, 0.1), pairs=True)} == {
        1
    }  # too many arguments
    assert {t.acts_on for t in found} == {"omega"}
    assert all(k.prior == "normal" for t in found for k in t.parameters)


def test_a_function_of_a_pair_has_the_product_of_the_priors() -> None:
    scales = SCALES["tanks"]
    found = {t.depends_on: t for t in unnamed(TANKS, scales, pairs=True) if t.acts_on == "h"}
    pair, first, second = (found[a] for a in (("h", "u"), ("h",), ("u",)))
    sd = lambda term, label: next(k.high / 2 for k in term.parameters if k.label == label)  # noqa: E731
    amplitude = 0.3 * scales.rate["h"]
    for j, k in ((1, 1), (2, 3), (3, 2)):
        product = sd(first, f"w{j}") * sd(second, f"w{k}") / amplitude
        np.testing.assert_allclose(sd(pair, f"w{j}{k}"), product, rtol=1e-12)
    # one weight alone is the product of its two waves
    x, u = [0.3, 0.5], [0.7]
    one = [float(k.label == "w23") for k in pair.parameters]
    waves = [
        push(TANKS, term, x, u, [float(k.label == label) for k in term.parameters])[0]
        for term, label in ((first, "w2"), (second, "w3"))
    ]
    assert abs(waves[0] * waves[1]) > 0.01
    np.testing.assert_allclose(push(TANKS, pair, x, u, one)[0], waves[0] * waves[1], rtol=1e-9)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"acts_on": "speed", "term": "-k"}, "effect.mine.acts_on: 'speed' is no role and no quantity of pendulum"),
        ({"acts_on": (), "term": "-k"}, "effect.mine.acts_on: empty"),
        ({"acts_on": "omega"}, "effect.mine: give either `term` or `operator`"),
        ({"acts_on": "u", "operator": "echo"}, "effect.mine.operator: 'echo'"),
        ({"acts_on": "omega", "term": "-k", "parameters": {"k": 3}}, "effect.mine.parameters.k: 3 has no range"),
        (
            {"acts_on": "omega", "term": "-k", "parameters": {"k": {"range": [0, "Q"]}}},
            "effect.mine.parameters.k.range",
        ),
    ],
)
def test_wrong_effects_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(ModelError) as caught:
        Expression("mine", **fields).attach(PENDULUM, SCALES["pendulum"], ("phi", "omega"))
    assert message in str(caught.value)


def test_kinds_follow_from_the_place() -> None:
    kinds = {t.effect: t.kind for n in ("input_offset", "sensor_bias", "viscous_friction") for _, t in terms_of(n)}
    assert kinds == {"input_offset": INPUT, "sensor_bias": SENSOR, "viscous_friction": RATE}


def test_exchange_with_what_an_input_tells_is_between_temperatures_or_concentrations_only() -> None:
    terms = catalogue("input_exchange").attach(ROOM, SCALES["room"], MEASURED["room"])
    x, u = [20.0, 30.0, 0.5], [50.0, 45.0, 0.3]
    before = np.asarray(ROOM.function()(x, u, augment(ROOM, [], MEASURED["room"]).neutral)[0]).ravel()
    found = [tuple(values(ROOM, t, x, u, [0.01])[0] - before) for t in terms]
    expected = [(0.3, 0, 0), (0.25, 0, 0), (0, 0.2, 0), (0, 0.15, 0)]  # and the fan blows on no dust
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert not catalogue("input_exchange").attach(TANKS, SCALES["tanks"], MEASURED["tanks"])


def test_what_a_mutual_exchange_adds_to_one_state_it_takes_from_the_other() -> None:
    terms = catalogue("mutual_exchange").attach(ROOM, SCALES["room"], MEASURED["room"])
    assert [t.acts_on for t in terms] == ["T, floor"]  # once per pair, and no dust
    x, u = [20.0, 30.0, 0.5], [50.0, 45.0, 0.3]
    before = np.asarray(ROOM.function()(x, u, augment(ROOM, [], MEASURED["room"]).neutral)[0]).ravel()
    np.testing.assert_allclose(values(ROOM, terms[0], x, u, [0.01])[0] - before, (0.1, -0.1, 0), atol=1e-12)
    for place in ("T", "floor"):  # the same term, whichever is named
        named = replace(catalogue("mutual_exchange"), acts_on=place).attach(ROOM, SCALES["room"], MEASURED["room"])
        assert named == terms
    with pytest.raises(ModelError, match=r"effect.mutual_exchange.acts_on: 'water' is no state"):
        replace(catalogue("mutual_exchange"), acts_on="water").attach(ROOM, SCALES["room"], MEASURED["room"])
    with pytest.raises(ModelError, match=r"effect.e.mutual: its term has no `other`"):
        Expression("e", "", "first_order", "-k*x", mutual=True, parameters={"k": {"range": [0, 1]}})


def test_units_are_one_or_several_and_go_with_no_planar_term() -> None:
    one = Expression("e", "", "first_order", "-k*x", units="degC", parameters={"k": {"range": [0, 1]}})
    assert [t.acts_on for t in one.attach(ROOM, SCALES["room"], MEASURED["room"])] == ["T", "floor"]
    deg = Expression("e", "", "first_order", "-k*x", units="deg", parameters={"k": {"range": [0, 1]}})
    assert not deg.attach(ROOM, SCALES["room"], MEASURED["room"])
    with pytest.raises(ModelError, match=r"effect.e.units: not with `acts_on: planar`"):
        Expression("e", "", "planar", {"long": "-k"}, units="m/s", parameters={"k": {"range": [0, 1]}})
    with pytest.raises(ModelError, match=r"effect.e.term: .* has both `other` and `around`"):
        Expression("e", "", "first_order", "k*(other - around)", parameters={"k": {"range": [0, 1]}})
