"""A search by simulations: what it finds, and how that is said in the coordinates of the ordinary search."""

from inspect import unwrap
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_ranges import DRAG, cart, measured, searched

import simpel_cli.discovery.searched as whole
from simpel_cli.discovery.ground import Ground
from simpel_cli.discovery.search.again import Again, Earlier
from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.ranges import Wider
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.simulations import (
    Spoiling,
    chosen_by_simulations,
    in_rows,
    simulating,
    spoiling,
    worth_simulating,
)
from simpel_cli.discovery.search.smaller import carried, names_of
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.memories import Memory
from simpel_cli.discovery.searched import Searched
from simpel_cli.discovery.watch import Watch
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import Setup, setup
from simpel_cli.runs.console import Terminal
from simulators.effects import Expression

B, K = 1.2, 0.15


def searches() -> tuple[Search, Search]:
    """The ordinary search and the one by simulations."""
    recording = measured(B, k=K)
    search = searched(recording)
    return search, simulating(
        search, search.base(), lambda: setup(cart(), recording, (), [DRAG], 1, simulated=True),
        lambda plan: Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=15),
    )  # fmt: skip


@pytest.fixture(scope="module")
def both() -> tuple[Any, ...]:
    search, simulated = searches()
    selection = select(simulated, simulated.base())
    return search, simulated, selection, in_rows(simulated, selection, search)


def value(plan: Setup, trial: Any, name: str) -> float:
    row = names_of(plan).index(name)
    return plan.coordinates.value(row, float(trial.optimum.z[row]))


def test_the_effect_is_found_by_simulations(both: tuple[Any, ...]) -> None:
    _, simulated, selection, _ = both
    assert [simulated.terms[t].effect for t in selection.chosen.terms] == ["drag"]
    assert value(simulated.plan, selection.chosen, "b") == pytest.approx(B, rel=2e-3)
    assert value(simulated.plan, selection.chosen, "drag_v_k") == pytest.approx(K, rel=2e-2)
    # what the simulator alone leaves is no noise of the process, and the effect takes it away
    before, after = (
        value(simulated.plan, t, "process noise of remainder_s") for t in (selection.base, selection.chosen)
    )
    assert after < 0.2 * before


def test_it_is_said_in_the_coordinates_of_the_ordinary_search(both: tuple[Any, ...]) -> None:
    search, simulated, selection, found = both
    for own, there in ((found.base, selection.base), (found.chosen, selection.chosen)):
        assert own.terms == there.terms
        assert own.optimum.free == search.free(own.terms)
        for name in ("b", "drag_v_k")[: 1 + len(own.terms)]:
            assert value(search.plan, own, name) == pytest.approx(value(simulated.plan, there, name))
            row, far = (names_of(s.plan).index(name) for s in (search, simulated))
            i, k = own.optimum.free.index(row), there.optimum.free.index(far)
            assert own.optimum.covariance[i, i] == there.optimum.covariance[k, k]
    assert found.gains == selection.gains
    assert search.part(found.chosen, ()).optimum is found.base.optimum
    # levels of noise are those of the ordinary search at these parameters: the right model needs none of the process
    plan = search.plan
    n_p, n_r, n_q = plan.coordinates.sizes
    q = [plan.coordinates.value(i, float(found.chosen.optimum.z[i])) for i in range(n_p + n_r, n_p + n_r + n_q)]
    p = [plan.coordinates.value(i, float(found.base.optimum.z[i])) for i in range(n_p + n_r, n_p + n_r + n_q)]
    assert q[-1] < 0.2 * p[-1]
    assert np.isfinite(found.chosen.optimum.log_evidence)
    assert all(t.optimum.free == search.free(t.terms) for s in found.stages for t in (s.before, *s.trials))


def test_what_simulations_ask_for_is_chosen_where_it_is_worth_more() -> None:
    search, simulated = searches()
    assessors = Assessor(search.plan, 10), Assessor(simulated.plan, 10)
    terminal = Terminal(quiet=True)
    found = select(search)
    assert [search.terms[t].effect for t in found.chosen.terms] == ["drag"]
    options = Discovery(beginnings=0)
    assert chosen_by_simulations(search, found, simulated, assessors, options, terminal) is None  # they say the same
    nothing = found._replace(chosen=found.base, path=(found.base,), classes=(), gains=())
    other = chosen_by_simulations(search, nothing, simulated, assessors, options, terminal)
    assert other is not None
    assert [simulated.terms[t].effect for t in other[0].chosen.terms] == ["drag"]
    assert all(g.passed for g in other[1])


def test_a_search_begins_with_what_another_one_found(both: tuple[Any, ...]) -> None:
    """The drag is no candidate, so that only the other search's set can bring it along."""
    _, simulated, selection, _ = both
    simulated.banned, before = set(range(len(simulated.terms))), simulated.banned
    try:
        assert select(simulated, selection.base, 0).chosen.terms == ()
        assert select(simulated, selection.base, 0, selection.path).chosen.terms == selection.chosen.terms
    finally:
        simulated.banned = before


