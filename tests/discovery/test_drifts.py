"""Parameters that are no constants: which, how, by how much; and nothing where they are."""

from typing import Any

import numpy as np
import pytest
from test_ranges import cart, searched

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.unexplained.drifts import BETWEEN, OVER, Drift, drifting, stands_for
from simpel_cli.discovery.search.unexplained.noise_profile import NoiseProfile
from simpel_cli.discovery.verdict.remainder import dependence, remainder_of
from simpel_cli.filtering.errors_ahead import Assessor

FINE = 20  # steps per row


def pushed(drift: float, differs: tuple[float, ...] = (0.0,) * 6) -> Recording:
    """Carts whose gain is 1.2 + differs[e] + drift (t/T - 1/2), with 1 mm and 1 mm/s of noise."""
    random = np.random.default_rng(5)
    episodes = []
    for e in range(len(differs) + 1):
        own = (*differs, 0.0)[e]
        u = np.repeat(random.uniform(-3, 3, 10), 6)
        x = np.zeros((60, 2))
        for i in range(59):
            s, v = x[i]
            for k in range(FINE):
                b = 1.2 + own + drift * ((i + (k + 0.5) / FINE) / 59 - 0.5)
                h = 0.1 / FINE
                s, v = s + h * v + h**2 / 2 * b * u[i], v + h * b * u[i]
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
    assert stands_for(found, base, some)
    assert not stands_for(found, base, more)
    assert not stands_for(found, base, base)  # there are no effects
    assert not stands_for(None, base, some)
