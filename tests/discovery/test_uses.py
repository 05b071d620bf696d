"""The last calibration is for the use that is named."""

from io import StringIO
from typing import Any

import numpy as np
import pytest
from test_ranges import DRAG, cart, measured, searched

from simpel_cli.config.build import build
from simpel_cli.discovery import last_calibration as last
from simpel_cli.discovery.ground import Ground
from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.sets.selection import Selection
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.discovery.search.uses import (
    FREE_RUN,
    ONE_STEP,
    calibrated_for,
    in_words,
    suited,
    windows_for,
)
from simpel_cli.discovery.watch import Watch
from simpel_cli.errors import ConfigError
from simpel_cli.filtering.errors_ahead import Assessor, rmse
from simpel_cli.filtering.measurements.cleaning import Cleaned
from simpel_cli.filtering.setup import whole_windows as held_out
from simpel_cli.runs.console import Terminal


@pytest.mark.parametrize("use", [FREE_RUN, 1.0])
def test_a_wrong_model_simulates_better_when_it_is_calibrated_for_that(use: Any) -> None:
    """The simulator has no drag: what predicts the next row best drifts away in a free run."""
    recording = measured(1.2, k=0.3)
    search = searched(recording, [])
    base, assessor = search.base(), Assessor(search.plan, 10)
    windows = held_out(search.plan, recording.train, ())
    suited = calibrated_for(search, assessor, base, windows, use)
    before, after = (assessor(t.optimum.z, windows) for t in (base, suited))
    far = "free" if use == FREE_RUN else "ahead"
    first, second = (rmse(getattr(a, far)) for a in (before, after))
    assert np.prod(second) < (0.95 if use == FREE_RUN else 0.99) * np.prod(first)
    noise = list(search.noise)
    np.testing.assert_array_equal(suited.optimum.z[noise], base.optimum.z[noise])
    assert suited.optimum.log_evidence == base.optimum.log_evidence
    i = suited.optimum.free.index(0)
    assert suited.optimum.centre[i] == suited.optimum.z[0]
    assert 0 < suited.optimum.covariance[i, i] < 1 / 12
    assert calibrated_for(search, assessor, base, windows, ONE_STEP) is base


def test_the_right_model_stays_where_it_is() -> None:
    recording = measured(1.2)
    search = searched(recording, [])
    base, assessor = search.base(), Assessor(search.plan, 10)
    windows = held_out(search.plan, recording.train, ())
    suited = calibrated_for(search, assessor, base, windows, FREE_RUN)
    assert suited.optimum.z[0] == pytest.approx(base.optimum.z[0], abs=2e-3)


@pytest.mark.parametrize("given", ["free_run", "one_step", 0.5, 2, None])
def test_the_key_is_for(given: Any) -> None:
    assert build({"for": given}, "discovery").for_ == given
    assert Discovery().for_ is None


@pytest.mark.parametrize("given", ["free", "0.5 s", 0, -1.0, [1]])
def test_a_wrong_use_is_told_what_is_allowed(given: Any) -> None:
    with pytest.raises(ConfigError, match=r"discovery\.for"):
        build({"for": given}, "discovery")
    with pytest.raises(ConfigError, match=r"discovery\.fo: .*discovery\.for\?"):
        build({"fo": given}, "discovery")


def test_the_largest_motion_does_not_decide_for_all() -> None:
    """One episode of four has errors that dwarf the others': these are simulated no worse for it."""
    recording = measured(1.2, k=0.05)
    first = recording.train[0]
    far = first._replace(states=first.states - 0.4 * np.maximum(first.time[:, None] - 1, 0) ** 2)
    rest = (*recording.train[1:], *recording.test)
    search = searched(recording._replace(train=(far, *rest)), [])
    base, assessor = search.base(), Assessor(search.plan, 10)
    taken = suited(search, assessor, base, held_out(search.plan, (far, *rest), ()), FREE_RUN)
    others = held_out(search.plan, rest, ())
    before, after = (np.prod(rmse(assessor(t.optimum.z, others).free)) for t in (base, taken))
    assert after <= 1.02 * before


