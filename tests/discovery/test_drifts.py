"""Parameters that are no constants: which, how, by how much; and nothing where they are."""

from typing import Any

import numpy as np
import pytest
from test_ranges import cart, searched

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.drifts import BETWEEN, OVER, Drift, drifting, may_stand_for, stands_for
from simpel_cli.discovery.search.unexplained.instead_of_drifts import (
    needed_beside,
    suspected,
    with_drift,
    with_progress,
)
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.verdict.remainder import dependence, remainder_of
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.setup import Setup, setup
from simulators.effects import Expression
from simulators.model import Model

FINE = 20  # steps per row


def pushed(drift: float, differs: tuple[float, ...] = (0.0,) * 6, drag: float = 0.0, low: float = -3) -> Recording:
    """Carts whose gain is 1.2 + differs[e] + drift (t/T - 1/2), with 1 mm and 1 mm/s of noise, and maybe a drag, 1/m."""
    random = np.random.default_rng(5)
    episodes = []
    for e in range(len(differs) + 1):
        own = (*differs, 0.0)[e]
        u = np.repeat(random.uniform(low, 3, 10), 6)
        x = np.zeros((60, 2))
        for i in range(59):
            s, v = x[i]
            for k in range(FINE):
                b = 1.2 + own + drift * ((i + (k + 0.5) / FINE) / 59 - 0.5)
                h = 0.1 / FINE
                a = b * u[i] - drag * v * abs(v)
                s, v = s + h * v + h**2 / 2 * a, v + h * a
            x[i + 1] = s, v
        noisy = x + 1e-3 * random.normal(size=x.shape)
        episodes.append(Episode(str(e), np.arange(60) * 0.1, noisy, u[:, None], np.zeros((60, 0))))
    return Recording(
        tuple(episodes[:-1]), tuple(episodes[-1:]), (), {"s": 1e-3, "v": 1e-3}, (), (Check("c", True, ""),), ()
    )


def found_in(recording: Recording) -> tuple[Search, Trial, Drift | None]:
    search = searched(recording, [], cart(0.8, 1.8))
    base, assessor = search.base(), Assessor(search.plan, 10)
    return search, base, drifting(NoiseProfile(search, assessor, base))


def left_over(search: Search, base: Trial, found: Drift) -> dict[str, Any]:
    """Return the remainder of a search without effects."""
    learnt = Assessor(search.plan, 10)(base.optimum.z, search.plan.windows)
    left = remainder_of(search, Selection(base, base, (base,), (), (), (), None), None, learnt, found)
    assert left is not None
    return left


@pytest.mark.parametrize("size", [0.15, -0.06])
def test_a_drift_over_every_episode_is_named_with_its_size(size: float) -> None:
    search, base, found = found_in(pushed(size))
    assert found is not None
    assert found[:2] == ("b", OVER)
    assert found.size == pytest.approx(size, rel=0.15)
    assert found.unit == "m/s^2/V"
    assert found.words == f"b drifts over an episode, by {found.size:+.3g} m/s^2/V"
    left = left_over(search, base, found)
    assert left["description"] == f"a parameter is no constant: {found.words}"
    assert dependence(left) == "time"


def test_episodes_that_differ_are_named_with_their_spread() -> None:
    differs = (0.1, -0.12, 0.05, -0.04, 0.11, -0.1)
    search, base, found = found_in(pushed(0.0, differs))
    assert found is not None
    assert found[:2] == ("b", BETWEEN)
    assert found.size == pytest.approx(np.std(differs), rel=0.15)
    assert "differs from episode to episode, with a standard deviation of" in found.words
    left = left_over(search, base, found)
    assert left["depends_on"] == ["episode"]


def test_a_constant_is_one() -> None:
    _, base, found = found_in(pushed(0.0))
    assert found is None
    assert not stands_for(found, base, base)


def test_a_drift_stands_for_effects_that_explain_no_more() -> None:
    _, base, found = found_in(pushed(0.15))
    assert found is not None
    some, more = (
        base._replace(terms=(0,), optimum=base.optimum._replace(log_evidence=float(base.optimum.log_evidence + gain)))
        for gain in (found.gain, found.gain + 10)
    )
    assert not stands_for(found, base, some)  # it is fitted beside them
    found = found._replace(how=BETWEEN)
    assert stands_for(found, base, some)
    assert not stands_for(found, base, more)
    assert not stands_for(found, base, some, 10.0)  # beside which a function explains more
    assert not stands_for(found, base, base)  # there are no effects
    assert not stands_for(None, base, some)


