"""The blind exam itself: its data obey physics that others derived, its truth stays hidden, its scores say what they should."""

import ast
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from command_line import CACHE
from scipy.linalg import expm

from simulators.model import Declared
from tests.exam import __main__ as main
from tests.exam import campaign, mujoco_plants, nuisances, rivals, score, table, tool
from tests.exam.draw import CLOSED, FULL, NONE, ONE, POSITION, SHARE_OF_CONDITION, TWO, Set, draw, possible
from tests.exam.examine import places
from tests.exam.integrate import simulate
from tests.exam.nuisances import DIFFERING, DRIFT
from tests.exam.planted import ABSORBED, EFFECTS, LATE_SENSOR, by_key
from tests.exam.plants import SYSTEMS
from tests.exam.record import record
from tests.exam.rig import plant
from tests.exam.twins import apart, twins
from tests.exam.visible import visible
from tests.exam.write import write

EXAM = Path(__file__).parents[1] / "exam"
GENERATOR = (
    "nuisances",
    "plants",
    "formulas",
    "planted",
    "integrate",
    "mujoco_plants",
    "draw",
    "twins",
    "record",
    "rig",
    "visible",
    "write",
)
QUIET = 1e-9  # of noise


def one(
    system: str, key: str = "", *, strength: float = 1.0, condition: str = FULL, noise: float = 0.01, world: str = "own"
) -> Set:
    planted = (key,) if key else ()
    return Set(7, system, ONE if key else NONE, planted, (strength,) * len(planted), noise, condition, world, 11)


def imported(name: str) -> set[str]:
    tree = ast.parse((EXAM / f"{name}.py").read_text())
    found = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0
            found |= {
                f"{node.module}.{a.name}" if node.module == "tests.exam" else str(node.module) for a in node.names
            }
    return found


def test_the_generator_knows_nothing_of_the_tool() -> None:
    assert "simpel_cli.main" in imported("tool")  # the check sees imports inside functions
    for name in GENERATOR:
        modules = imported(name)
        assert modules or name == "twins"
        assert not {m for m in modules if m.split(".")[0] in ("simpel_cli", "simulators")}, name
        assert {m.split(".")[2] for m in modules if m.startswith("tests.exam.")} <= set(GENERATOR)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_tool_gets_the_same_equations_and_ranges(name: str) -> None:
    system, random = SYSTEMS[name], np.random.default_rng(0)
    node = yaml.safe_load((EXAM / "nominal" / f"{name}.yaml").read_text())
    model = Declared(**node).model()
    assert tuple(q.name for q in model.states) == system.states
    assert tuple(q.name for q in model.inputs) == system.inputs
    assert {q.name: (q.low, q.high) for q in model.params} == system.ranges
    assert model.dt == system.dt
    assert [(q.low, q.high) for q in model.inputs] == list(system.limits)
    for x in system.start(random, 5):
        u, p = random.uniform(*np.array(system.limits).T), system.parameters(random)
        theirs = np.asarray(model.function()(x, u, list(p.values()))[0]).ravel()
        np.testing.assert_allclose(system.rate(x, u, p), theirs, rtol=1e-12, atol=1e-12)


def test_the_integrator_has_order_four() -> None:
    system = SYSTEMS["pendulum"]
    p = {"m": 1.0, "l": 1.0, "C_m": 1.0}

    def end(fine: int) -> np.ndarray:
        rate = lambda x, u, t: system.rate(x, u, p)  # noqa: E731
        start, commands = np.array([[1.0, 0.5], [-2.0, 0.0]]), np.ones((2, 11, 1))
        return simulate(rate, start, commands, 0.1, fine=fine)[0][:, -1]

    exact = end(64)
    errors = [np.abs(end(fine) - exact).max() for fine in (2, 4, 8)]
    assert errors[0] > 1e-7
    assert all(13 < a / b < 19 for a, b in itertools.pairwise(errors))


