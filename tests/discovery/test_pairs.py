"""Effects that pay only together: a drag that is negative where it is slow, of which each part alone is worth nothing."""

import numpy as np
import pytest
from test_ranges import cart, searched

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.sets.pairs import together
from simpel_cli.discovery.search.trials import Search, asked
from simulators.effects import Expression

GAIN, DT, FINE = 1.3, 0.1, 20


def law(name: str, term: str, unit: str, most: float) -> Expression:
    return Expression(
        name, acts_on="v", term=term, parameters={"k": {"range": [-most, most], "unit": unit, "starts": [0.1 * most]}}
    )


LINEAR, CUBIC = law("linear", "-k*v", "1/s", 1.0), law("cubic", "-k*v**3", "s/m^2", 0.1)
SHIFT = law("shift", "-k", "m/s^2", 1.0)


def carts(linear: float, cubic: float, seed: int = 5, noise: float = 1e-2) -> Recording:
    """Carts with a drag of two parts, in small steps."""
    random, episodes = np.random.default_rng(seed), []
    for e in range(4):
        u, x, rows = np.repeat(random.uniform(-3, 3, 15), 4), np.array([0.0, 0.0]), []
        for now in u:
            rows.append(x)
            for _ in range(FINE):
                rate = GAIN * now - linear * x[1] - cubic * x[1] ** 3
                x = x + DT / FINE * np.array([x[1] + DT / FINE * rate / 2, rate])
        noisy = np.array(rows) + noise * random.normal(size=(len(u), 2))
        episodes.append(Episode(str(e), np.arange(len(u)) * DT, noisy, u[:, None], np.zeros((len(u), 0))))
    return Recording(
        tuple(episodes[:3]), tuple(episodes[3:]), (), {"s": noise, "v": noise}, (), (Check("c", True, ""),), ()
    )


@pytest.fixture(scope="module")
def planted() -> Search:
    search = searched(carts(-0.09, 0.0125), (LINEAR, CUBIC, SHIFT), cart())
    search.banned |= {i for i, term in enumerate(search.terms) if term.depends_on}
    return search


def test_two_effects_that_pay_only_together_are_found(planted: Search) -> None:
    base = planted.base()
    alone = planted.add(base, planted.candidates(())).trials
    assert all(t.optimum.log_evidence - base.optimum.log_evidence < asked(1) for t in alone)
    found = select(planted)
    assert {planted.terms[t].effect for t in found.chosen.terms} == {"linear", "cubic"}
    assert found.chosen.optimum.log_evidence - base.optimum.log_evidence > 30
    assert min(found.gains) > 20  # each beside the other
    for term, expected in (("linear", -0.09), ("cubic", 0.0125)):
        (t,) = (t for t in found.chosen.terms if planted.terms[t].effect == term)
        (row,) = planted.rows[t]
        assert planted.plan.coordinates.value(row, float(found.chosen.optimum.z[row])) == pytest.approx(
            expected, rel=0.2
        )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_where_nothing_is_missing_no_pair_is_found(seed: int) -> None:
    search = searched(carts(0.0, 0.0, seed), (LINEAR, CUBIC, SHIFT), cart())
    assert together(search, search.base()) is None


def test_a_set_promises_what_its_effects_promise_together(planted: Search) -> None:
    base = planted.base()
    named = planted.candidates(())
    starts = planted.starts(base, named)
    where = {planted.terms[t].effect: i for i, (t, _) in reversed(list(enumerate(starts)))}
    linear, cubic, shift = (where[name] for name in ("linear", "cubic", "shift"))
    sets = [(linear,), (cubic,), (linear, cubic), (linear, shift), (shift,)]
    gains = [score.gain for score in planted.promises(base, starts, sets)]
    alone = [score.gain for score in planted.promises(base, starts)]
    np.testing.assert_allclose([gains[0], gains[1], gains[4]], [alone[linear], alone[cubic], alone[shift]], rtol=1e-6)
    assert gains[2] > 20 > 5 * max(gains[0], gains[1])
    assert gains[3] >= max(gains[0], gains[4]) - 1e-9