def test_what_is_switched_off_beyond_its_range_stays_so() -> None:
    limit = Expression(
        "limit", acts_on="u", term="min(max(u, -top), top)",
        parameters={"top": {"range": [0.5, 3.0], "neutral": 6.0, "unit": "V"}},
    )  # fmt: skip
    recording = measured(B)
    old, new = (setup(cart(), recording, (), [limit], 1, simulated=far) for far in (False, True))
    row, there = (names_of(plan).index("limit_u_top") for plan in (old, new))
    assert old.start[row] > 1
    assert carried(old, old.start, new)[there] == new.start[there] == old.start[row]


def test_what_explains_most_of_a_free_run_asks_for_no_simulations() -> None:
    recording = measured(B, k=K)
    search = searched(recording)
    assessor = Assessor(search.plan, 10)
    found = select(search, search.base())
    assert found.chosen.terms
    free = Discovery(for_="free_run")
    assert not worth_simulating(search, assessor, found, free)
    nothing = found._replace(chosen=found.base)  # nothing is gone
    assert worth_simulating(search, assessor, nothing, free)
    # but what the model is for, and what the user says, decide first
    assert not worth_simulating(search, assessor, nothing, Discovery())
    assert not worth_simulating(search, assessor, nothing, Discovery(for_="free_run", simulations=False))
    assert worth_simulating(search, assessor, found, Discovery(simulations=True))


def test_a_model_that_runs_away_asks_for_simulations() -> None:
    """Rows in which it has no error are no rows without one."""
    base: Any = SimpleNamespace(optimum=SimpleNamespace(z=np.zeros(2)))
    lost: Any = SimpleNamespace(optimum=SimpleNamespace(z=np.ones(2)))
    free = np.ones((3, 5, 1))
    away = np.where(np.arange(3)[:, None, None] == 0, np.nan, 1e-3 * free)
    errors = {0.0: free, 1.0: away}
    coordinates = SimpleNamespace(sizes=(1, 1, 0), value=lambda *_: 0.01)
    model = SimpleNamespace(groups={})
    augmented, free_run = SimpleNamespace(model=model), Discovery(for_="free_run")
    search: Any = SimpleNamespace(plan=SimpleNamespace(coordinates=coordinates, windows=None, augmented=augmented))
    assessor: Any = lambda z, _: SimpleNamespace(free=errors[float(z[0])])  # noqa: E731
    selection: Any = SimpleNamespace(base=base, chosen=lost)
    assert unwrap(worth_simulating)(search, assessor, selection, free_run)
    model.groups = {"ball": ("a", "b")}
    assert not unwrap(worth_simulating)(search, assessor, selection, free_run)
    model.groups = {}
    errors[1.0] = 1e-3 * free
    assert not unwrap(worth_simulating)(search, assessor, selection, free_run)