@pytest.mark.parametrize("lag", [0.03, 0.0007])
def test_late_and_lagging_commands_and_late_records_agree_with_the_matrix_exponential(lag: float) -> None:
    dt, delay, tap = 0.04, 0.057, 0.013
    p = {"M": 1.4, "K": 60.0, "K_m": 4.0, "b": 2.0}
    commands = np.array([1.0, -2.0, 0.5, 3.0, 3.0, -1.0])[None, :, None]
    rate = lambda x, u, t: SYSTEMS["cart"].rate(x, u, p)  # noqa: E731
    start = np.array([[0.1, -0.2]])
    states, tapped, _ = simulate(rate, start, commands, dt, delay=[delay], lag=[lag], tap=tap)
    # states s, v, what the motor delivers, and the command on its way
    A = np.array([[0, 1, 0, 0], [-60 / 1.4, -2 / 1.4, 4 / 1.4, 0], [0, 0, -1 / lag, 1 / lag], [0, 0, 0, 0.0]])

    def exact(t: float) -> np.ndarray:
        y, now = np.array([0.1, -0.2, 1.0, 1.0]), 0.0
        for k, command in enumerate(commands[0, :, 0]):
            arrives = k * dt + delay
            if k and arrives < t:
                y, now = expm(A * (arrives - now)) @ y, arrives
                y[3] = command
        return (expm(A * (t - now)) @ y)[:2]

    for row in range(6):
        np.testing.assert_allclose(states[0, row], exact(row * dt), atol=5e-7)
        np.testing.assert_allclose(tapped[0, row], exact(row * dt + tap), atol=5e-7)
    assert np.abs(states[0, 4] - states[0, 3]).max() > 0.01


