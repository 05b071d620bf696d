"""Whether parameters of the simulator differ from group to group, asked by a search itself, on planted groups."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from command_line import simpel
from test_effects_by_group import CART, DATA

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.search.by_group import strangers
from simpel_cli.discovery.search.by_group.own_parameters import _can_differ, said_of_groups, with_own, written
from simpel_cli.discovery.search.by_group.strangers import assessed
from simpel_cli.discovery.search.smaller import small_search
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.errors import ConfigError
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Hypothesis, Optimum
from simpel_cli.filtering.setup import setup
from simpel_cli.studies.open import _grouped
from simulators.groups import grouped
from simulators.model import Declared


def discovered(folder: Path, rig: str, rate: str, *words: str) -> dict[str, Any]:
    """Carts whose simulator is v' = b u; the verdict of a search that nobody told of the rigs but the data."""
    for group in ("sim", "data"):
        (folder / "my" / group).mkdir(parents=True)
    more = ", f: {unit: m/s^2, range: [-2, 2]}"
    (folder / "my/sim/plant.yaml").write_text(CART.format(name="plant", more=more, rate=rate))
    (folder / "my/sim/cart.yaml").write_text(CART.format(name="cart", more="", rate="b*u"))
    text = DATA.format(path=folder / "made/measurements.parquet")
    (folder / "my/data/cart.yaml").write_text(f"{text}groups: [rig]\n")
    made = simpel(
        folder, "simulate", "--config-dir", "my", "sim=plant", "simulation.episodes=16", "simulation.steps=40",
        "simulation.seed=1", "simulation.noise_std={s: 0.005, v: 0.01}", "simulation.truth={b: 1.3, f: 0}",
        "simulation.initial={s: [-0.2, 0.2], v: [-1, 1]}", f"simulation.groups={{rig: {rig}}}", "out=made",
    )  # fmt: skip
    assert made.code == 0, made.err
    found = simpel(
        folder, "discover", "--config-dir", "my", "sim=cart", "data=cart", "close=false", "report=false",
        "discovery.pairs=false", "hydra.run.dir=run", *words,
    )  # fmt: skip
    assert found.code == 0, found.err
    (folder / "screen").write_text(found.out)
    verdict: dict[str, Any] = json.loads((folder / "run" / "verdict.json").read_text())
    return verdict


def test_gains_of_rigs_differ_and_nothing_is_missing(tmp_path: Path) -> None:
    """One gain for all rigs would leave a force that goes with the input."""
    gains = "{count: 6, parameters: {b: {law: normal, std: 0.26}}}"
    verdict = discovered(tmp_path, gains, "b*u", "effect=[input_dead_zone,quadratic_input]")
    assert (verdict["verdict"], verdict["effects"]) == ("none", [])
    (one,) = (g for g in verdict["grouping"] if g["pays"])
    assert (one["parameter"], one["per"], one["gate"]["passed"]) == ("b", "rig", True)
    assert f"Grouping b by rig pays (+{one['gain']:.0f} nats). b differs from rig to rig" in verdict["summary"]
    assert "explains these data where parameters differ. The test error 20 rows ahead in" in verdict["summary"]
    assert verdict["process_noise"]["after"] < 0.1 * verdict["process_noise"]["before"]
    assert {*pq.read_table(tmp_path / "run/residuals.parquet")["model"].to_pylist()} == {"before", "without", "after"}
    truth = yaml.safe_load((tmp_path / "made/card.yaml").read_text())["truth_by_group"]["rig"]
    (group,) = verdict["groups"]
    assert group["key"] == "sim.parameters.b.per"
    for name, own in group["values"].items():
        assert own["value"] == pytest.approx(truth[name]["b"], rel=0.02)
    before, after = (verdict["error"][when]["horizon"]["v"] for when in ("before", "after"))
    assert after < 0.012 < 0.05 < before
    assert [step["added"] for step in verdict["steps"]] == [[], ["b by rig"]]
    assert verdict["corrected_sim"] == "conf/sim/cart_by_rig.yaml"
    node = yaml.safe_load((tmp_path / "run" / verdict["corrected_sim"]).read_text())
    assert node["parameters"]["b"]["per"] == "rig"
    assert "sim=cart_by_rig" in (tmp_path / "screen").read_text()


