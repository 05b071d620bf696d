"""Hidden states: what a chosen model leaves has a memory of a state that the simulator lacks."""

import json
from functools import partial
from inspect import unwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from command_line import TINY, simpel
from scipy.integrate import solve_ivp

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search import again as again_module
from simpel_cli.discovery.search.again import Again, Earlier, asked_again, beside
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.memories import Memory, _Course, remembered, worth_a_search
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.augmented import augment
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.measurements.windows import windows_of
from simpel_cli.filtering.setup import setup
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression, Scales
from simulators.effects.stores import with_stores
from simulators.model import Declared, Model, ModelError

DT, AMBIENT = 2.0, 22.0
HEATER = """name: heater
dt: 2.0
states: {T: {unit: degC, range: [10, 80], role: temperature}}
inputs: {u: {unit: "1", range: [0, 1]}}
parameters: {a: {unit: 1/s, range: [0.005, 0.06]}, b: {unit: K/s, range: [0.3, 1.5]}}
dynamics: {T: a*(22 - T) + b*u}
"""
DATA = "path: {path}\ntime: t\nepisode: episode\nsplit: {{column: split}}\n"
WALL = {"k": 0.03, "tau": 60.0}


def heaters(k: float, tau: float, seed: int = 3, drift: float = 0.0) -> pd.DataFrame:
    """Rows of a heater that exchanges heat with a wall, and of which a share of the power drifts over every episode."""
    random, parts = np.random.default_rng(seed), []
    for episode in range(6):
        u = np.repeat(random.uniform(0, 1, 5), 16)
        x = np.full(2, random.uniform(20, 30))
        rows = []
        for i, each in enumerate(u):
            rows.append(x[0])
            held = each * (1 + drift * (i / len(u) - 0.5))

            def rate(_: float, x: Any, held: float = held) -> list[float]:
                return [0.02 * (AMBIENT - x[0]) + 0.8 * held + k * (x[1] - x[0]), (x[0] - x[1]) / tau]

            x = solve_ivp(rate, (0, DT), x, rtol=1e-8).y[:, -1]
        measured = np.array(rows) + 0.05 * random.normal(size=len(u))
        split = "train" if episode < 4 else "test"
        parts.append(
            pd.DataFrame({"episode": episode, "t": DT * np.arange(len(u)), "T": measured, "u": u, "split": split})
        )
    return pd.concat(parts)


def given(folder: Path, k: float) -> None:
    for group in ("sim", "data"):
        (folder / "my" / group).mkdir(parents=True)
    (folder / "my/sim/heater.yaml").write_text(HEATER)
    (folder / "my/data/heater.yaml").write_text(DATA.format(path=folder / "run.parquet"))
    heaters(k, WALL["tau"]).to_parquet(folder / "run.parquet")


EFFECTS = "effect=[ambient_exchange,radiation,input_lag,sensor_lag,hidden_exchange,after_effect,polarisation]"


def searched(folder: Path) -> dict[str, Any]:
    found = simpel(
        folder, "discover", "--config-dir", "my", "sim=heater", "data=heater", EFFECTS, "report=false",
        "discovery.pairs=false", "hydra.run.dir=run",
    )  # fmt: skip
    assert found.code == 0, found.err
    verdict: dict[str, Any] = json.loads((folder / "run" / "verdict.json").read_text())
    return verdict


def test_a_wall_is_found_written_and_fitted(tmp_path: Path) -> None:
    given(tmp_path, WALL["k"])
    verdict = searched(tmp_path)
    (effect,) = verdict["effects"]
    assert effect["name"] == "hidden_exchange"
    found = effect["parameters"]
    for name, value in WALL.items():
        assert found[name]["value"] == pytest.approx(value, rel=0.1)
    file = tmp_path / "run" / verdict["corrected_sim"]
    node = yaml.safe_load(file.read_text())
    (hidden,) = (name for name in node["states"] if name != "T")
    assert node["states"][hidden]["role"] == "hidden"
    assert "state that nobody measures" in verdict["not_closed"]
    fitted = simpel(
        tmp_path, "fit", "--config-dir", "run/conf", f"sim={file.stem}", "data=heater", "hydra.run.dir=fit", *TINY
    )
    assert fitted.code == 0, fitted.err


def test_without_a_wall_there_is_none(tmp_path: Path) -> None:
    given(tmp_path, 0.0)
    assert searched(tmp_path)["verdict"] == "none"