@pytest.mark.parametrize("system", SYSTEMS)
def test_every_effect_is_recorded_and_shows(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("rig", "record"):
        monkeypatch.setattr(f"tests.exam.{module}.ROWS", 20)  # a third of a set, for speed
    without = record(one(system, noise=QUIET)).measured
    assert np.isfinite(without).all()
    assert EFFECTS[system]
    for effect in EFFECTS[system]:
        made = record(one(system, effect.key, noise=QUIET))
        assert np.isfinite(made.measured).all(), effect.key
        assert np.abs(made.measured - without).max() > 1e-3 * without.std(), effect.key
        # nothing else was changed: with no strength the effect is not there
        none = record(one(system, effect.key, noise=QUIET, strength=1e-12)).measured
        np.testing.assert_allclose(none, without, atol=1e-5 * np.abs(without).max(), err_msg=effect.key)


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("condition", SHARE_OF_CONDITION)
def test_every_condition_is_recorded(system: str, condition: str, tmp_path: Path) -> None:
    effect = next(e for e in EFFECTS[system] if e.group == "one")
    if not possible(system, condition, (effect,)):
        assert condition == "derived velocity"
        return
    drawn = one(system, effect.key, condition=condition)
    folder, file = places(tmp_path, 0)
    write(drawn, folder, file)
    frame = pd.read_parquet(folder / "data" / "run.parquet")
    assert set(frame.split) == {"train", "test"}
    assert set(drawn.measured) <= set(frame.columns)
    assert np.isfinite(frame[list(drawn.measured)]).to_numpy().all()
    made, plain = record(drawn), record(one(system, effect.key))
    for j, (low, high) in enumerate(SYSTEMS[system].limits):
        assert low <= made.commands[..., j].min() < made.commands[..., j].max() <= high
    changed = np.abs(made.commands - plain.commands).max() > 0
    assert changed == (condition == CLOSED)
    if condition != FULL and condition != "position only":
        assert np.abs(made.measured - plain.measured).max() > 0
    told = json.loads(file.read_text())
    assert told["effects"][0]["name"] == effect.name
    words = "".join(p.read_bytes().decode(errors="replace") for p in folder.rglob("*") if p.is_file())
    assert effect.name not in words
    assert not any(name in words for name in ("truth", "planted", "strength"))


def test_the_truth_is_not_written_where_the_tool_looks(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="inside the folder"):
        write(one("cart"), tmp_path / "set", tmp_path / "set" / "truth.json")


@pytest.mark.parametrize(("system", "effect"), [(s, e) for s, names in mujoco_plants.WORLDS.items() for e in names])
def test_mujoco_and_the_own_plant_tell_the_same(system: str, effect: str) -> None:
    key = next(e.key for e in EFFECTS[system] if e.name == effect and e.group == "one")
    start = {"noise": QUIET, "strength": 0.3}
    own, theirs = (record(one(system, key, world=w, **start)).clean[:, :16] for w in ("own", "mujoco"))
    without = record(one(system, noise=QUIET)).clean[:, :16]
    size = np.abs(own - without).max()
    assert size > 1e-3
    assert np.abs(own - theirs).max() < 0.12 * size  # they differ: another law of contact, soft friction


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_constant_force_is_an_offset_of_the_motor(system: str) -> None:
    told = SYSTEMS[system]
    pairs = [(e.key, t) for e in EFFECTS[system] for t in twins(system, e.key, position_only=False)]
    key, other = next((k, t) for k, t in pairs if k.startswith(("constant_",)) and t.startswith("input_offset"))
    p = told.parameters(np.random.default_rng(3))
    constant, offset = by_key(system, key), next((e for e in EFFECTS[system] if e.key == other), None)
    if offset is None:  # the tool may name it; the exam does not plant it
        offset = by_key("pendulum", "input_offset@u")._replace(acts_on=other.split("@")[1])
    i, j = told.states.index(constant.acts_on), told.inputs.index(offset.acts_on)
    x = told.start(np.random.default_rng(4), 4)
    u = np.full((4, len(told.inputs)), 0.4)
    unit = np.eye(len(told.inputs))[j]
    gain = (told.rate(x, u + unit, p) - told.rate(x, u, p))[:, i]
    force = plant(told, p, (constant,), ({"c": float(0.1 * gain[0])},))(x, u, 0.0)
    moved = plant(told, p, (offset,), ({"b": 0.1},))(x, u, 0.0)
    np.testing.assert_allclose(force, moved, rtol=1e-10)
    assert np.abs(force - told.rate(x, u, p)).max() > 0


def test_of_a_linear_cart_the_scale_of_a_speed_is_that_of_a_position() -> None:
    told, scale = SYSTEMS["cart"], 1.3
    random = np.random.default_rng(6)
    p = {name: (low + high) / 2 for name, (low, high) in told.ranges.items()}
    other = p | {name: p[name] / scale for name in ("M", "K", "b")}
    start, commands = told.start(random, 3), told.commands(random, 3, 60)
    here, _, _ = simulate(plant(told, p, (), ()), start, commands, told.dt)
    there, _, _ = simulate(plant(told, other, (), ()), scale * start, commands, told.dt)
    np.testing.assert_allclose(here * [1, scale], there / [scale, 1], atol=1e-9)
    assert twins("cart", "sensor_scale@v", position_only=False) == ["sensor_scale@s"]


@pytest.mark.parametrize(("system", "key"), [(s, e.key) for s in SYSTEMS for e in EFFECTS[s] if e.group == ABSORBED])
def test_what_parameters_take_in_cannot_be_seen(system: str, key: str) -> None:
    drawn = one(system, key, strength=0.05)
    assert visible(drawn, record(drawn)) < 0.05
    other = one(system, next(e.key for e in EFFECTS[system] if e.name == "quadratic_drag"), strength=0.05)
    assert visible(other, record(other)) > 1


def test_draws_keep_the_shares() -> None:
    sets = [draw(i, 5) for i in range(600)]
    assert sets[:3] == [draw(i, 5) for i in range(3)]
    frame = pd.DataFrame([d._asdict() for d in sets])
    assert (frame.kind == NONE).mean() >= 0.3
    assert set(frame.system) == set(SYSTEMS)
    assert set(frame.condition) == set(SHARE_OF_CONDITION)
    assert {"none", "one", "two", "shape", "outside"} == set(frame.kind)
    assert (frame.world == "mujoco").sum() > 30
    strengths = np.log10([d.strength[0] for d in sets if d.kind == ONE])
    assert -2 <= strengths.min() < -1.9
    assert abs(strengths.mean() + 1) < 4 * 2 / np.sqrt(
        12 * len(strengths)
    )  # uniform: mean -1, within 4 standard errors
    assert not any(e.group == ABSORBED for d in sets if d.kind != NONE for e in d.effects)
    assert not any(e.kind == LATE_SENSOR for d in sets if d.condition == CLOSED for e in d.effects)
    named = {d.planted[0].split("@")[0] for d in sets if d.kind == ONE}
    assert len(named) >= 25


@pytest.mark.parametrize(
    ("system", "planted", "condition"),
    [
        ("pendulum", ("constant_load@omega", "input_offset@u"), FULL),
        ("pendulum", ("asymmetric_friction@omega", "input_offset@u"), FULL),
        ("cart", ("constant_load@v", "input_offset@u"), POSITION),
        ("car", ("constant_load@v", "input_offset@throttle"), FULL),
        ("thermal", ("constant_inflow@T_1", "input_offset@u"), FULL),
        ("thermal", ("constant_inflow@T_2", "input_offset@u"), POSITION),
        ("thermal", ("crowding@T_1", "input_offset@u"), POSITION),
        ("pendulum", ("coulomb_friction@omega", "input_offset@u"), FULL),
        ("cart", ("coulomb_friction@v", "input_offset@u"), FULL),
        ("car", ("coulomb_friction@v", "input_offset@throttle"), FULL),
        ("thermal", ("crowding@T_1", "input_offset@u"), FULL),
    ],
)
def test_two_effects_are_planted_where_each_can_be_seen_beside_the_other(
    system: str, planted: tuple[str, ...], condition: str
) -> None:
    drawn = one(system, planted[0], strength=0.05, condition=condition)._replace(
        kind=TWO, planted=planted, strength=(0.05, 0.05)
    )
    made = record(drawn)
    beside = min(visible(drawn, made, i) for i in (0, 1))
    alone = [one(system, key, strength=0.05, condition=condition) for key in planted]
    if apart(system, planted, position_only=condition == POSITION):
        assert beside > 1
    else:
        assert beside < 1e-3 * min(visible(d, record(d)) for d in alone)


@pytest.mark.parametrize(("nuisance", "other"), [(DRIFT, DIFFERING), (DIFFERING, DRIFT)])
def test_what_no_constant_is_worth_goes_with_its_square_and_the_noise(
    monkeypatch: pytest.MonkeyPatch, nuisance: str, other: str
) -> None:
    drawn = one("cart", "quadratic_drag@v", strength=0.3)._replace(nuisances=(nuisance,))

    def worth(drawn: Set) -> float:
        return visible(drawn, record(drawn), moving=True)

    quiet, loud = (worth(drawn._replace(noise=noise)) for noise in (0.001, 0.01))
    assert quiet == pytest.approx(100 * loud, rel=0.1)
    assert worth(drawn._replace(nuisances=())) == 0
    for name in ("DRIFTS", "DIFFERS"):
        monkeypatch.setattr(nuisances, name, getattr(nuisances, name) / 3)
    assert worth(drawn._replace(noise=0.001)) == pytest.approx(quiet / 9, rel=0.2)
    assert worth(drawn._replace(nuisances=(other,), noise=0.001)) != pytest.approx(quiet / 9, rel=0.05)


def test_the_table_says_how_often_a_drift_is_named_where_it_shows() -> None:
    scores = pd.DataFrame({
        "index": range(3), "system": "cart", "kind": "none", "outcome": "right", "noise": 0.01, "condition": FULL,
        "world": "own", "evidence": np.nan,
        "named": [json.dumps({"drift": said}) for said in (True, False, False)],
        "shows": [json.dumps({"drift": nats}) for nats in (300.0, 9.9, 12.0)],
    })  # fmt: skip
    rows = {line.split(" | ")[0].strip("| "): line for line in table.report(scores).splitlines()}
    assert "1/3 = 33.3 %" in rows["nuisance named: drift"]
    assert "1/2 = 50.0 %" in rows["- drift, where it is worth >= 10 nats"]
    assert "- drift, where it is worth >= 10 nats" not in table.report(scores.drop(columns="shows"))


def test_one_sensor_at_the_end_of_a_linear_chain_sees_no_further_coupling() -> None:
    worth = {
        c: visible(d, record(d)) for c in (FULL, POSITION) if (d := one("thermal", "thermal_coupling@T_1", condition=c))
    }
    assert worth[FULL] > 100
    assert worth[POSITION] < 1e-2 * worth[FULL]


def test_no_two_effects_are_drawn_that_make_up_for_each_other() -> None:
    pairs = [d for d in (draw(i, 9) for i in range(3000)) if d.kind == TWO]
    assert {POSITION, FULL} < {d.condition for d in pairs}
    assert all(apart(d.system, d.planted, position_only=d.condition == POSITION) for d in pairs)


def verdict(*effects: dict[str, Any], kind: str = "effect", remainder: Any = None) -> dict[str, Any]:
    return {"verdict": kind, "effects": list(effects), "remainder": remainder}


def claim(*names: str, on: str = "v", same_as: tuple[str, ...] = ()) -> dict[str, Any]:
    return {
        "name": names[0], "acts_on": on, "class": list(names), "class_acts_on": dict.fromkeys(names, on),
        "same_as": list(same_as), "log_evidence_gain": 20.0,
    }  # fmt: skip


def planted(name: str, on: str = "v", **more: Any) -> dict[str, Any]:
    return {"name": name, "acts_on": on, "accept": [name], "twins": [], "parameters": {}, "strength": 1.0} | more


COULOMB, DELAY = planted("coulomb_friction"), planted("input_delay", "u")
LOAD = planted("constant_load", twins=["input_offset@u"])
DRAG = planted("drag", accept=["quadratic_drag", "viscous_friction"])
OFFSET = claim("input_offset", on="u")
EITHER = claim("constant_load", "input_offset") | {"class_acts_on": {"constant_load": "v", "input_offset": "u"}}
ASYMMETRIC = claim("asymmetric_friction")
PAIR = [{"name": "coulomb_friction", "acts_on": "v"}, {"name": "input_offset", "acts_on": "u"}]
BESIDE_A_NUISANCE = [{"name": "coulomb_friction", "acts_on": "v"}, {"name": "sensor_delay", "acts_on": "v"}]
RIVALS = [{"name": n, "acts_on": "v", "same": n == "asymmetric_friction"} for n in ("asymmetric_friction", "drag")]
LEFT = {"acts_on": "v", "depends_on": ["v"]}
LATE = claim("sensor_delay") | {"class_members": [{"name": "sensor_delay", "acts_on": "v"}]}
LATE_OR_SLOW = claim("sensor_delay", "sensor_lag") | {
    "class_members": [{"name": name, "acts_on": "v"} for name in ("sensor_delay", "sensor_lag")]
}


@pytest.mark.parametrize(
    ("kind", "effects", "found", "expected"),
    [
        ("none", [], verdict(kind="none"), "right"),
        ("none", [], verdict(kind="unexplained"), "unexplained"),
        ("none", [], verdict(LATE), "right"),  # a nuisance may be named
        ("none", [], verdict(LATE, remainder=LEFT), "unexplained"),
        ("none", [], verdict(claim("coulomb_friction"), remainder=LEFT), "false effect"),
        ("one", [COULOMB], verdict(claim("coulomb_friction")), "right"),
        ("one", [COULOMB], verdict(claim("coulomb_friction", on="w")), "wrong"),
        ("one", [planted("sensor_lag", on="v")], verdict(LATE_OR_SLOW), "tie"),
        ("one", [COULOMB], verdict(LATE_OR_SLOW, claim("coulomb_friction")), "right"),
        ("one", [COULOMB], verdict(claim("stribeck_friction")), "wrong"),
        ("one", [COULOMB], verdict(claim("stribeck_friction", "coulomb_friction")), "tie"),
        ("one", [COULOMB], verdict(claim("coulomb_friction"), claim("input_delay", on="u")), "wrong"),
        ("one", [COULOMB], verdict(kind="none"), "nothing"),
        ("one", [COULOMB], verdict(kind="unexplained", remainder=LEFT), "unexplained"),
        ("one", [LOAD], verdict(OFFSET), "twin"),
        ("one", [LOAD], verdict(EITHER), "right"),
        ("one", [COULOMB], verdict(OFFSET), "wrong"),
        ("one", [planted("gravity_tilt")], verdict(claim("sensor_bias", on="phi", same_as=("gravity_tilt",))), "right"),
        ("two", [COULOMB, DELAY], verdict(claim("input_delay", on="u"), claim("coulomb_friction")), "right"),
        ("two", [COULOMB, DELAY], verdict(claim("coulomb_friction")), "part"),
        ("two", [COULOMB, LOAD], verdict(ASYMMETRIC), "wrong"),
        ("two", [COULOMB, LOAD], verdict(ASYMMETRIC | {"same_as_two": [PAIR]}), "tie"),
        ("two", [LOAD, COULOMB], verdict(ASYMMETRIC | {"same_as_two": [PAIR]}), "tie"),
        ("two", [COULOMB, LOAD], verdict(ASYMMETRIC | {"same_as_two": [PAIR]}, claim("leak")), "wrong"),
        ("two", [COULOMB, LOAD], verdict(ASYMMETRIC | {"same_as_two": [PAIR], "class_members": RIVALS}), "tie"),
        ("two", [COULOMB, DELAY], verdict(ASYMMETRIC | {"same_as_two": [PAIR]}), "wrong"),
        ("one", [COULOMB], verdict(ASYMMETRIC | {"same_as_two": [PAIR]}), "wrong"),
        ("one", [COULOMB], verdict(ASYMMETRIC | {"same_as_two": [BESIDE_A_NUISANCE]}), "tie"),
        ("one", [LOAD], verdict(ASYMMETRIC | {"same_as_two": [BESIDE_A_NUISANCE]}), "wrong"),
        ("two", [COULOMB, DELAY], verdict(claim("coulomb_friction"), claim("leak")), "wrong"),
        ("two", [COULOMB, DELAY], verdict(claim("coulomb_friction"), claim("input_delay", "input_lag", on="u")), "tie"),
        ("shape", [DRAG], verdict(claim("quadratic_drag"), claim("viscous_friction")), "right"),
        ("shape", [DRAG], verdict(claim("end_stop"), remainder=LEFT), "hedged"),
        ("shape", [DRAG], verdict(claim("end_stop")), "wrong"),
        ("outside", [planted("wind")], verdict(kind="unexplained", remainder=LEFT), "right"),
        ("outside", [planted("wind")], verdict(claim("cogging"), remainder=LEFT), "right"),
        ("outside", [planted("wind")], verdict(claim("cogging")), "wrong"),
        ("outside", [planted("wind")], verdict(LATE, remainder=LEFT), "right"),
        ("outside", [planted("wind")], verdict(LATE), "nothing"),
        ("outside", [planted("wind")], verdict(kind="none"), "nothing"),
    ],
)  # fmt: skip
def test_outcomes(kind: str, effects: list[dict[str, Any]], found: dict[str, Any], expected: str) -> None:
    truth = {"kind": kind, "effects": effects, "may_be": [["sensor_delay", "v"]]}
    assert score.outcome(truth, found) == expected


@pytest.mark.parametrize(("more", "expected"), [(2.0, "tie"), (9.0, "wrong")])
def test_a_special_case_is_no_error_while_the_data_ask_for_no_more(more: float, expected: str) -> None:
    gains = {("coulomb_friction", "v"): 50.0, ("stribeck_friction", "v"): 50.0 + more}
    truth = {"kind": "one", "effects": [planted("stribeck_friction")]}
    assert score.outcome(truth, verdict(claim("coulomb_friction")), gains) == expected


def test_coverage_counts_what_the_data_determine() -> None:
    truth = {
        "kind": "one", "world": "own", "effects": [planted("coulomb_friction", parameters={"tau_c": 0.4})],
        "parameters": {n: {"value": 1.0, "range": [0.0, 2.0]} for n in ("inside", "beside", "open")},
    }  # fmt: skip
    ends = {"inside": (0.9, 1.1), "beside": (1.1, 1.2), "open": (0.2, 1.9)}
    found = verdict(claim("coulomb_friction") | {"parameters": {"tau_c": {"low": 0.3, "high": 0.5}}})
    found["parameters"] = {n: {"after": {"low": a, "high": b}} for n, (a, b) in ends.items()}
    assert score.covered(truth, "right", found) == (2, 3)
    assert score.covered(truth, "wrong", found) == (0, 0)


def test_errors_are_compared_over_channels() -> None:
    mine = {"error": {"after": {"horizon": {"s": 1.0, "v": 4.0}}, "before": {"horizon": {"s": 2.0, "v": 18.0}}}}
    assert score.error_ratio(mine, mine, "before") == pytest.approx(3.0)
    assert score.error_ratio(mine, None) == pytest.approx(1.0)


def test_intervals_are_clopper_and_pearsons() -> None:
    assert table.interval(0, 349) == (0.0, pytest.approx(1 - 0.025 ** (1 / 349)))
    assert table.interval(10, 10) == (pytest.approx(0.025**0.1), 1.0)
    assert table.interval(5, 10)[0] == pytest.approx(1 - table.interval(5, 10)[1])


def test_the_table_has_every_bar_and_tells_what_is_missed() -> None:
    rows = [
        {
            "index": i, "system": "cart", "kind": ("one", "none")[i % 2], "condition": "full", "noise": 0.01, "world": "own",
            "strength": (0.5, 0.1)[i % 8 // 4], "memory_mb": 100.0 + i, "planted": "",
            "outcome": ("right", "right", "wrong", "false effect")[i % 4], "names": "", "evidence": 50.0,
            "bic": "wrong", "of_oracle": 1.0, "of_before": 1.0, "covered": 9, "intervals": 10, "seconds": 3.0,
            "candidates": 20, "message": "",
        }
        for i in range(40)
    ]  # fmt: skip
    text = table.report(pd.DataFrame(rows))
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in text.splitlines()}
    exact = lines["planted effect named exactly, noise <= 1 %, oracle >= 10 nats"]
    assert "10/20 = 50.0 % (27..73)" in exact
    assert "not installed" in exact
    assert exact.endswith("NO |")
    assert "5/10" in lines["planted effect named exactly, noise <= 1 %, default strengths (upper half decade)"]
    assert "10/20" in lines["- named exactly at 1 % noise, oracle >= 10 nats"]
    assert "no sets" in lines["- named exactly at 3 % noise, oracle >= 10 nats"]
    assert ">= 45.0 % (full - 5)" in lines["- exact or tie, oracle >= 10 nats: position only"]
    assert "3.0 s (nine in ten below 3.0 s, 20 candidates)" in lines["seconds of a search, 2 states, median"]
    assert any(line.startswith("| cart | 2 | 40 | 3 | 3 |") and line.endswith(" 139 |") for line in text.splitlines())
    assert "10/20" in lines["effect claimed on data with none"]
    assert lines["intervals of parameters and effects that cover (claimed: 90 %)"].endswith("yes |")
    assert "no sets" in lines["two effects, both named, oracle >= 10 nats each"]
    assert all(bar.figure in lines for bar in table.BARS)


@pytest.mark.parametrize("condition", [FULL, POSITION])
def test_the_rivals_name_what_a_regression_can_see(condition: str, tmp_path: Path) -> None:
    folder, file = places(tmp_path, 0)
    write(one("pendulum", "viscous_friction@omega", noise=1e-4, condition=condition), folder, file)
    truth = json.loads(file.read_text())
    made = rivals.problem(folder, "pendulum", truth["measured"])
    target, columns, more = made["omega"]
    added = next(c.values for c in more if c.effect == "viscous_friction")
    fit = np.linalg.lstsq(np.column_stack([columns, added]), target, rcond=None)[0]
    assert fit[-1] == pytest.approx(-truth["effects"][0]["parameters"]["b"], rel=0.05)
    assert ("viscous_friction", "omega") in rivals.forward(made)
    if not rivals.installed():
        return
    for size in (rivals.WHOLE, rivals.LEFT):
        assert rivals.sparse(made, 0.1, size) == [("viscous_friction", "omega")]
        assert rivals.sparse(made, 10.0, size) == []


@pytest.mark.parametrize(("key", "at"), [("input_dead_zone@u", 0.2), ("cogging@omega", 4)])
def test_of_the_columns_of_an_effect_those_that_fit_best_are_kept(key: str, at: float, tmp_path: Path) -> None:
    folder, file = places(tmp_path, 0)
    write(one("pendulum", key, strength=0.6, noise=1e-4), folder, file)
    target, columns, more = rivals.problem(folder, "pendulum", ["phi", "omega"])["omega"]
    whole = np.stack([c.values for c in more], -1)
    left, aim = (a - columns @ np.linalg.lstsq(columns, a, rcond=None)[0] for a in (whole, target))
    kept = [more[i] for i in rivals._one_shape_each(more, whole, left, aim)]
    assert {c.at for c in kept if c.effect == key.split("@")[0]} == {at}
    assert len([c for c in kept if c.effect == "cogging"]) == 2
    assert len({(c.effect, c.acts_on) for c in kept}) == len(kept) - 1


@pytest.mark.slow  # tests/discovery/test_discover.py finds one from end to end
def test_a_strong_effect_is_found_in_a_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(CACHE))
    folder, file = places(tmp_path, 0)
    write(one("cart", "coulomb_friction@v", strength=0.5), folder, file)
    few = ("coulomb_friction", "quadratic_drag", "constant_load")
    answer = tool.discover(folder, "run", few)
    assert not answer.error
    found = json.loads((answer.directory / "verdict.json").read_text())
    truth = json.loads(file.read_text())
    assert score.outcome(truth, found) == "right"
    inside, counted = score.covered(truth, "right", found)
    assert counted >= 3
    assert inside >= 1
    assert tool.discover(folder, "run", few).wall != answer.wall  # what was run is not run again
    (folder / "sim" / "rig.yaml").write_text("_target_: simulators.model.Declared\nname: broken\n")
    assert "ConfigError" in tool.discover(folder, "other").error


