"""Which terms a large model is offered, by a latent force that is known."""

import numpy as np
import pytest
from test_aliases import searched

from simpel_cli.discovery.search import shortlist as module
from simpel_cli.discovery.search.shortlist import shortlist
from simpel_cli.filtering.likelihood.latent_force import Force
from simpel_cli.filtering.setup import key_of
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
