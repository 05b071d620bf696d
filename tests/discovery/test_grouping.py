"""Whether grouping pays, asked by a search itself of the columns that `data.groups` names, on planted groups."""

import json
from inspect import unwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import yaml
from command_line import simpel
from test_effects_by_group import CART, DATA

from simpel_cli.data import Measurements
from simpel_cli.discovery import searched as whole
from simpel_cli.discovery.ground import Ground
from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.by_group import grouping as grouping_module
from simpel_cli.discovery.search.by_group.grouping import Grouping, confirmed, grouped_effects, sentence_of
from simpel_cli.discovery.search.gate.held_out import Gate
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.memories import Memory
from simpel_cli.discovery.searched import Again, Searched
from simpel_cli.discovery.watch import Watch
from simpel_cli.errors import ConfigError
from simpel_cli.studies.declared import Declared
from simulators.effects import Expression
from simulators.model import Declared as Simulator


def discovered(folder: Path, ball: str, *words: str, groups: str = "[ball]", hidden: str = "") -> dict[str, Any]:
    """Balls whose drag the simulator lacks; the verdict of a search that nobody told of the groups but the data."""
    for group in ("sim", "data"):
        (folder / "my" / group).mkdir(parents=True)
    plant = CART.format(name="plant", more=", c: {unit: 1/m, range: [0.05, 2]}", rate="b*u - c*v*abs(v)")
    (folder / "my/sim/plant.yaml").write_text(plant)
    (folder / "my/sim/cart.yaml").write_text(CART.format(name="cart", more="", rate="b*u"))
    text = DATA.format(path=folder / "made/measurements.parquet")
    (folder / "my/data/cart.yaml").write_text(f"{text}groups: {groups}\n")
    made = simpel(
        folder, "simulate", "--config-dir", "my", "sim=plant", "simulation.episodes=16", "simulation.steps=60",
        "simulation.seed=1", "simulation.noise_std={s: 0.005, v: 0.01}", "simulation.truth={b: 1.3, c: 0.4}",
        "simulation.initial={s: [-0.2, 0.2], v: [-1, 1]}", f"simulation.groups={{ball: {ball}}}", "out=made",
    )  # fmt: skip
    assert made.code == 0, made.err
    found = simpel(
        folder, "discover", "--config-dir", "my", "sim=cart", "data=cart", f"effect=[quadratic_drag,input_backlash{hidden}]",
        "close=false", "report=false", "discovery.pairs=false", "hydra.run.dir=run", *words,
    )  # fmt: skip
    assert found.code == 0, found.err
    verdict: dict[str, Any] = json.loads((folder / "run" / "verdict.json").read_text())
    assert [e["name"] for e in verdict["effects"]] == ["quadratic_drag"]
    return verdict


def asked(verdict: dict[str, Any], effect: str = "", parameter: str = "") -> dict[str, Any]:
    """Return what was said of one effect or parameter."""
    (one,) = (g for g in verdict["grouping"] if (g["effect"], g["parameter"]) == (effect, parameter))
    return cast(dict[str, Any], one)


def test_that_balls_have_drags_of_their_own_is_found_without_being_asked(tmp_path: Path) -> None:
    # a state that nobody measures would explain as much, one drag for all balls beside it
    verdict = discovered(
        tmp_path, "{count: 6, parameters: {c: {law: lognormal, std: 0.5}}}", hidden=",hidden_exchange,hysteresis"
    )
    one = asked(verdict, "quadratic_drag")
    assert (one["per"], one["pays"], one["gate"]["passed"], one["accepted"]) == ("ball", True, True, True)
    assert one["gain"] > 50
    assert not asked(verdict, parameter="b")["pays"]  # beside a drag per ball
    assert f"Grouping quadratic drag by ball pays (+{one['gain']:.0f} nats)." in verdict["summary"]
    (group,) = verdict["groups"]
    assert group["log_evidence_gain"] == pytest.approx(one["gain"], rel=0.1)
    truth = yaml.safe_load((tmp_path / "made/card.yaml").read_text())["truth_by_group"]["ball"]
    for name, own in group["values"].items():
        assert own["value"] == pytest.approx(truth[name]["c"], rel=0.1)
    assert verdict["remainder"] is None  # one drag for all balls leaves something that depends on v
    assert verdict["error"]["after"]["horizon"]["v"] < 0.012  # 0.162 with one
    (file,) = (tmp_path / "run/conf/sim").glob("*.yaml")
    assert yaml.safe_load(file.read_text())["parameters"]["c"]["per"] == "ball"


