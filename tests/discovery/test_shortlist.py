"""Which terms a large model is offered, by a latent force that is known."""

from inspect import unwrap
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_aliases import searched

from simpel_cli.discovery import searched as whole
from simpel_cli.discovery.ground import Ground
from simpel_cli.discovery.search import shortlist as module
from simpel_cli.discovery.search.again import Earlier
from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.ranges import Wider
from simpel_cli.discovery.search.shortlist import shortlist
from simpel_cli.discovery.search.trials import Trial
from simpel_cli.discovery.searched import Searched
from simpel_cli.discovery.watch import Watch
from simpel_cli.filtering.likelihood.latent_force import Force
from simpel_cli.filtering.setup import key_of
from simpel_cli.runs.console import Terminal
from simulators.effects.term import BETWEEN_ROWS


@pytest.mark.parametrize(("force", "name"), [("drag", "drag"), ("load", "load"), ("input", None)])
def test_the_term_that_the_latent_force_looks_like_is_kept(
    monkeypatch: pytest.MonkeyPatch, force: str, name: str | None
) -> None:
    """One place for a named effect: drag, a load, or nothing where a known parameter takes it all."""
    monkeypatch.setattr(module, "NAMED", 1)
    monkeypatch.setattr(module, "UNNAMED", 0)
    search = searched("b")
    plan, terms = search.plan, [t for t in search.terms if t.kind != BETWEEN_ROWS]  # these are asked of all models
    random = np.random.default_rng(1)
    count, rows = plan.windows.y.shape[:2]
    state, u = random.normal(size=(count, rows, 2)), random.normal(size=(count, rows, 1))
    v = state[..., 1]
    pushed = {"drag": -0.4 * v * np.abs(v), "load": 0.4 + 0 * v, "input": 0.1 * u[..., 0]}[force]
    latent = np.stack([0 * v, pushed + 0.02 * random.normal(size=v.shape)], axis=-1)[:, :-1]
    kept = shortlist(plan, plan.start, Force(state, latent, np.full_like(latent, 0.02)), u, terms)
    gains = dict(
        zip(
            map(key_of, terms),
            module._gains(plan, plan.start, Force(state, latent, latent), u, terms),
            strict=True,
        )
    )
    best = max(gains.values())
    if name is None:
        assert best < 0.05 * float(np.sum((pushed[:, :-1] / 0.02) ** 2))
    else:
        assert {key[0] for key in kept} == {name}


@pytest.mark.parametrize(
    ("known", "kept"),
    [
        ((), {"drag", "load"}),
        (("drag",), {"drag"}),  # which explains most; the load, which is next, is not worth compiling anew
        (("load",), {"drag", "load"}),
        (("drag", "of another model"), {"drag"}),
        (("of another model",), {"drag", "load"}),
    ],
)
def test_terms_that_have_a_place_keep_it_where_the_best_ones_are_among_them(
    monkeypatch: pytest.MonkeyPatch, known: tuple[str, ...], kept: set[str]
) -> None:
    monkeypatch.setattr(module, "NAMED", 2)
    monkeypatch.setattr(module, "UNNAMED", 0)
    search = searched("b")
    plan, terms = search.plan, [t for t in search.terms if t.effect in ("drag", "load")]
    random = np.random.default_rng(1)
    count, rows = plan.windows.y.shape[:2]
    state, u = random.normal(size=(count, rows, 2)), random.normal(size=(count, rows, 1))
    v = state[..., 1]
    pushed = 0.1 - 0.4 * v * np.abs(v) + 0.02 * random.normal(size=v.shape)
    force = Force(state, np.stack([0 * v, pushed], axis=-1)[:, :-1], np.full((count, rows - 1, 2), 0.02))
    given = frozenset(next((key_of(t) for t in terms if t.effect == name), (name, "v", ())) for name in known)
    assert {name for name, *_ in shortlist(plan, plan.start, force, u, terms, given)} == kept


@pytest.mark.parametrize("known", [True, False])
def test_a_search_in_wider_ranges_is_told_which_terms_had_a_place(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not where the simulator alone asked for them, before any effect was looked for."""
    nothing: Any = None
    search: Any = searched("b")
    earlier = Earlier(search, Trial((), nothing)) if known else None
    grounds = list[Ground]()

    def search_in_groups(ground: Ground, _: Any) -> Any:
        grounds.append(ground)
        found = Searched(search, nothing, nothing, [], None, nothing, nothing, {}, {}, [])
        return Wider({"b": (0.0, 9.0)}, 9.0, earlier) if len(grounds) == 1 else found

    monkeypatch.setattr(whole, "_search_in_groups", search_in_groups)
    monkeypatch.setattr(whole, "with_memory", lambda *_: [])
    monkeypatch.setattr(whole, "last_calibration", lambda *_: SimpleNamespace(_asdict=dict))
    model, clean, terminal = search.plan.augmented.model, SimpleNamespace(recording=nothing), Terminal(quiet=True)
    ground: Any = Ground(model, clean, nothing, (), terminal, Budget(), Watch(Budget()))  # type: ignore[arg-type]
    unwrap(whole._searched)(ground, [])
    first, second = grounds
    assert first.places == frozenset()
    assert second.places == (frozenset(map(key_of, search.terms)) if known else frozenset())
    assert second.wider == 1
