"""Windows begin, in a level that nothing measures, where the measured one says; its rates have the model's scale."""

from dataclasses import replace

import numpy as np
import pytest

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.filtering.errors_ahead import FIRST as FEWEST
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.initial_states import begun, moved
from simpel_cli.filtering.measurements.windows import LONGEST_TEST, padded
from simpel_cli.filtering.setup import Setup, setup, whole_windows
from simulators.model import Declared

DT, ROWS, EMPTIES, FIRST = 1.0, 40, 0.3, (20.0, 45.0, 70.0, 95.0)


@pytest.fixture(scope="module")
def plan() -> Setup:
    """Two tanks, of which only the lower one is measured."""
    random = np.random.default_rng(0)
    episodes = []
    for k, first in enumerate(FIRST):
        h, low = np.array([first, 10.0]), []
        for _ in range(ROWS):
            low.append(h[1])
            for _ in range(20):
                out = EMPTIES * np.sqrt(np.maximum(h, 0))
                h = h + DT / 20 * np.array([-out[0], out[0] - out[1]])
        states = np.stack([np.full(ROWS, np.nan), np.array(low) + 0.02 * random.normal(size=ROWS)], axis=1)
        episodes.append(Episode(f"{k}", np.arange(ROWS) * DT, states, np.zeros((ROWS, 0)), np.zeros((ROWS, 0))))
    model = Declared(
        "tanks", dt=DT, states={n: {"unit": "cm", "range": [0, 120]} for n in ("h_1", "h_2")},
        parameters={"c": {"unit": "cm^0.5/s", "range": [0.2, 0.45]}},
        dynamics={"h_1": "-c*sqrt(max(h_1, 0))", "h_2": "c*sqrt(max(h_1, 0)) - c*sqrt(max(h_2, 0))"},
    ).model()  # fmt: skip
    data = Recording(tuple(episodes), (), (), {"h_2": 0.02}, ("h_1",), (Check("c", True, ""),), ())
    return setup(model, data, (), [], 2)


def test_a_smoother_puts_the_hidden_level_near_where_it_was(plan: Setup) -> None:
    before = plan.windows
    after = begun(Assessor(plan, 5), plan.start, before)
    truth = np.array(FIRST)[after.episode]
    whole = after.begin == 0
    off = [np.abs(w.start[whole, 0] - truth[whole]) for w in (before, after)]
    assert off[1].mean() < 0.5 * off[0].mean()
    np.testing.assert_array_equal(after.start[:, 1], before.start[:, 1])  # what is measured stays
    assert (after.spread[:, 0] <= before.spread[:, 0]).all()
    assert (after.spread[:, 0] >= 0.15 * before.spread[:, 0]).all()


def test_better_parameters_put_it_elsewhere(plan: Setup) -> None:
    """So the search calibrates again: a start of the wrong parameters looked like a wrong scale of the sensor."""
    assessor, truth = Assessor(plan, 5), np.array(FIRST)
    z = plan.start.copy()
    z[0] = plan.coordinates.unit(0, EMPTIES)
    first = begun(assessor, z, plan.windows)
    z[0] = plan.coordinates.unit(0, 0.24)
    wrong = begun(assessor, z, plan.windows)
    assert moved(first, wrong)
    assert not moved(first, first)
    whole = first.begin == 0
    off = [np.abs(w.start[whole, 0] - truth[w.episode[whole]]).mean() for w in (first, wrong)]
    assert off[0] < 0.5 * off[1]


def test_the_rates_of_a_hidden_level_have_the_scale_of_the_model(plan: Setup) -> None:
    assert 1.0 < plan.scales.rate["h_1"] < 0.325 * np.sqrt(120)  # c sqrt(h), not half of the range per second


