"""One effect that holds another, and the two that fit as well in its place."""

from collections.abc import Callable
from dataclasses import replace
from inspect import unwrap
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_ranges import cart

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.sets import splitting
from simpel_cli.discovery.search.sets.splitting import two_in_place
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.verdict.verdict import _phrase
from simpel_cli.filtering.likelihood.fit import Fitter
from simpel_cli.filtering.setup import setup
from simulators.effects import Expression, Term

WIDTH = {"range": [0.05, 3], "neutral": 0.1, "unit": "m/s", "starts": [0.1, 1]}
SIZE = {"range": [0, 3], "unit": "m/s^2", "starts": [0.3]}
COULOMB = Expression("coulomb", acts_on="v", term="-c*tanh(v/w)", parameters={"c": SIZE, "w": WIDTH})
ASYMMETRIC = Expression(
    "asymmetric", acts_on="v", term="-p*max(tanh(v/w), 0) + n*max(-tanh(v/w), 0)",
    parameters={"p": SIZE, "n": SIZE, "w": WIDTH}, generalises=("coulomb",),
)  # fmt: skip
LOAD = Expression("load", acts_on="v", term="a", parameters={"a": {"range": [-2, 2], "unit": "m/s^2", "starts": [0.2]}})
SPRING = Expression(
    "spring", acts_on="v", term="-k*s", parameters={"k": {"range": [-1, 1], "unit": "1/s^2", "starts": [0.1]}}
)


LEANING = Expression(
    "leaning", acts_on="v", term="g*(1 - 0.02*s)",
    parameters={"g": {"range": [-2, 2], "unit": "m/s^2", "starts": [0.2]}},
)  # fmt: skip


def rubbing(noise: float, width: float = 0.05) -> Recording:
    """Carts whose friction is 1.2 m/s^2 forwards and 0.4 backwards, beyond a speed of `width`, m/s; noise: in m and m/s."""
    return driven(lambda _, v: -(1.2 if v > 0 else 0.4) * np.tanh(v / width), noise)


def driven(rate: Callable[[float, float], float], noise: float) -> Recording:
    """Carts with something more, (s, v) -> m/s^2; noise: in m and m/s."""
    random, fine = np.random.default_rng(4), 50
    episodes = []
    for e in range(4):
        u = np.repeat(random.uniform(-3, 3, 12), 5)
        s, v, rows = 0.0, 0.0, []
        for now in u:
            rows.append((s, v))
            for _ in range(fine):
                s, v = s + 0.1 / fine * v, v + 0.1 / fine * (1.2 * now + rate(s, v))
        noisy = np.array(rows) + noise * random.normal(size=(60, 2))
        episodes.append(Episode(str(e), np.arange(60) * 0.1, noisy, u[:, None], np.zeros((60, 0))))
    every = {"s": noise, "v": noise}
    return Recording(tuple(episodes[:3]), tuple(episodes[3:]), (), every, (), (Check("c", True, ""),), ())


def chosen_in(noise: float, *more: Expression) -> tuple[Search, Trial]:
    """Asymmetric friction, chosen among these effects."""
    plan = setup(cart(), rubbing(noise), (), [ASYMMETRIC, COULOMB, LOAD, SPRING, *more], 4)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=15))
    (own,) = (t for t, term in enumerate(search.terms) if term.effect == "asymmetric")
    return search, search.add(search.base(), [own]).trials[0]


def names(pairs: list[tuple[Term, Term]]) -> list[list[str]]:
    return [[t.effect for t in pair] for pair in pairs]


@pytest.mark.parametrize(("noise", "same"), [(0.05, True), (0.02, False), (1e-3, False)])
def test_friction_that_differs_is_coulombs_and_a_load_unless_low_speeds_are_seen(noise: float, same: bool) -> None:
    """With 0.02 both promise as much as they have to, and what they are fitted to tells them apart."""
    search, chosen = chosen_in(noise)
    assert chosen.optimum.log_evidence - search.base().optimum.log_evidence > 50
    assert names(two_in_place(search, chosen, 0)) == ([["coulomb", "load"]] if same else [])
    (coulomb,) = (t for t, term in enumerate(search.terms) if term.effect == "coulomb")
    assert two_in_place(search, search.add(search.base(), [coulomb]).trials[0], 0) == []  # it holds no other
    search.budget = Budget(1.0, iter([0.0, 2.0]).__next__)
    assert two_in_place(search, chosen, 0) == []
    assert search.budget.left_out == ["two effects in place of one"]