def wall(**more: Any) -> Expression:
    state = {"z": {"rate": "(x - z)/tau", "unit": "X", "range": ["-X", "X"], "begins": "x"}}
    parameters = {
        "k": {"range": [0, "A/X"], "unit": "A/X"}, "tau": {"range": [6, 600], "neutral": 60, "prior": "loguniform"},
    }  # fmt: skip
    return Expression(
        "wall", **({"acts_on": "T", "term": "k*(z - x)", "states": state, "parameters": parameters} | more)
    )


def heater() -> Model:
    return Declared(**yaml.safe_load(HEATER)).model()


def test_a_state_of_an_effect_does_what_its_equation_says() -> None:
    model = heater()
    (term,) = wall().attach(model, Scales({"T": 50.0, "u": 1.0}, {"T": 0.5}, DT), ("T",))
    augmented = augment(model, [term], ("T",))
    assert [q.name for q in augmented.model.states] == ["T", "wall_T_z"]
    assert augmented.driven == (0,)  # no noise acts on it
    p = augmented.neutral.copy()
    p[augmented.rows(term)] = [0.03, 60.0]
    rates, shown = (np.asarray(a).ravel() for a in augmented.function([30.0, 24.0], [0.5], p))
    a, b = p[:2]
    np.testing.assert_allclose(rates, [a * (22 - 30) + b * 0.5 + 0.03 * (24 - 30), (30 - 24) / 60])
    assert shown == [30.0]
    assert with_stores(augmented.model, term.stores) is augmented.model


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"states": {"z": {"rate": "x"}}}, r"effect.wall.states.z: .* write \{rate"),
        (
            {"states": {"z": {"rate": "x", "range": [0, 1], "start": 0}}},
            r"states.z.start: no such key; allowed are rate",
        ),
        ({"states": {n: {"rate": "x", "range": [0, 1]} for n in "zw"}}, r"wall.states: 2 states and 1 parameters"),
        (
            {"parameters": {"k": {"range": [0, 1]}, "tau": {"range": [1, 2]}}},
            r"1 states and 2 parameters .* \(k, tau\)",
        ),
        ({"term": "", "operator": "lag", "parameters": {"k": {"range": [0, 1]}}}, r"effect.wall.states: go with one"),
    ],
)
def test_states_that_are_declared_wrongly_are_named(more: dict[str, Any], said: str) -> None:
    with pytest.raises(ModelError, match=said):
        wall(**more)


def test_nothing_is_promised_where_no_effect_has_a_state() -> None:
    nothing: Any = None
    assert unwrap(worth_a_search)(nothing, nothing, []) is None
    assert Memory((), 12.4).words.endswith("promises +12: searching once more with it")


def test_a_state_is_followed_without_inputs() -> None:
    node = yaml.safe_load(HEATER) | {"inputs": {}, "dynamics": {"T": "a*(22 - T) + b"}}
    (term,) = wall().attach(Declared(**node).model(), Scales({"T": 50.0}, {"T": 0.5}, DT), ("T",))
    augmented = augment(Declared(**node).model(), [term], ("T",))
    p = augmented.neutral.copy()
    place = augmented.rows(term)
    p[place] = [1.0, 60.0]
    course = _Course(augmented, term, p[None], place[0])
    known = np.full((3, 40, 1), 30.0)
    state = course.states(known, np.zeros((3, 40, 0)), np.full(3, 24.0), DT)
    np.testing.assert_allclose(state[:, :, 0], 30 - 6 * np.exp(-DT * np.arange(40) / 60)[None].repeat(3, 0), rtol=1e-6)
    np.testing.assert_allclose(course.at(course.slope, known, np.zeros((3, 40, 0)), state), state - 30.0)


def test_columns_of_what_was_measured_are_found_beside_a_state_that_has_none() -> None:
    """A sensor at its end, and values that count less, of an output: the model has a state more than the episode."""
    end = np.array([[0, 0], [0, 0], [0, 1], [0, 0]])
    weight = np.array([[1.0, 0.5]] * 4)
    episode = Episode(
        "e", np.arange(4.0), np.ones((4, 1)), np.zeros((4, 0)), 2 * np.ones((4, 1)), beyond=end, weight=weight
    )
    found = windows_of([episode], ["x", "z"], ("x", "y"), ("y",), np.zeros(2), np.ones(2), lead=0, dt=1.0)
    np.testing.assert_array_equal(found.ok[0], [[1, 0.5], [1, 0.5], [1, 0], [1, 0.5]])