def test_of_a_free_run_only_its_first_rows_are_seen(plan: Setup) -> None:
    """Where a hidden level begins and where the run begins are told by the first rows; what follows could be anything."""
    assessor, rows = Assessor(plan, 5, 8), np.arange(plan.windows.y.shape[1])
    after = plan.windows._replace(y=np.where(rows[:, None] < 8, plan.windows.y, 3.0))
    first, other = (begun(assessor, plan.start, windows, 8) for windows in (plan.windows, after))
    np.testing.assert_array_equal(first.start, other.start)
    assert np.any(begun(assessor, plan.start, after).start != other.start)
    found, changed = (assessor(plan.start, windows) for windows in (first, other))
    np.testing.assert_allclose(found.free_mean, changed.free_mean, rtol=1e-9)
    assert found.first == 8
    assert np.isnan(found.free[:, :8]).all()
    assert np.isfinite(found.free[:, 8:]).all()
    alone = assessor.free_runs(plan.start[None], first)[0]
    np.testing.assert_allclose(alone[:, 8:], found.free[:, 8:], rtol=1e-6, atol=1e-9)
    assert assessor.of(plan, 3).first == 8
    long = Assessor(plan, 5, 30)  # of windows of 40 rows a quarter
    assert long.first_of(first) == ROWS // 4 if first.y.shape[1] == ROWS else FEWEST
    assert np.isfinite(long(plan.start, first).free).any()


def test_beside_short_episodes_a_long_one_is_cut(plan: Setup) -> None:
    """Windows are equally long: of one long episode and many short ones most would be padding."""
    assert padded([5000], LONGEST_TEST) == 1
    assert padded([6000] + 20 * [300], LONGEST_TEST) == pytest.approx(21 * 6000 / 12000)

    def of(rows: int) -> Episode:
        return Episode("e", np.arange(rows) * DT, np.full((rows, 2), 10.0), np.zeros((rows, 0)), np.zeros((rows, 0)))

    whole = whole_windows(plan, [of(6000)], (), LONGEST_TEST)
    assert whole.y.shape[:2] == (1, 6000)
    cut = whole_windows(plan, [of(6000), *(of(300) for _ in range(20))], (), LONGEST_TEST)
    assert cut.y.shape[1] < 6000
    assert cut.y.shape[0] * cut.y.shape[1] <= 4.5 * 12000
    assert whole_windows(plan, [of(6000)], ()).y.shape[:2] == (3, 2000)


def test_a_first_value_that_is_missing_is_guessed_like_a_hidden_one(plan: Setup) -> None:
    """Of a measured level: begun in the middle of its range, a filter that linearises a root is far off and sure of it."""
    ok, start = plan.windows.ok.copy(), plan.windows.start.copy()
    first = plan.windows.begin == 0
    ok[first, 0, 0], start[first, 1] = 0.0, 60.0
    gone = plan.windows._replace(ok=ok, start=start)
    assessor = Assessor(plan, 5)
    after = begun(assessor, plan.start, gone)
    assert np.abs(after.start[first, 1] - 10.0).max() < 5.0
    np.testing.assert_array_equal(after.start[~first, 1], gone.start[~first, 1])
    lost, found = (assessor(plan.start, windows).log_likelihood[first].sum() for windows in (gone, after))
    assert found > lost + 10


def test_a_measured_level_may_begin_beyond_its_range(plan: Setup) -> None:
    """A range is what was expected; the value that is missing is guessed from those behind it, wherever they are."""
    high = plan.augmented.model.states[1]
    narrow = replace(plan.augmented.model, states=(plan.augmented.model.states[0], high._replace(high=6.0)))
    small = plan._replace(augmented=plan.augmented._replace(model=narrow))
    ok = plan.windows.ok.copy()
    first = plan.windows.begin == 0
    ok[first, 0, 0] = 0.0
    after = begun(Assessor(small, 5), plan.start, plan.windows._replace(ok=ok))
    assert (after.start[first, 1] > 6.0).any()


def test_whole_windows_begin_as_wide_as_those_of_the_search_did(plan: Setup) -> None:
    """A better guess in the first window says nothing of other windows."""
    close = plan.windows._replace(spread=0.1 * plan.windows.spread)
    episodes = [Episode("e", np.arange(20) * DT, np.full((20, 2), 10.0), np.zeros((20, 0)), np.zeros((20, 0)))]
    whole = whole_windows(plan._replace(windows=close), episodes, ())
    np.testing.assert_array_equal(whole.spread[0], plan.windows.spread[0])