@pytest.mark.parametrize("pays", [True, False])
def test_a_state_that_nobody_measures_is_asked_when_groups_are_known(
    pays: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where drags of their own explain it, no search is made with such a state; else one with the effects as they were."""
    nothing: Any = None
    drag = Expression("drag", acts_on="v", term="-k*v", parameters={"k": {"range": [0, 1], "unit": "1/s"}})
    memory = Again(Memory((), 20.0), None)
    one = Grouping("drag", "ball", 50.0, None, pays=True, accepted=True)
    (term,) = (SimpleNamespace(groupings=("ball",)),)
    search: Any = SimpleNamespace(terms=[term])
    selection: Any = SimpleNamespace(chosen=SimpleNamespace(terms=(0,)))
    first = Searched(
        search, nothing, selection, [], None, nothing, nothing, {}, {}, [one] if pays else [], again=memory
    )
    answers = iter([first, first._replace(groupings=[], again=None)])
    monkeypatch.setattr(whole, "_search", lambda *_: next(answers))
    monkeypatch.setattr(whole, "confirmed", lambda groupings, *_: groupings)
    monkeypatch.setattr(whole, "chosen_of", lambda *_: None)
    terminal: Any = SimpleNamespace(line=lambda *_: None)
    ground = Ground(nothing, nothing, nothing, (), terminal, Budget(), Watch(Budget()))
    found = whole._search_in_groups(ground, [drag])
    if pays:
        assert isinstance(found, Searched)
        assert found.again is None
    else:
        assert isinstance(found, Again)
        assert found.effects == [drag]


def test_that_balls_are_alike_is_said(tmp_path: Path) -> None:
    verdict = discovered(tmp_path, "{count: 6}")
    assert not asked(verdict, parameter="b")["pays"]
    one = asked(verdict, "quadratic_drag")
    assert (one["pays"], one["gate"], verdict["groups"]) == (False, None, [])
    assert -20 < one["gain"] < 0
    assert f"Grouping quadratic drag by ball does not pay ({one['gain']:+.0f} nats)." in verdict["summary"]
    (file,) = (tmp_path / "run/conf/sim").glob("*.yaml")
    assert "per" not in yaml.safe_load(file.read_text())["parameters"]["c"]


def test_only_a_search_asks() -> None:
    """Groups that only a search asks about are no inputs of what is fitted."""
    sim = Simulator("s", dt=1, states={"x": {"unit": "m", "range": [0, 1]}}, dynamics={"x": "-x"}).model()
    groups = {"sim": sim, "data": Measurements("a.csv", groups=("ball",))}
    drag = Expression("drag", acts_on="x", term="-c*x", parameters={"c": {"range": [0, 1]}})
    for effects, columns in (([], {}), ([drag], {"ball": "data.groups"})):
        source = Declared({}, groups | {"effect": effects}).source
        assert source.columns_of_groups == columns
    with pytest.raises(ConfigError, match=r"data\.groups: \('a ball',\) is not allowed, only a list of names"):
        Measurements("a.csv", groups=("a ball",))


def test_words_say_why_it_does_not_pay() -> None:
    gate = Gate(3.0, -1.0, 7.0, "episode", harm=False, passed=False)
    found = [
        Grouping("drag", "ball", 30.2, gate._replace(passed=True), pays=True),
        Grouping("dry_friction", "day", 12.0, gate, pays=False),
        Grouping("drag", "day", 9.0, None, pays=False),
    ]
    assert sentence_of(found) == (
        " Grouping drag by ball pays (+30 nats). Grouping dry friction by day does not pay (+12 nats, but not on held-out"
        " episodes). Grouping drag by day does not pay (+9 nats, but another grouping explains more)."
    )
    assert sentence_of([found[0]._replace(accepted=False), found[1]._replace(accepted=False)]) == (
        " Grouping drag by ball pays (+30 nats)."
    )
    effects = [
        Expression(n, acts_on="x", term="-c*x", parameters={"c": {"range": [0, 1]}}) for n in ("drag", "dry_friction")
    ]
    assert [e.per for e in grouped_effects(effects, found)] == ["ball", ""]
    assert sentence_of([]) == ""


def test_what_a_search_with_it_did_not_choose_does_not_pay() -> None:
    gate = Gate(3.0, 1.0, 7.0, "episode", harm=False, passed=True)
    found = [Grouping("drag", "ball", 30.2, gate, pays=True), Grouping("leak", "day", 20.0, gate, pays=True)]
    by = SimpleNamespace(by="ball")
    terms = [SimpleNamespace(effect="drag", groupings=(by,)), SimpleNamespace(effect="leak", groupings=())]
    search = object.__new__(Search)
    search.terms = terms  # type: ignore[assignment]
    chosen = Trial((0, 1), cast(Any, None))
    said = confirmed(found, search, chosen)
    own = Grouping("", "ball", 9.0, gate, pays=True, parameter="b")
    assert [g.pays for g in said] == [True, False]
    assert confirmed([own], search, chosen) == [own]
    assert sentence_of(said[1:]) == (
        " Grouping leak by day does not pay (+20 nats, but a search with it chose otherwise)."
    )


def test_rivals_of_an_effect_that_only_differing_explains_differ_as_well() -> None:
    gate = Gate(3.0, 1.0, 7.0, "episode", harm=False, passed=True)
    names = ("drag", "dry_friction", "leak")
    effects = [Expression(n, acts_on="x", term="-c*x", parameters={"c": {"range": [0, 1]}}) for n in names]
    found = [
        Grouping("drag", "ball", 30.0, gate, pays=True, accepted=False),
        Grouping("dry_friction", "ball", 28.0, None, pays=False, accepted=False),
        Grouping("leak", "ball", 20.0, None, pays=False, accepted=False),
    ]
    assert [e.per for e in grouped_effects(effects, found)] == ["ball", "ball", ""]
    assert [e.per for e in grouped_effects(effects, [g._replace(accepted=True) for g in found])] == ["ball", "", ""]


@pytest.mark.parametrize(("chosen", "differs"), [((0,), False), ((0,), True), ((), False)])
def test_effects_that_differ_are_asked_in_place_of_one_that_does_not(
    chosen: tuple[int, ...], differs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A spring for all balls may make up for a drag of every ball."""
    nothing: Any = None

    def called(name: str, grouped: bool) -> Any:
        own = (1,) if grouped else ()
        return SimpleNamespace(
            effect=name, label=name, acts_on="v", depends_on=(), groupings=own, stores=(), kind="rate", generalises=()
        )

    terms = [called("spring", differs), called("drag", False)]
    model = SimpleNamespace(groups={"ball": ("a", "b")})
    search: Any = SimpleNamespace(terms=terms, plan=SimpleNamespace(augmented=SimpleNamespace(model=model)), tried=0)
    base, own, drag = Trial((), nothing), Trial(chosen, nothing), Trial((1,), nothing)
    stages = (SimpleNamespace(before=base, trials=(Trial((0,), nothing), drag)),)
    selection: Any = SimpleNamespace(chosen=own, base=base, stages=stages)
    selection._replace = lambda chosen: SimpleNamespace(chosen=chosen, stages=stages)
    effects = [
        Expression(name, acts_on="v", term="-k*v", parameters={"k": {"range": [0, 1]}}) for name in ("spring", "drag")
    ]
    small: Any = SimpleNamespace(part=lambda _, rest: Trial(rest, nothing), plan=nothing, tried=0)
    added: list[tuple[int, ...]] = []
    asked_of: list[tuple[str, bool, list[Trial]]] = []

    def answers(_: Any, __: Any, at: Trial, questions: Any, ___: int) -> list[Grouping]:
        asked_of.extend((q.of.effect, q.of.accepted, q.trials(at)[1]) for q in questions)
        return []

    module = grouping_module
    monkeypatch.setattr(module, "_small", lambda *_: (small, own))
    monkeypatch.setattr(module, "judged", answers)
    monkeypatch.setattr(module, "_leaders", unwrap(module._leaders))
    monkeypatch.setattr(module, "_added", lambda _, at, *__: added.append(at.terms) or drag)
    monkeypatch.setattr(module, "_differing", lambda _, at, *__: at)
    assessor: Any = SimpleNamespace(of=lambda _: nothing)
    terminal: Any = SimpleNamespace(line=lambda *_: None)
    unwrap(module.groupings)(search, assessor, selection, False, effects, nothing, nothing, terminal)
    asks = {name: parts for name, _, parts in asked_of}
    if not chosen:  # beside the simulator alone all are
        assert added == [(), ()]
    elif differs:
        assert asks == {}
    else:
        assert asks == {"spring": [own], "drag": [own]}
        assert added == [()]  # in its place, not beside it