def test_a_simulator_whose_parameter_drifts_is_the_one_with_its_value_at_every_row() -> None:
    model = cart(0.8, 1.8)
    moving = with_drift(model, "b")
    assert [q.name for q in moving.params] == ["b", "drift_of_b"]
    assert moving.params[1][1:4] == ("m/s^2/V", -1.0, 1.0)
    x, u = np.array([0.1, -0.2]), np.array([1.5])
    for progress in (-0.5, 0.0, 0.3):
        found = moving.function()(x, [*u, progress], [1.2, 0.4])[0]
        np.testing.assert_allclose(found, model.function()(x, u, [1.2 + 0.4 * progress])[0])
    recording = with_progress(pushed(0.0), model)
    assert recording.train[0].inputs.shape == (60, 2)
    np.testing.assert_allclose(recording.train[0].inputs[:, 1], np.linspace(-0.5, 0.5, 60))


@pytest.mark.parametrize(("drift", "drag", "low"), [(-0.3, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 1.6e-5, 2.8)])
def test_an_effect_that_a_search_takes_for_a_drift_earns_no_place_beside_it(
    drift: float, drag: float, low: float
) -> None:
    """A softer motor at speed is a part of what a motor does that grows weaker while the cart goes faster.

    A drag that explains little more than a drift would, 51 nats and 42, stays.
    """
    c = {"range": [-1, 1], "unit": "1/m", "starts": [0.02, -0.02]}
    effect = Expression("drag", acts_on="v", term="-c*v*abs(v)", parameters={"c": c})
    recording, model = pushed(drift, drag=drag, low=low), cart(0.8, 1.8)
    search = searched(recording, [effect], model)
    (chosen, *_) = (t for t in search.add(search.base(), [0]).trials if search.terms[t.terms[-1]].effect == "drag")
    assert chosen.optimum.log_evidence > search.base().optimum.log_evidence + 5

    def attach(model: Model, *, recording: Recording, kept: frozenset) -> Setup:
        return setup(model, recording, (), [effect], 1, kept=kept)

    found = Drift("b", OVER, -0.3, "m/s^2/V", "v", 50.0)
    assert needed_beside(found, attach, model, recording, search, chosen, 1) == ([] if drift else [0])


def test_a_drift_may_stand_for_effects_where_it_promises_half_of_what_they_earn() -> None:
    _, base, found = found_in(pushed(0.15))
    assert found is not None
    some, more = (
        base._replace(terms=(0,), optimum=base.optimum._replace(log_evidence=float(base.optimum.log_evidence + gain)))
        for gain in (1.9 * found.gain, 2.1 * found.gain)
    )
    assert may_stand_for(found, base, some)
    assert not may_stand_for(found, base, more)
    assert not may_stand_for(found, base, base)
    assert not may_stand_for(None, base, some)


def test_a_drift_is_suspected_beside_the_effects_or_in_their_place_unless_a_function_explains_more() -> None:
    search = searched(pushed(0.15), [], cart(0.8, 1.8))
    base, assessor = search.base(), Assessor(search.plan, 10)
    alone = NoiseProfile(search, assessor, base)
    found = drifting(alone, (OVER,))
    assert found is not None
    between = drifting(alone, (BETWEEN,))
    assert between is None or between.gain < found.gain

    def asked(gain: float, remainder: float = 0.0, levels: NoiseProfile | None = None) -> Drift | None:
        chosen = Trial((0,), base.optimum._replace(log_evidence=float(base.optimum.log_evidence + gain)))
        left: Any = (None, remainder) if remainder else None
        return suspected(levels or alone, alone, Selection(base, chosen, (base, chosen), (), (), (), left))

    class Quiet(NoiseProfile):
        def __call__(self, *rows: int) -> list:
            return []

    none = Quiet(search, assessor, base._replace(terms=(0,)))
    assert asked(1e9) == found  # beside them, whatever they explain
    assert asked(1.9 * found.gain, levels=none) == found
    assert asked(2.1 * found.gain, levels=none) is None
    assert asked(1e9, remainder=found.gain + 10) is None
    assert suspected(alone, alone, Selection(base, base, (base,), (), (), (), None)) is None
