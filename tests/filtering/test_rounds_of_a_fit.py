"""When the fits of a batch end: what crawls along a valley makes room."""

import numpy as np
import pytest
from linear_plant import LOAD, model, recording

from simpel_cli.filtering.likelihood import fit
from simpel_cli.filtering.likelihood.fit import BEHIND, LAPS, MOST, ROUND, SLOW, Course, Fitter, Hypothesis
from simpel_cli.filtering.setup import setup


@pytest.mark.parametrize(
    ("gain", "rejected", "iterations"),
    [(2 * SLOW, 0, MOST), (SLOW / 2, 0, 2 * ROUND), (SLOW / 2, 1, MOST), (0.0, 3, MOST)],
)
def test_a_round_that_gains_little_ends_a_fit_unless_a_step_was_just_refused(
    gain: float, rejected: int, iterations: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = setup(model(), recording(), (), [LOAD], 2)
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, width=len(plan.start))

    def advanced(self: Fitter, state: Course, most: int, chunk: np.ndarray) -> list[np.ndarray]:
        loss = np.where(np.isfinite(state.loss[chunk]), state.loss[chunk] - gain, 100.0)
        after = state._replace(
            loss=loss, iteration=state.iteration[chunk] + ROUND, rejected=np.full(len(chunk), rejected)
        )
        return [np.asarray(a) if len(a) == len(chunk) else np.asarray(a)[chunk] for a in after]

    monkeypatch.setattr(fit.Fitter, "_advanced", advanced)
    weight = np.ones(len(plan.windows.episode))
    (found,) = fitter([Hypothesis(plan.start, (0, len(plan.start) - 2), weight)])
    assert found.iterations == iterations


LEADS = 3 * SLOW  # what the leader of a race gains in every round


@pytest.mark.parametrize(
    ("behind", "gain", "rejected", "racing", "iterations"),
    [
        (2 * BEHIND, LEADS, 0, (False, False), 2 * ROUND),
        (2 * BEHIND, 3 * BEHIND / LAPS, 0, (False, False), MOST),
        (0.8 * BEHIND, LEADS, 0, (False, False), MOST),
        (2 * BEHIND, LEADS, 1, (False, False), MOST),
        (2 * BEHIND, LEADS, 0, None, MOST),
        (2 * BEHIND, LEADS, 0, (False, True), MOST),  # of another kind
    ],
)
def test_what_cannot_catch_up_leaves_a_race(
    behind: float,
    gain: float,
    rejected: int,
    racing: tuple[bool, bool] | None,
    iterations: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = setup(model(), recording(), (), [LOAD], 2)
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, width=len(plan.start))

    def advanced(self: Fitter, state: Course, most: int, chunk: np.ndarray) -> list[np.ndarray]:
        follows = state.z[chunk, 0] > 0
        rounds = state.iteration[chunk] / ROUND + 1
        loss = 100.0 + np.where(follows, behind + gain - gain * rounds, -LEADS * rounds)
        refused = np.where(follows, rejected, 0)
        after = state._replace(loss=loss, iteration=state.iteration[chunk] + ROUND, rejected=refused)
        return [np.asarray(a) if len(a) == len(chunk) else np.asarray(a)[chunk] for a in after]

    monkeypatch.setattr(fit.Fitter, "_advanced", advanced)
    weight, free = np.ones(len(plan.windows.episode)), (0, len(plan.start) - 2)
    starts = [np.full(len(plan.start), place) for place in (0.0, 0.5)]
    found = fitter([Hypothesis(z, free, weight) for z in starts], racing=racing)
    assert [optimum.iterations for optimum in found] == [MOST, iterations]
