"""The corrected YAML against the model that the search fitted: the same rates and readings at random points."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.data.estimation.smoother import speeds
from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery import run as discovery_run
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.verdict import corrected as module
from simpel_cli.errors import NumericsError
from simpel_cli.filtering.likelihood.augmented import augment
from simpel_cli.filtering.likelihood.fit import Optimum
from simpel_cli.filtering.setup import terms_of
from simpel_cli.runs.console import Terminal
from simpel_cli.studies.declared import Declared
from simulators.effects import Scales, Term
from simulators.model import Model

OF_A_SHAFT = ("coulomb_friction", "input_offset", "input_saturation")
CASES = {
    "rc_car": ("rolling_resistance", "traction_limit", "tyre_slip", "input_saturation", "motor_back_emf"),
    "racecar": ("rolling_resistance", "traction_limit", "input_saturation", "input_delay", "pacejka_tyre"),
    "oven": ("radiation", "mutual_exchange", "voltage_sag", "input_offset"),
    "oven in Python": ("radiation", "mutual_exchange", "voltage_sag", "input_offset"),
    "cascaded_tanks": ("overflow_into", "outflow_exponent", "input_offset"),
    "pendulum": ("coulomb_friction", "added_inertia", "input_offset", "input_dead_zone"),
}


def node_of(group: str, name: str) -> dict[str, Any]:
    return yaml.safe_load((conf_dir() / group / f"{name}.yaml").read_text())


def written(
    sim: str | dict[str, Any],
    effects: tuple[str | dict[str, Any], ...],
    monkeypatch: pytest.MonkeyPatch,
    measured: tuple[str, ...] = (),
    substeps: int = 1,
) -> tuple[Model, list[Term], dict[str, Any], list[str]]:
    """Return the model, the terms, the corrected YAML with the terms at their starts, and what was left out."""
    node = node_of("sim", sim) if isinstance(sim, str) else sim
    model = build(node, "sim").model()
    scales = Scales(
        {q.name: 1.0 for q in (*model.states, *model.inputs, *model.outputs)},
        {q.name: 2.0 for q in model.states},
        model.dt,
    )
    names = [q.name for q in model.states]
    terms: list[Term] = [
        build(node_of("effect", e) if isinstance(e, str) else e, "effect").attach(
            model, scales, measured or tuple(names[:1])
        )[0]
        for e in effects
    ]
    parameters = [k for t in terms for k in t.parameters]
    rows = [[parameters.index(k) for k in t.parameters] for t in terms]
    point = {i: dict.fromkeys(("value", "low", "high"), k.starts[0]) for i, k in enumerate(parameters)}
    monkeypatch.setattr(module, "interval_of", lambda search, trial, row, z: point[row])
    # the order in which terms were accepted is not that in which they were attached
    search = Search.__new__(Search)
    search.terms, search.rows = tuple(terms), [tuple(r) for r in rows]
    search.plan = SimpleNamespace(
        substeps=substeps, augmented=SimpleNamespace(params=(), model=model, measured=measured or tuple(names))
    )
    nothing = Optimum(np.zeros(1), (), 0.0, 0.0, np.zeros(0), np.eye(1), np.zeros(0), np.eye(1), 0, True)
    trial = Trial(tuple(reversed(range(len(terms)))), nothing)
    _, corrected, left_out = module.corrected(node, model, search, trial)
    return model, terms, corrected, left_out


SHAFT = {
    "name": "shaft",
    "dt": 0.1,
    "states": {
        "angle": {"unit": "rad", "range": [-9, 9], "role": "position"},
        "n": {"unit": "1/s", "range": [-10, 10], "role": "velocity"},
    },
    "inputs": {"u": {"unit": "V", "range": [-1, 1]}},
    "parameters": {"gear": {"unit": "1", "range": [0.1, 0.2]}, "k": 0.3, "w": 1.0},
    "intermediates": {"push": {"unit": "1/s^2", "expression": "torque + 0.1*u*n"}, "tau_c": "k*n"},
    "tables": {"torque": {"inputs": ["u", "n"], "axes": [[-1, 1], [-9, 9]], "values": [[-3, -1], [2, 4]]}},
    "dynamics": {"angle": "gear*n", "n": "push - tau_c"},
    "outputs": {
        "amps": {"unit": "A", "expression": "torque*u", "scale": "k", "bias": 0.1, "saturates": [-0.5, 0.5]},
        "tacho": {"unit": "V", "expression": "n", "scale": 2, "lag": 0.2, "range": [-20, 20]},
    },
}


OVEN = {
    "name": "oven",
    "dt": 1.0,
    "states": {n: {"unit": "degC", "range": [20, 400], "role": "temperature"} for n in ("T", "lid")},
    "inputs": {n: {"unit": "%", "range": [0, 100]} for n in ("top", "bottom")},
    "parameters": {"a": {"unit": "degC/s/%", "range": [0.01, 0.02]}},
    "dynamics": {"T": "a*(top + 2*bottom) - 0.01*(T - lid)", "lid": "a*top"},
}


@pytest.mark.parametrize(("fitted", "own", "takes"), [(8, 3, 8), (8, None, None), (2, 3, 3)])
def test_the_yaml_takes_as_many_steps_as_its_parameters_were_fitted_with(
    fitted: int, own: int | None, takes: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim = OVEN if own is None else OVEN | {"substeps": own}
    _, _, corrected, _ = written(sim, CASES["oven"], monkeypatch, substeps=fitted)
    assert corrected.get("substeps") == takes  # None: what is usual, which is more


@pytest.mark.parametrize("sim", [*CASES, "shaft", "in Python"])
def test_the_yaml_has_the_rates_that_were_fitted(sim: str, monkeypatch: pytest.MonkeyPatch) -> None:
    in_python = {n: {"_target_": module.EXTENDED, "name": "more", "base": base} for n, base in
                 (("in Python", SHAFT), ("oven in Python", OVEN))}  # fmt: skip
    node: Any = ({"shaft": SHAFT, "oven": OVEN} | in_python).get(sim, sim)
    model, terms, corrected, left_out = written(node, CASES.get(sim, OF_A_SHAFT), monkeypatch)
    new = build(corrected, "sim").model()
    assert (new.states, new.saturation) == (model.states, model.saturation)
    together = augment(model, terms, [q.name for q in (*model.states, *model.outputs)])
    random, parameters = np.random.default_rng(0), [k.starts[0] for t in terms for k in t.parameters]
    assert left_out == []
    for term in terms:
        if term.kind == "delay":
            assert new.fixed[new.delay[term.acts_on]] == term.parameters[0].starts[0]
    changed = 0.0
    for _ in range(10):
        x, u, p = (
            [random.uniform(q.low, q.high) for q in group] for group in (model.states, model.inputs, model.params)
        )
        fitted, old = (
            np.asarray(f(x, u, q)[0]).ravel()
            for f, q in ((together.function, [*p, *parameters]), (model.function(), p))
        )
        rates, outputs = (np.asarray(part).ravel() for part in new.function()(x, u, p))
        np.testing.assert_allclose(rates, fitted, rtol=1e-9, atol=1e-9)
        measured = np.asarray(together.function(x, u, [*p, *parameters])[1]).ravel()
        np.testing.assert_allclose(outputs, measured[len(model.states) :], rtol=1e-9, atol=1e-9)
        changed = max(changed, float(np.abs(fitted - old).max()))
    assert changed > 0.1


def test_intermediates_tables_roles_and_sensors_are_carried_on(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, corrected, _ = written(SHAFT, OF_A_SHAFT, monkeypatch)
    assert corrected["states"] == SHAFT["states"]
    assert corrected["tables"]["torque"] == SHAFT["tables"]["torque"] | {"inputs": ["u_acting", "n"]}
    assert corrected["intermediates"].keys() == {"push", "tau_c", "u_acting"}
    # the friction has parameters called tau_c and w, two names that the simulator has already
    assert {"tau_c_n", "w_n"} <= corrected["parameters"].keys()
    for name, own in SHAFT["outputs"].items():
        assert corrected["outputs"][name] | {"expression": ""} == own | {"expression": ""}
    assert SHAFT["tables"]["torque"]["inputs"] == ["u", "n"]  # what was declared is not changed


ON_SENSORS = ("sensor_scale", "sensor_bias", "sensor_lag", "sensor_delay", "coulomb_friction", "input_offset")


@pytest.mark.parametrize(
    ("sim", "place"),
    [("pendulum", "omega"), ("shaft", "amps"), ("shaft", "tacho"), ("in Python", "n"), ("with sensors", "n")],
)
def test_sensors_show_what_was_fitted(sim: str, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a sensor shows, and its rate, are those of the model that was fitted."""
    seen = {"name": "seen", **SHAFT, "sensors": {"n": {"value": "1.5*n - 0.4"}}}
    node: Any = {
        "shaft": SHAFT,
        "in Python": {"_target_": module.EXTENDED, "name": "more", "base": SHAFT},
        "with sensors": seen,
    }.get(sim, sim)
    model, terms, corrected, left_out = written(node, ON_SENSORS, monkeypatch, (place,))
    assert left_out == []
    new = build(corrected, "sim").model()
    times = [new.fixed[of[place]] for of in (new.sensor_lag, new.sensor_delay)]  # type: ignore[index]
    assert times == [t.parameters[0].starts[0] for t in terms[2:4]]
    together = augment(model, terms, [q.name for q in (*model.states, *model.outputs)]).function
    names = [q.name for q in (*model.states, *model.outputs)]
    random, parameters = np.random.default_rng(0), [k.starts[0] for t in terms for k in t.parameters]
    for _ in range(5):
        x, u, p = (
            [random.uniform(q.low, q.high) for q in group] for group in (model.states, model.inputs, model.params)
        )
        rates, shown = (np.asarray(part).ravel() for part in together(x, u, [*p, *parameters]))
        read = shown[: len(x)]
        own, outputs = (np.asarray(part).ravel() for part in new.function()(read, u, p))
        scale = [1.02 if name == place else 1.0 for name in names[: len(x)]]
        np.testing.assert_allclose(own, rates * scale, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(outputs, shown[len(x) :], rtol=1e-9, atol=1e-9)
        assert abs(shown[names.index(place)] - np.asarray([*x, *outputs])[names.index(place)]) > 1e-3 or place == "amps"


def test_a_speed_that_is_not_measured_has_the_sensor_of_its_position(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, corrected, _ = written("pendulum", ("sensor_bias", "sensor_scale", "sensor_lag"), monkeypatch, ("phi",))
    assert corrected["sensors"] == {
        "phi": {"value": "(phi + b)*(1 + a)", "lag": "tau"},
        "omega": {"value": "omega*(1 + a)", "lag": "tau"},
    }
    assert speeds(build(corrected, "sim").model()) == {"omega": ["phi"]}


def test_what_a_transition_cannot_hold_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    crooked = {"name": "crooked", "acts_on": "measured", "term": "y + c*y**3", "parameters": {"c": {"range": [0, 1]}}}
    model, _, corrected, left_out = written(
        "pendulum", ("input_backlash", crooked, "input_lag", "actuator_rate_limit", "sensor_saturation"), monkeypatch
    )
    new = build(corrected, "sim").model()
    assert new.lag == {"u": "tau"}
    assert model.lag == {}
    assert "sensors" not in corrected
    assert [text.split(" (")[0] for text in left_out] == [
        "sensor_saturation on phi",
        "actuator_rate_limit on u",
        "crooked on phi",
        "input_backlash on u",
    ]
    assert all(len(text.split(" (")[1]) > 30 for text in left_out)


def test_an_input_that_is_late_already_gets_no_second_delay() -> None:
    """The corrected simulator could hold one only, and the search would have fitted the sum."""
    prompt, late = (build(node_of("sim", sim), "sim").model() for sim in ("racecar", "rc_car_high_fidelity"))
    effects = [build(node_of("effect", name), "effect") for name in ("input_delay", "input_lag")]
    rows = np.linspace(0.1, 0.9, 40)
    states, inputs = np.tile(rows[:, None], 6), np.tile(rows[:, None], 2)
    nothing = np.zeros((40, 0))
    episode = Episode("0", rows, states, inputs, nothing, None)
    recording = Recording((episode,), (), (), {}, (), (), ())

    def places(model: Any) -> set[tuple[str, str]]:
        return {(t.effect, t.acts_on) for t in terms_of(model, recording, effects) if t.kind in ("delay", "lag")}

    lags = {("input_lag", "steer"), ("input_lag", "throttle")}
    assert places(prompt) == lags | {("input_delay", "steer"), ("input_delay", "throttle")}
    assert places(late) == lags


def test_a_prior_of_what_cannot_be_negative_has_no_negative_tail() -> None:
    """The mean and the standard deviation are those of the estimate, whichever law has them."""
    for low, high in ((5.1, 31.8), (0.0, 3.0), (0.0, 2.84), (4e-4, 3.3e-3)):
        law = module.law_of(low, high, signed=False, log=False)
        assert law["prior"] == "lognormal"
        ends = np.log(law["range"])
        mean = np.exp(ends.mean() + (s2 := (np.diff(ends)[0] / 4) ** 2) / 2)
        assert mean == pytest.approx((low + high) / 2)
        assert mean * np.sqrt(np.expm1(s2)) == pytest.approx((high - low) / 4)
    normal = {"prior": "normal"}
    assert module.law_of(9.0, 11.0, signed=False, log=False) == normal | {"range": [9.0, 11.0]}
    assert module.law_of(-1.0, 3.0, signed=True, log=False) == normal | {"range": [-1.0, 3.0]}
    # what was estimated in its logarithm is normal there
    assert module.law_of(0.1, 9.0, signed=False, log=True) == {"range": [0.1, 9.0], "prior": "lognormal"}


def test_a_comparison_as_priors_that_fails_takes_nothing_from_what_was_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fails(*_: Any) -> None:
        raise NumericsError("step 502: `loss` is not finite")

    monkeypatch.setattr(discovery_run, "close", fails)
    declared = Declared({}, {})
    terminal = Terminal(True, tmp_path / "run.log")
    found = discovery_run._compared(declared, declared, tmp_path, tmp_path, terminal)
    assert found == {"not_closed": "step 502: `loss` is not finite"}
    assert "no fit with the corrected simulator: step 502" in (tmp_path / "run.log").read_text()
