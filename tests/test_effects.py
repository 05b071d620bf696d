"""The catalogue of effects: every YAML in conf/effect, at every place where it can act."""

import re

import casadi
import numpy as np
import pytest
import yaml

from simpel_cli.config import conf_dir
from simpel_cli.discovery.augmented import augment
from simpel_cli.nodes import build
from simulators.effects import Expression, Scales, Term, structure, unnamed
from simulators.effects.term import INPUT, OPERATORS, RATE, SENSOR
from simulators.model import Declared, Model, ModelError

NAMES = sorted(p.stem for p in (conf_dir() / "effect").glob("*.yaml") if p.stem != "all")


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


PENDULUM, TANKS = pendulum(), tanks()
SCALES = {
    "pendulum": Scales({"phi": 3.0, "omega": 4.0, "u": 2.0}, {"phi": 2.0, "omega": 6.0}, 0.05),
    "tanks": Scales({"h": 0.8, "k": 0.7, "u": 1.0}, {"h": 0.2, "k": 0.1}, 1.0),
}


def terms_of(name: str) -> list[tuple[Model, Term]]:
    effect = catalogue(name)
    return [
        (model, term)
        for model, measured in ((PENDULUM, ("phi", "omega")), (TANKS, ("h", "k")))
        for term in effect.attach(model, SCALES[model.name], measured)
    ]


def values(
    model: Model, term: Term, x: list[float], u: list[float], knobs: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Rates and readings with one term, parameters in the middle of their ranges."""
    together = augment(model, [term], [q.name for q in model.states])
    p = np.concatenate([together.neutral[: len(model.params)], knobs])
    rates, y = together.function(casadi.DM(x), casadi.DM(u), casadi.DM(p))
    return np.asarray(rates).ravel(), np.asarray(y).ravel()


def points(model: Model, seed: int = 0) -> list[tuple[list[float], list[float]]]:
    random = np.random.default_rng(seed)
    return [
        tuple([float(random.uniform(q.low, q.high)) for q in group] for group in (model.states, model.inputs))
        for _ in range(12)
    ]


def test_the_catalogue_is_that_of_the_plan() -> None:
    assert len(NAMES) >= 29
    listed = yaml.safe_load((conf_dir() / "effect" / "all.yaml").read_text())["defaults"]
    assert sorted(listed) == NAMES


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
                old = np.asarray(
                    model.function()(x, u, augment(model, [], ["h"] if model is TANKS else ["phi"]).neutral)[0]
                )
                rates, y = values(model, term, x, u, [k.neutral for k in term.knobs])
                np.testing.assert_allclose(rates, old.ravel(), rtol=1e-12, atol=1e-12)
                np.testing.assert_allclose(y, x, rtol=1e-12)

    def test_changes_the_model_at_its_starts(self, name: str) -> None:
        for model, term in terms_of(name):
            if term.kind in OPERATORS:
                continue
            starts = [k.starts[0] for k in term.knobs]
            change = 0.0
            for x, u in [*points(model), ([q.high for q in model.states], [q.high for q in model.inputs])]:
                old = values(model, term, x, u, [k.neutral for k in term.knobs])
                new = values(model, term, x, u, starts)
                change = max(change, *(np.abs(a - b).max() for a, b in zip(old, new, strict=True)))
            assert change > 0

    def test_starts_and_neutral_point_lie_in_the_range(self, name: str) -> None:
        for _, term in terms_of(name):
            for knob in term.knobs:
                assert knob.low < knob.high
                assert all(knob.low < s < knob.high for s in knob.starts)
                # a limit is neutral where nothing reaches it, beyond the range
                assert knob.low <= knob.neutral <= knob.high or (
                    term.effect == "input_saturation" and knob.neutral > knob.high
                )
                assert re.fullmatch(r"[\w^/() ]+", knob.unit), knob.unit

    def test_never_adds_energy_if_it_says_so(self, name: str) -> None:
        effect, random = catalogue(name), np.random.default_rng(1)
        if not effect.dissipative:
            return
        for model, term in terms_of(name):
            row = [q.name for q in model.states].index(term.acts_on)
            for x, u in points(model):
                knobs = [float(random.uniform(k.low, k.high)) for k in term.knobs]
                off = values(model, term, x, u, [k.neutral for k in term.knobs])[0]
                assert (values(model, term, x, u, knobs)[0] - off)[row] * x[row] <= 0


@pytest.mark.parametrize("name", ["viscous_friction", "coulomb_friction", "stribeck_friction", "quadratic_drag"])
def test_friction_is_odd_in_speed(name: str) -> None:
    for model, term in terms_of(name):
        knobs = [k.starts[0] for k in term.knobs]
        for speed in (0.01, 0.5, 3.0):
            pushes = [
                values(model, term, [0.3, s], [0.0], knobs)[0][1]
                - values(model, term, [0.3, s], [0.0], [k.neutral for k in term.knobs])[0][1]
                for s in (speed, -speed)
            ]
            assert pushes[0] < 0
            np.testing.assert_allclose(pushes[0], -pushes[1], rtol=1e-9)


def test_units_follow_from_the_model() -> None:
    units = {t.effect: t.knobs[0].unit for m, t in (pair for n in NAMES for pair in terms_of(n)) if m is PENDULUM}
    assert units["viscous_friction"] == "1/s"
    assert units["coulomb_friction"] == "rad/s^2"
    assert units["quadratic_drag"] == "1/rad"
    assert units["linear_stiffness"] == "1/s^2"
    assert units["input_delay"] == "s"
    assert units["input_dead_zone"] == "V"


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
    found = unnamed(PENDULUM, SCALES["pendulum"])
    assert {t.depends_on for t in found} == {("phi",), ("omega",), ("u",)}
    assert {t.acts_on for t in found} == {"omega"}
    assert all(k.prior == "normal" for t in found for k in t.knobs)


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