@pytest.mark.parametrize("said", [True, False])
def test_a_rival_by_itself_is_no_half_of_a_pair(said: bool) -> None:
    """The same law in other words does as well without Coulomb friction beside it, known as a case of it or not."""
    other = replace(
        ASYMMETRIC, name="other", term="-(m + d*abs(tanh(v/w))/tanh(v/w))*tanh(v/w)",
        parameters={"m": SIZE, "d": {"range": [-2, 2], "unit": "m/s^2", "starts": [0.2]}, "w": WIDTH},
        generalises=("coulomb",) if said else (),
    )  # fmt: skip
    search, chosen = chosen_in(0.05, other)
    assert names(two_in_place(search, chosen, 0)) == [["coulomb", "load"]]


@pytest.mark.parametrize(("noise", "nearly"), [(0.5, True), (0.1, False)])
def test_what_nearly_won_may_be_one_of_two_effects(noise: float, nearly: bool) -> None:
    """A push and a weak spring look like one law of the position, until there is little noise."""
    plan = setup(cart(), driven(lambda s, _: 0.8 - 0.024 * s, noise), (), [LEANING, LOAD, SPRING, COULOMB], 4)
    search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=15))
    named = [t for t, term in enumerate(search.terms) if not term.depends_on]
    leaning, load, *_ = search.add(search.base(), named).trials
    assert [search.terms[t.terms[0]].effect for t in (leaning, load)] == ["leaning", "load"]
    behind = leaning.optimum.log_evidence - load.optimum.log_evidence
    assert (splitting.TIE < behind < splitting.NEAR) is nearly
    assert names(two_in_place(search, leaning, 0)) == ([["load", "spring"]] if nearly else [])


def test_ties_take_no_place_of_what_nearly_won() -> None:
    """Nats behind: two ties, what nearly won, one that is the same to the data, and one that is too far."""
    behind = {1: 0.5, 2: 2.0, 3: 4.0, 4: 4.5, 5: 5.0, 6: 7.5}
    losses = {1: 1.0, 2: 2.0, 3: 3.0, 4: 3.5, 5: 9.0, 6: 9.9}
    fits: dict[int, Any] = {t: SimpleNamespace(log_evidence=-nats, loss=losses[t]) for t, nats in behind.items()}
    chosen: Any = SimpleNamespace(terms=(0,), optimum=SimpleNamespace(log_evidence=0.0, loss=0.0))
    search: Any = SimpleNamespace(
        known={frozenset({t}): fit for t, fit in fits.items()}, candidates=lambda _: list(range(7)),
        terms=[SimpleNamespace(depends_on=())] * 7,
    )  # fmt: skip
    assert unwrap(splitting._nearly_won)(search, chosen, 0) == [3, 5]


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ([], "drag on v (c = 2 (1..3) 1/m)"),
        ([("coulomb_friction", "load")], " (which these data cannot tell from coulomb friction on v with load on v)"),
        (
            [("coulomb", "load"), ("coulomb", "offset")],
            " (which these data cannot tell from coulomb on v with load or offset on v)",
        ),
        (
            [("gap", "load"), ("gap", "drag"), ("gap", "offset"), ("lag", "load")],
            " (which these data cannot tell from gap on v with load, drag or offset on v, or from lag on v with load on v)",
        ),
    ],
)
def test_pairs_are_said_in_the_sentence(pairs: list[tuple[str, str]], said: str) -> None:
    effect = {
        "name": "drag", "acts_on": "v", "class_members": [{"name": "drag", "acts_on": "v", "same": True}],
        "parameters": {"c": {"value": 2.0, "low": 1.0, "high": 3.0, "unit": "1/m"}},
        "same_as_two": [[{"name": name, "acts_on": "v"} for name in pair] for pair in pairs],
    }  # fmt: skip
    assert _phrase(effect).endswith(said)


@pytest.mark.parametrize(
    ("ahead", "alike", "better"), [(-4, False, False), (-2, True, False), (2, True, True), (9, False, True)]
)
def test_a_pair_is_as_good_on_both_sides_and_a_half_on_one(ahead: float, alike: bool, better: bool) -> None:
    whole: Any = SimpleNamespace(log_evidence=0.0, loss=0.0, free=(0,))
    fit: Any = SimpleNamespace(log_evidence=float(ahead), loss=5.0, free=(0, 1))
    assert unwrap(splitting._as_good)(fit, whole) is alike
    assert unwrap(splitting._better)(fit, whole) is better
    fit.loss = 0.5  # widths of priors alone tell no two apart, unless one of them has more unknowns
    assert unwrap(splitting._as_good)(fit, whole) is alike
    fit.free = (1,)
    assert unwrap(splitting._as_good)(fit, whole)