def recorded(rows: pd.DataFrame) -> Recording:
    episodes = [
        Episode(str(e), part["t"].to_numpy(), part[["T"]].to_numpy(), part[["u"]].to_numpy(), np.zeros((len(part), 0)))
        for e, part in rows.groupby("episode")
    ]
    return Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), {"T": 0.05}, (), (Check("c", True, ""),), ())


@pytest.mark.parametrize(
    ("k", "tau", "drift"),
    [(0.03, 60.0, 0.0), (0.03, 300.0, 0.0), (0.03, 900.0, 0.0), (0.0, 60.0, 0.3), (0.0, 60.0, 0.4)],
)
def test_a_state_is_asked_only_where_it_promises_more_than_a_drift(k: float, tau: float, drift: float) -> None:
    """A slow state fits a slow change, too; a wall that is as slow as an episode is long is asked all the same."""
    model = heater()
    plan = setup(model, recorded(heaters(k, tau, drift=drift)), (), [], 1, kept=frozenset())
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=6))
    levels = NoiseProfile(search, Assessor(plan, 10), search.base())
    state = {"z": {"rate": "(given - z)/tau", "unit": "U", "range": ["-U", "U"], "begins": "given"}}
    parameters = {
        "k": {"range": ["-3*A/U", "3*A/U"], "unit": "A/U", "starts": ["0.1*A/U"]},
        "tau": {"range": [6, 6000], "neutral": 60, "prior": "loguniform", "starts": [12, 60, 300, 1200]},
    }  # fmt: skip
    after_effect = wall(term="k*z", states=state, parameters=parameters)
    effects = [wall(), after_effect]
    terms = [t for e in effects for t in e.attach(model, plan.scales, ("T",))]
    promised = remembered(levels, terms)
    assert promised is not None
    found = worth_a_search(levels, levels, terms)
    assert found == ((promised, True) if k else None)


@pytest.mark.parametrize("k", [WALL["k"], 0.0], ids=["wall", "none"])
def test_a_state_of_its_own_is_asked_beside_what_was_chosen_before_a_search_begins_again(k: float) -> None:
    """What promises much to first order may earn nothing."""
    model = heater()
    attach = partial(setup, model, recorded(heaters(k, WALL["tau"])), (), [], 1)
    plan = attach(kept=frozenset())
    # what the search knows of its windows: values that count less, and where they begin
    ok, start = 0.9 * plan.windows.ok, plan.windows.start + 0.01
    plan = plan._replace(windows=plan.windows._replace(ok=ok, start=start))
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=6))
    earlier = Earlier(search, search.base(), heavy=True)
    (term,) = wall().attach(model, plan.scales, ("T",))
    found = beside(earlier, attach, [term], 2)
    if not k:
        assert found is None
        return
    assert found is not None
    assert found.heavy
    assert [found.search.terms[t].effect for t in found.chosen.terms] == ["wall"]
    # beside the same measurements, each as far as it counts
    assert np.array_equal(found.search.plan.windows.ok, ok)
    assert found.search.plan.windows.start.shape[1] == 2
    assert np.array_equal(found.search.plan.windows.start[:, 0], start[:, 0])


def test_a_search_is_made_again_only_for_a_state_that_earns_its_place_and_has_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    memory, options, terminal = Memory((), 39.0), Discovery(room=3), Terminal(False, tmp_path / "run.log")
    none: Any = None
    attach = lambda **_: none  # noqa: E731
    small: Any = SimpleNamespace(free=lambda terms: range(4 + 2 * len(terms)), plan=None)
    chosen = lambda count: Trial(tuple(range(count)), none)  # noqa: E731
    asked = unwrap(asked_again)
    monkeypatch.setattr(again_module, "members", lambda _: 1)

    def outcome(before: int, found: Earlier | None) -> Any:
        monkeypatch.setattr(again_module, "beside", lambda *_: found)
        return asked(Earlier(none, chosen(before)), memory, True, attach, options, terminal)

    assert outcome(1, None) is None
    assert "earns less than it has to" in (tmp_path / "run.log").read_text()
    found = Earlier(small, chosen(2), heavy=True)
    assert outcome(1, found) == Again(memory, found)
    assert outcome(0, found) == Again(memory, None)  # beside nothing it is one beginning of many
    assert outcome(2, Earlier(small, chosen(3))) is None
    assert "discovery.room=6" in (tmp_path / "run.log").read_text()
    # in place of what was chosen there is nothing to ask it beside
    assert asked(Earlier(none, chosen(1)), memory, False, attach, options, terminal) == Again(memory, None)
