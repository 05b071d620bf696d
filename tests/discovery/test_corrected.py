"""The corrected YAML against the model that the search fitted: the same rates at random points."""

from typing import Any

import numpy as np
import pytest
import yaml

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.likelihood.augmented import augment
from simpel_cli.discovery.likelihood.fit import Optimum
from simpel_cli.discovery.search.setup import terms_of
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.verdict import corrected as module
from simulators.effects import Scales, Term

CASES = {
    "rc_car": ("rolling_resistance", "traction_limit", "tyre_slip", "input_saturation"),
    "racecar": ("rolling_resistance", "traction_limit", "input_saturation", "input_delay"),
    "pendulum": ("coulomb_friction", "added_inertia", "input_offset", "input_dead_zone"),
}


def node_of(group: str, name: str) -> dict[str, Any]:
    return yaml.safe_load((conf_dir() / group / f"{name}.yaml").read_text())


def written(sim: str, effects: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> tuple[Any, ...]:
    """Return the corrected model with the terms at their starts, its terms, and what was left out."""
    node = node_of("sim", sim)
    model = build(node, "sim").model()
    scales = Scales(
        {q.name: 1.0 for q in (*model.states, *model.inputs)}, {q.name: 2.0 for q in model.states}, model.dt
    )
    names = [q.name for q in model.states]
    terms: list[Term] = [
        build(node_of("effect", e), "effect").attach(model, scales, tuple(names[:1]))[0] for e in effects
    ]
    parameters = [k for t in terms for k in t.parameters]
    rows = [[parameters.index(k) for k in t.parameters] for t in terms]
    point = {i: dict.fromkeys(("value", "low", "high"), k.starts[0]) for i, k in enumerate(parameters)}
    monkeypatch.setattr(module, "interval_of", lambda search, trial, row, z: point[row])
    # the order in which terms were accepted is not that in which they were attached
    search = Search.__new__(Search)
    search.terms, search.rows = tuple(terms), [tuple(r) for r in rows]
    nothing = Optimum(np.zeros(1), (), 0.0, 0.0, np.zeros(0), np.eye(1), np.zeros(0), np.eye(1), 0, True)
    trial = Trial(tuple(reversed(range(len(terms)))), nothing)
    _, corrected, left_out = module.corrected(node, model, search, trial)
    return model, terms, build(corrected, "sim").model(), left_out


@pytest.mark.parametrize("sim", CASES)
def test_the_yaml_has_the_rates_that_were_fitted(sim: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, terms, new, left_out = written(sim, CASES[sim], monkeypatch)
    together = augment(model, terms, [q.name for q in model.states])
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
        np.testing.assert_allclose(np.asarray(new.function()(x, u, p)[0]).ravel(), fitted, rtol=1e-9, atol=1e-9)
        changed = max(changed, float(np.abs(fitted - old).max()))
    assert changed > 0.1


def test_what_a_transition_cannot_hold_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, new, left_out = written("pendulum", ("input_backlash", "sensor_lag", "input_lag"), monkeypatch)
    assert new.lag == {"u": "tau"}
    assert model.lag == {}
    assert [text.split(" (")[0] for text in left_out] == ["sensor_lag on phi", "input_backlash on u"]
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