def test_an_effect_that_makes_the_filter_worse_is_not_accepted(
    both: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simulations may ask for it: what they leave has a memory, which follows whatever is left."""
    search, simulated, selection, _ = both
    assessor, (drag,) = Assessor(search.plan, 10), selection.chosen.terms
    assert spoiling(simulated, search, assessor, selection.chosen) is None
    # as if the simulator by itself were the model with the effect: one row ahead it is off by many times the noise
    swapped = selection.chosen._replace(optimum=selection.base.optimum)
    monkeypatch.setattr(simulated, "part", lambda *_: selection.chosen._replace(terms=()))
    found = spoiling(simulated, search, assessor, swapped)
    assert found is not None
    assert found.term == drag
    assert found.error.endswith(("one row ahead", "some rows ahead"))
    assert found.times > 1.1


def nothing_of(search: Search) -> Selection:
    """What an ordinary search has chosen that found nothing."""
    base = search.base()
    return Selection(base, base, (base,), (), (), (), None)


MODULE = "simpel_cli.discovery.search.simulations"


def test_the_search_goes_on_without_what_makes_the_filter_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    search, simulated = searches()
    asked: list[tuple[int, ...]] = []

    def spoiled(*args: Any) -> Spoiling | None:
        asked.append(args[-1].terms)
        return Spoiling(args[-1].terms[0], "s one row ahead", 2.0) if args[-1].terms else None

    monkeypatch.setattr(f"{MODULE}.spoiling", spoiled)
    assessors = Assessor(search.plan, 10), Assessor(simulated.plan, 10)
    options, terminal = Discovery(beginnings=0), Terminal(quiet=True)
    assert chosen_by_simulations(search, nothing_of(search), simulated, assessors, options, terminal) is None
    assert len(asked[0]) == 1
    assert asked[-1] == ()
    assert simulated.banned >= set(asked[0])


def test_what_spoils_after_it_was_judged_goes_too_and_bans_beside_it_do_not_stay(
    both: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beginnings are cut where the effect comes in; an earlier one without it is a beginning still."""
    search, _, selection, _ = both
    _, simulated = searches()
    base = simulated.base()
    spoiler, refused, good, more = 0, 7, 5, 6
    known = (base, base._replace(terms=(good,)))
    begun: list[tuple[tuple[int, ...], ...]] = []
    banned: list[set[int]] = []

    def proposal(_: Any, __: Any, ___: Any, ____: Any, path: Any) -> Any:
        begun.append(tuple(t.terms for t in path))
        banned.append(set(simulated.banned))
        terms = (spoiler,) if spoiler not in simulated.banned else (good, more)
        return selection._replace(base=base, chosen=base._replace(terms=terms), path=(base, base._replace(terms=terms)))

    checked: list[tuple[int, ...]] = []

    def spoiled(*args: Any) -> Spoiling | None:
        checked.append(args[-1].terms)
        late = spoiler in args[-1].terms and checked.count((spoiler,)) == 2
        return Spoiling(spoiler, "s one row ahead", 2.0) if late else None

    def accepted(_: Any, __: Any, judged: Any, gates: Any, ___: Any) -> Any:
        simulated.banned = {*simulated.banned, *([refused] if spoiler in judged.chosen.terms else [])}
        return judged, gates

    monkeypatch.setattr(f"{MODULE}.proposed", proposal)
    monkeypatch.setattr(f"{MODULE}.judgement", lambda _, __, other, ___, ask: (other, []))
    monkeypatch.setattr(f"{MODULE}.accepted", accepted)
    monkeypatch.setattr(f"{MODULE}.spoiling", spoiled)
    monkeypatch.setattr(f"{MODULE}.path_in", lambda *_: known)
    monkeypatch.setattr(
        f"{MODULE}.worth", lambda t: {(): 0.0, (spoiler,): 9.0, (good,): 8.0, (good, more): 20.0}[t.terms]
    )
    monkeypatch.setattr(simulated, "best", lambda terms, _: base._replace(terms=terms))
    assessors = Assessor(search.plan, 10), Assessor(simulated.plan, 10)
    outcome = chosen_by_simulations(
        search, selection._replace(path=(selection.base, selection.chosen)), simulated, assessors,
        Discovery(), Terminal(quiet=True), earlier=Earlier(simulated, base),
    )  # fmt: skip
    assert selection.chosen.terms == (spoiler,)  # what the ordinary search has chosen
    assert begun == [((), (spoiler,)), ((), (good,))]
    assert banned == [set(), {spoiler}]
    assert isinstance(outcome, tuple)
    assert not isinstance(outcome, Wider)
    assert outcome[0].chosen.terms == (good, more)


def test_no_wider_range_is_asked_for_by_what_makes_the_filter_worse(
    both: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    search, _, selection, _ = both
    _, simulated = searches()
    assessors = Assessor(search.plan, 10), Assessor(simulated.plan, 10)
    checked: list[tuple[int, ...]] = []

    def spoiled(*args: Any) -> Spoiling | None:
        checked.append(args[-1].terms)  # the first time it is looked at, it is what was proposed
        return Spoiling(args[-1].terms[0], "s one row ahead", 2.0) if args[-1].terms and len(checked) > 1 else None

    monkeypatch.setattr(f"{MODULE}.spoiling", spoiled)
    outcome = chosen_by_simulations(
        search, selection, simulated, assessors, Discovery(beginnings=0), Terminal(quiet=True),
        lambda _, trial: Wider({"b": (0.0, 9.0)}, 9.0) if trial.terms else None,
    )  # fmt: skip
    assert outcome is None


def test_a_search_with_a_hidden_state_begins_with_what_simulations_have_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own search by simulations is another one, and may end elsewhere."""
    nothing: Any = None
    search: Any = searched(measured(B))
    known = Earlier(search, Trial((), nothing))
    grounds = list[Ground]()

    def search_in_groups(ground: Ground, _: Any) -> Any:
        grounds.append(ground)
        if len(grounds) < 3:
            return Again(Memory((), 20.0), None, simulated=known if len(grounds) == 1 else None)
        return Searched(search, nothing, nothing, [], None, nothing, nothing, {}, {}, [])

    monkeypatch.setattr(whole, "_search_in_groups", search_in_groups)
    monkeypatch.setattr(whole, "last_calibration", lambda *_: SimpleNamespace(_asdict=dict))
    model, clean, terminal = search.plan.augmented.model, SimpleNamespace(recording=nothing), Terminal(quiet=True)
    ground: Any = Ground(model, clean, nothing, (), terminal, Budget(), Watch(Budget()))  # type: ignore[arg-type]
    unwrap(whole._searched)(ground, [])
    assert [g.simulated for g in grounds] == [None, known, known]