def test_a_force_of_every_rig_that_is_none_on_average(tmp_path: Path) -> None:
    """With one value for all rigs it explains nothing; the gain does not stand in for it."""
    forces = "{count: 6, parameters: {f: {law: normal, std: 0.5}}}"
    verdict = discovered(tmp_path, forces, "b*u + f", "effect=[constant_load,cubic_stiffness]")
    assert [e["name"] for e in verdict["effects"]] == ["constant_load"]
    (load,) = (g for g in verdict["grouping"] if g["effect"] == "constant_load")
    assert (load["pays"], load["accepted"]) == (True, False)
    assert not any(g["pays"] for g in verdict["grouping"] if g["parameter"])
    truth = yaml.safe_load((tmp_path / "made/card.yaml").read_text())["truth_by_group"]["rig"]
    (group,) = verdict["groups"]
    for name, own in group["values"].items():
        assert own["value"] == pytest.approx(truth[name]["f"], abs=0.02)


def test_groups_of_two_columns_and_what_was_never_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every group has the windows of its own column, in whatever order parameters came to differ; no data tell of `another`."""
    model = Declared(
        "m", dt=0.1, states={"x": {"unit": "m", "range": [-3, 3]}}, inputs={"u": {"range": [-2, 2], "between_rows": "held"}},
        parameters={"a": {"range": [0.2, 2]}, "b": {"range": [-1, 2]}}, dynamics={"x": "b*u - a*x"},
    ).model()  # fmt: skip
    bare = grouped(model, {"rig": ("one", "two"), "day": ("mon", "tue", "wed")})
    source = with_own(bare, {"b": "rig", "a": "day"})
    random, episodes = np.random.default_rng(0), []
    for k in range(6):
        rig, day = np.eye(3)[k % 2], np.eye(4)[k % 3]
        u = random.uniform(-2, 2, (25, 1))
        x = [0.5]
        for v in u[:-1, 0]:
            x.append(0.9 * x[-1] + 0.1 * v)
        states = np.array(x)[:, None] + 0.01 * random.standard_normal((25, 1))
        inputs = np.hstack([u, np.tile(np.concatenate([rig, day]), (25, 1))])
        episodes.append(Episode(f"e{k}", 0.1 * np.arange(25), states, inputs, np.empty((25, 0))))
    recording = Recording(tuple(episodes), (), (), {"x": 0.01}, (), (), (), groups=dict(source.groups))
    search = small_search(setup(source, recording, (), []), 2, 1)
    names = [q.name for q in source.params]
    slots = {names[row]: source.inputs[j].name for row, j in search.slot_of.items()}
    assert slots == {
        "a_of_mon": "day_is_mon", "a_of_tue": "day_is_tue", "a_of_wed": "day_is_wed",
        "b_of_one": "rig_is_one", "b_of_two": "rig_is_two",
    }  # fmt: skip
    fitter, begun = search.fitter, list[Hypothesis]()

    def noted(hypotheses: Sequence[Hypothesis], hopes: Any = None) -> list[Optimum]:
        begun.extend(hypotheses)
        return fitter(hypotheses, hopes=hopes)

    search.fitter = noted  # type: ignore[assignment]
    search.base()
    another = [names.index(f"{q}_of_another") for q in "ab"]
    assert len(begun) > 4
    assert all(list(h.z[another]) == [0.5, 0.5] for h in begun)  # the middle of the population
    # of a rig that was never seen, on days that were, what is known of the days stays
    windows, gone = search.plan.windows, list[list[str]]()
    u = windows.u.copy()
    new = windows.episode == 0
    rigs = [j for j, q in enumerate(source.inputs) if q.name.startswith("rig_is_")]
    u[np.ix_(np.flatnonzero(new), range(u.shape[1]), rigs)] = [0.0, 0.0, 1.0]
    free = tuple(i for i, name in enumerate(names) if i not in another and not name.endswith("_spread"))
    z = np.where(
        [name.endswith("_spread") for name in names] + [False] * (len(search.plan.start) - len(names)), 0.3, 0.6
    )
    trial = Trial((), Optimum(z, free, 0.0, 0.0, np.zeros(0), np.eye(0), np.zeros(0), np.eye(0), 1, True))

    def common(search: Search, trial: Trial, spreads: Sequence[int]) -> Trial:
        gone.append([names[row] for row in spreads])
        return trial._replace(optimum=trial.optimum._replace(z=np.full_like(z, 0.4)))

    monkeypatch.setattr(strangers, "in_common", common)
    assessor = Assessor(search.plan, 5)
    known, found = assessor(z, windows._replace(u=u)), assessed(search, assessor, trial, windows._replace(u=u))
    assert gone == [["b_spread"]]
    np.testing.assert_array_equal(found.one_step[~new], known.one_step[~new])
    assert np.nanmax(np.abs(found.one_step[new] - known.one_step[new])) > 0


def test_parameters_that_cannot_differ_are_not_asked_about() -> None:
    """One that a delay depends on, one that does so already, and one whose spread has a name that is taken."""
    ranges = {name: {"range": [0.1, 1], "unit": "1"} for name in ("a", "late", "c", "c_spread", "d")}
    ranges["d"] = ranges["d"] | {"per": "rig"}
    model = Declared(
        "m", dt=0.1, states={"x": {"unit": "m", "range": [0, 1]}}, inputs={"u": {"range": [0, 1], "delay": "late"}},
        parameters=ranges, dynamics={"x": "-a*x*c*d*c_spread + u"},
    ).model()  # fmt: skip
    source = grouped(model, {"rig": ("one", "two")})
    assert [q.name for q in model.params if _can_differ(source, q.name)] == ["a", "c_spread"]
    with pytest.raises(ConfigError, match="sim: the name c_spread is needed for groups, but it is taken"):
        _grouped(replace(model, per={"c": "rig"}), {"rig": ("one", "two")})
    found = with_own(source, {"a": "rig"})
    assert found.per == {"a": "rig", "d": "rig"}
    assert found.inputs == source.inputs  # the same rows


def test_where_it_is_declared() -> None:
    own = {"name": "s", "parameters": {"b": {"range": [0, 1]}, "m": 2.0}}
    assert written(own, {"b": {"per": "rig"}})["parameters"] == {"b": {"range": [0, 1], "per": "rig"}, "m": 2.0}
    assert own["parameters"]["b"] == {"range": [0, 1]}  # type: ignore[index]
    on = {"name": "t", "base": own, "parameters": {"c": {"range": [0, 1]}}}
    found = written(on, {"b": {"per": "rig"}, "c": {"per": "day"}})
    assert found["base"]["parameters"]["b"]["per"] == "rig"
    assert found["parameters"] == {"c": {"range": [0, 1], "per": "day"}}
    assert written(own, {}) == own


def test_a_rig_that_was_never_seen_is_predicted_as_one_of_many(tmp_path: Path) -> None:
    """Every rig has one episode: to the test episodes no value of their own is known, and no error grows there."""
    gains = "{count: 16, parameters: {b: {law: normal, std: 0.26}}}"
    verdict = discovered(tmp_path, gains, "b*u", "effect=[input_dead_zone]")
    (one,) = (g for g in verdict["grouping"] if g["pays"])
    assert (one["parameter"], one["per"]) == ("b", "rig")
    assert "grows" not in verdict["summary"]
    for horizon, errors in verdict["error"]["before"].items():
        if horizon != "log_likelihood_per_step":
            assert all(verdict["error"]["after"][horizon][name] < 1.05 * e for name, e in errors.items())


def test_groups_may_differ_by_more_than_what_is_known_of_all() -> None:
    """A motor's constant that a data sheet gives to 2 % differs from motor to motor by a tenth."""
    parameters: dict[str, Any] = {
        "k": {"unit": "1", "range": [3.92, 4.08]}, "m": {"unit": "1", "range": [40, 160]},
        "f": {"unit": "1", "range": [-0.1, 0.1]}, "d": {"unit": "1", "range": [1, 1.1], "per": "rig", "spread": [0, 0.02]},
    }  # fmt: skip
    model = Declared(
        "cart", dt=0.1, states={"v": {"unit": "1", "range": [-1, 1]}}, inputs={"u": {"unit": "1", "range": [-1, 1]}},
        parameters=parameters, dynamics={"v": "k*u - m*v + f - d"},
    ).model()  # fmt: skip
    model = grouped(model, {"rig": ("a", "b")})
    differing = with_own(model, dict.fromkeys("kmf", "rig"))
    widest = {q.name: q.high for q in differing.params if q.name.endswith("_spread")}
    assert widest == pytest.approx({"k_spread": 0.35, "m_spread": np.log(4) / 2, "f_spread": 0.1, "d_spread": 0.02})
    groups = [
        {"parameter": name, "effect": None, "spread": {"high": high}} for name, high in (("k", 0.1234), ("m", 0.5))
    ]
    said = said_of_groups(model, dict.fromkeys("km", "rig"), groups)
    assert said == {"k": {"per": "rig", "spread": [0.0, 0.123]}, "m": {"per": "rig"}}
