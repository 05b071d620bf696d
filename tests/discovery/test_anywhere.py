"""Effects with a shape may begin anywhere in their ranges: where a slope at the start tells nothing."""

from inspect import unwrap
from types import SimpleNamespace

import numpy as np
import pytest
from test_ranges import cart, searched

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.discovery.search.near import QUIET, far
from simpel_cli.discovery.search.sets.forward import select, widely
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.trials import ANYWHERE, Search
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.setup import Q_BOUNDS
from simulators.effects import Expression

FORCE, PLACE, GAIN, DT, FINE = 4.0, 6.0, 1.3, 0.1, 50
BUMP = Expression(
    "bump",
    acts_on="v",
    term="f*exp(-((s - c)/2)**2)",
    parameters={
        "f": {"range": [-10, 10], "unit": "m/s^2"},
        "c": {"range": [-9, 9], "unit": "m", "neutral": -8, "starts": [-8]},
    },
)
DRAG = Expression("drag", acts_on="v", term="-k*v", parameters={"k": {"range": [0, 2], "unit": "1/s"}})


def pushed() -> Recording:
    """Carts that something pushes where they pass one place, in small steps."""
    random, episodes = np.random.default_rng(5), []
    for e in range(4):
        u, x, rows = np.repeat(random.uniform(-3, 3, 12), 5), np.array([random.uniform(2, 9), 0.0]), []
        for now in u:
            rows.append(x)
            for _ in range(FINE):
                rate = GAIN * now + FORCE * np.exp(-(((x[0] - PLACE) / 2) ** 2))
                x = x + DT / FINE * np.array([x[1] + DT / FINE * rate / 2, rate])
        noisy = np.array(rows) + 1e-3 * random.normal(size=(len(u), 2))
        episodes.append(Episode(str(e), np.arange(len(u)) * DT, noisy, u[:, None], np.zeros((len(u), 0))))
    return Recording(
        tuple(episodes[:3]), tuple(episodes[3:]), (), {"s": 1e-3, "v": 1e-3}, (), (Check("c", True, ""),), ()
    )


@pytest.fixture(scope="module")
def found() -> tuple[Search, Selection]:
    search = searched(pushed(), (BUMP, DRAG), cart())
    search.banned |= {i for i, term in enumerate(search.terms) if term.depends_on}
    return search, select(search, beginnings=0)


def test_what_promises_nothing_where_it_begins_is_found_from_elsewhere(found: tuple[Search, Selection]) -> None:
    search, chosen = found
    assessor = Assessor(search.plan, 5)
    assert "bump" not in {search.terms[t].effect for t in chosen.chosen.terms}
    assert far(search, assessor, chosen.chosen)
    wide = widely(search, chosen)
    assert [search.terms[t].effect for t in wide.chosen.terms] == ["bump"]
    force, place = (
        search.plan.coordinates.value(row, float(wide.chosen.optimum.z[row]))
        for row in search.rows[wide.chosen.terms[0]]
    )
    assert force == pytest.approx(FORCE, rel=0.02)
    assert place == pytest.approx(PLACE, abs=0.05)
    assert not far(search, assessor, wide.chosen)
    bump = wide.chosen.terms[0]
    assert [stage.before.terms for stage in wide.stages] == [(), (bump,)]  # one picture per step
    assert bump in {t.terms[-1] for t in wide.stages[0].trials}


def test_only_what_has_a_shape_begins_anywhere(found: tuple[Search, Selection]) -> None:
    search, chosen = found
    named = [t for t, term in enumerate(search.terms) if not term.depends_on]
    starts = search.anywhere(chosen.base, named)
    (bump,) = (t for t in named if search.terms[t].effect == "bump")
    assert [t for t, _ in starts] == [bump] * ANYWHERE
    places = np.array([h.z[list(search.rows[bump])] for _, h in starts])
    assert ((places > 0) & (places < 1)).all()
    assert len(np.unique(places)) == places.size
    assert all(h.free == search.free((bump,)) for _, h in starts)


def test_where_it_finds_nothing_more_the_selection_stays(found: tuple[Search, Selection]) -> None:
    search, chosen = found
    search.banned |= {t for t, term in enumerate(search.terms) if term.effect == "bump"}
    again = widely(search, chosen)
    assert again is chosen


def test_a_model_that_runs_away_is_far_and_a_channel_without_errors_ahead_says_nothing(
    found: tuple[Search, Selection],
) -> None:
    search, chosen = found
    windows = search.plan.windows
    innovation, ahead = np.zeros(windows.y.shape), np.zeros(windows.y.shape)
    ahead[..., 1] = np.nan

    def shown(*_: object) -> SimpleNamespace:
        return SimpleNamespace(track=SimpleNamespace(innovation=innovation), ahead=ahead)

    assert not unwrap(far)(search, shown, chosen.chosen)
    innovation[0, -1, 0] = np.nan
    assert unwrap(far)(search, shown, chosen.chosen)
    innovation[0, -1, 0], ahead[..., 0] = 0.0, 1.0
    assert unwrap(far)(search, shown, chosen.chosen)
    n_p, n_r, _ = search.plan.coordinates.sizes
    for rates, expected in ((1.1 * QUIET, True), (0.9 * QUIET, False)):  # an unstable state: far, and nothing missing
        z = chosen.chosen.optimum.z.copy()
        level = np.array(Q_BOUNDS)
        z[n_p + n_r : -1] = np.log(rates / level[0]) / np.log(level[1] / level[0])
        trial = chosen.chosen._replace(optimum=chosen.chosen.optimum._replace(z=z))
        assert unwrap(far)(search, shown, trial) == expected