def test_a_model_that_simulates_better_on_unseen_episodes_is_taken() -> None:
    recording = measured(1.2, k=0.3)
    search = searched(recording, [])
    base, assessor = search.base(), Assessor(search.plan, 10)
    windows = held_out(search.plan, recording.train, ())
    assert suited(search, assessor, base, windows, FREE_RUN) is not base
    assert suited(search, assessor, base, windows, ONE_STEP) is base


def test_windows_are_long_against_what_the_model_is_for() -> None:
    """Of the search's windows, a quarter of an episode each, none may reach so far; one that is too short is said to be."""
    recording = measured(1.2)
    plan, rows = searched(recording, []).plan, len(recording.train[0].time)
    dt = plan.augmented.model.dt
    far = (rows - 20) * dt
    whole = windows_for(plan, recording, far)
    assert whole.y.shape[1] == rows
    assert np.isfinite(Assessor(plan, rows - 20)(plan.start, whole).ahead).any()
    assert (
        in_words(far, whole, dt, moved=False)
        == f"calibrated for {far:g} s ahead: what the innovations say does as well"
    )
    too_far = (rows + 1) * dt
    words = in_words(too_far, windows_for(plan, recording, too_far), dt, moved=False)
    assert words == f"not calibrated for {too_far:g} s ahead: no training episode is so long"


@pytest.mark.parametrize("late", [False, True])
def test_out_of_time_models_are_calibrated_for_their_use_without_asking_other_episodes(
    late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, lines = measured(1.2, k=0.3), StringIO()
    search = searched(recording, [])
    base, budget = search.base(), Budget(1.0 if late else None, iter([0.0, *[2.0] * 99]).__next__)
    terminal = Terminal(quiet=True)
    monkeypatch.setattr(terminal, "line", lambda text, *_: lines.write(f"{text}\n"))
    asked = list[Trial]()

    def asking(search: Search, assessor: Assessor, trial: Trial, *given: Any) -> Trial:
        asked.append(trial)
        return suited(search, assessor, trial, *given)

    monkeypatch.setattr(last, "suited", asking)
    ground = Ground(cart(), Cleaned(recording, (), {}), Discovery(for_=FREE_RUN), (), terminal, budget, Watch(budget))
    found = last.last_calibration(
        ground, cart(), search, Selection(base, base, (base,), (), (), (), None), Assessor(search.plan, 10), {}
    )
    assert len(asked) == (0 if late else 2)
    assert budget.left_out == ([last.LATE] if late else [])
    assert found.selection.chosen is found.selection.path[-1]
    assert found.selection.chosen.optimum.z[0] != base.optimum.z[0]  # without a drag it simulates better elsewhere
    assert lines.getvalue() == "calibrated for free_run\n"
    np.testing.assert_allclose(found.for_use(base).optimum.z, found.selection.chosen.optimum.z)


@pytest.mark.parametrize(("left", "stays"), [(None, True), (1e6, False), (1.0, True)])
def test_a_range_that_is_wider_for_what_is_left_unexplained_alone_is_no_finding(
    left: float | None, stays: bool
) -> None:
    """Data with a gain beyond the range: with much more left than that is worth, the range that was given stands."""
    recording, terminal = measured(2.4), Terminal(quiet=True)
    search = searched(recording, [DRAG], cart(0.8, 3.6))
    base, budget = search.base(), Budget(None)
    remainder = None if left is None else (search.terms[0], left)
    selection = Selection(base, base, (base,), (), (), (), remainder)
    ground = Ground(cart(), Cleaned(recording, (), {}), Discovery(), (), terminal, budget, Watch(budget))
    found = last.last_calibration(ground, cart(), search, selection, Assessor(search.plan, 10), {})
    row = [q.name for q in search.plan.augmented.params].index("b")
    before, after = (
        search.plan.coordinates.value(row, float(t.optimum.z[row]))
        for t in (found.selection.base, found.selection.chosen)
    )
    assert before == pytest.approx(1.8, abs=0.02)
    assert after == pytest.approx(2.4 if stays else 1.8, abs=0.02)
    assert (found.wider > 100) == stays
    assert bool(search.declared) == stays
    assert found.selection.path == (found.selection.chosen,)