def test_runs_on_one_folder_share_the_systems(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[tuple[str, str]] = []

    def fake(waiting: list[Set], out: Path, tuned: Any, workers: int) -> None:
        for drawn in waiting:
            ran.append((drawn.system, str(drawn.index)))
            campaign.keep(out, campaign.lost(drawn, out, "not run"))

    monkeypatch.setattr(main, "run", fake)
    monkeypatch.setattr(main, "tuned", lambda: {"cart 0.01": (0.1, "left")})
    command = ["exam", "--sets", "12", "--seed", "4", "--out", str(tmp_path)]
    for only in (["cart"], ["pendulum", "cart"], []):
        monkeypatch.setattr("sys.argv", [*command, *(["--only", *only] if only else [])])
        main.main()
    systems = [system for system, _ in ran]
    assert len(set(ran)) == len(ran) == 12
    assert systems == sorted(systems, key=lambda s: (s != "cart", s != "pendulum"))
    assert len(pd.read_parquet(tmp_path / "scores.parquet")) == 12
    assert json.loads((tmp_path / "exam.json").read_text())["tuned"] == {"cart 0.01": [0.1, "left"]}


def test_an_exam_goes_on_from_scores_that_were_made_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table is the same as if all had been run in one place; scores of another exam are refused."""
    ran: list[int] = []

    def fake(waiting: list[Set], out: Path, tuned: Any, workers: int) -> None:
        for d in waiting:
            ran.append(d.index)
            numbers = {
                "strength": 0.5,
                "evidence": float("nan") if d.index % 2 else 20.0,
                "of_oracle": None,
                "of_before": 1.5,
            }
            told = {"outcome": "right", "names": "a|b", "remainder": d.index % 3 == 0, "covered": 2, "intervals": 3}
            campaign.keep(
                out, campaign.lost(d, out, "") | numbers | told | {"seconds": 2.0, "candidates": 3, "wall": 4.0}
            )

    monkeypatch.setattr(main, "run", fake)
    monkeypatch.setattr(main, "tuned", dict)
    first, second, whole, other = (tmp_path / name for name in ("first", "second", "whole", "other"))

    def exam(out: Path, sets: int, *more: str, seed: int = 4) -> None:
        monkeypatch.setattr("sys.argv", ["exam", "--sets", str(sets), "--seed", str(seed), "--out", str(out), *more])
        main.main()

    exam(first, 7)
    exam(second, 12, "--known", str(first / "scores.parquet"))
    assert ran == [*dict.fromkeys(ran)]
    assert len(ran) == 12
    exam(whole, 12)
    assert (second / "table.md").read_text() == (whole / "table.md").read_text()
    with pytest.raises(SystemExit, match="none of the exam with seed 5"):
        exam(other, 7, "--known", str(first / "scores.parquet"), seed=5)


def test_plays_and_slow_sensors_agree_with_their_definitions() -> None:
    dt, tau, half = 0.04, 0.05, 0.8
    p = {"M": 1.4, "K": 60.0, "K_m": 4.0, "b": 2.0}
    commands = np.array([1.0, -2.0, -1.5, 3.0, 2.5, -1.0])[None, :, None]
    rate = lambda x, u, t: SYSTEMS["cart"].rate(x, u, p)  # noqa: E731
    start = np.array([[0.1, -0.2]])
    passed = np.array([1.0, -1.2, -1.2, 2.2, 2.2, -0.2])[None, :, None]
    states, _, given = simulate(rate, start, commands, dt, play=[half])
    np.testing.assert_allclose(states, simulate(rate, start, passed, dt)[0], rtol=1e-12)
    np.testing.assert_array_equal(given, commands)
    held = np.full_like(commands, 1.0)
    states, read, _ = simulate(rate, start, held, dt, sensor_lag=np.array([0.0, tau]), fine=32)
    np.testing.assert_allclose(read[..., 0], states[..., 0], rtol=1e-12)
    # states s, v, what the sensor of v reads, and the command
    A = np.array([[0, 1, 0, 0], [-60 / 1.4, -2 / 1.4, 0, 4 / 1.4], [0, 1 / tau, -1 / tau, 0], [0, 0, 0, 0.0]])
    exact = [(expm(A * row * dt) @ [0.1, -0.2, -0.2, 1.0])[2] for row in range(6)]
    np.testing.assert_allclose(read[0, :, 1], exact, atol=1e-4)
