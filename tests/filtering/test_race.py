"""Which fits of a stage go on, and what a fitter does with those that do not."""

from collections.abc import Sequence

import numpy as np
import pytest
from linear_plant import LOAD, model, recording

from simpel_cli.filtering.likelihood import fit
from simpel_cli.filtering.likelihood.fit import MOST, ROUND, Fitter, Hypothesis, Optimum
from simpel_cli.filtering.likelihood.steps import LEAST_CURVATURE, Course
from simpel_cli.filtering.race import HOPED, MARGIN, PATIENCE, Race, hopeful
from simpel_cli.filtering.setup import setup

CURVED = 100.0


def standing(loss: float, slope: float = 0.0, at: float = 0.5, iterations: int = PATIENCE) -> Optimum:
    """A fit of one unknown, with the slope of its loss there."""
    eye = np.eye(1)
    z = np.array([at])
    return Optimum(z, (0,), loss, -loss, np.array([slope]), CURVED * eye, z, eye, iterations, False)


@pytest.mark.parametrize(("at", "slope", "moves"), [(0.5, 30.0, True), (0.0, -30.0, True), (0.0, 30.0, False)])
def test_a_newton_step_promises_what_a_parabola_falls_by(at: float, slope: float, moves: bool) -> None:
    """With the prior's curvature; not out of the range."""
    expected = slope**2 / (CURVED + LEAST_CURVATURE) / 2 if moves else 0.0
    assert standing(100.0, slope, at).step == pytest.approx(expected)
    assert standing(np.inf).step == np.inf


def test_a_step_is_known_where_a_curvature_is_beyond_rounding() -> None:
    """From a start that is far off one curvature hides the others: no matrix of them can be inverted."""
    big = 1e32 * np.array([[1.0, 1.0], [1.0, 1.0]])
    z = np.full(2, 0.5)
    far = Optimum(z, (0, 1), 10.0, -10.0, np.array([1.0, 1.0]), big, z, np.eye(2), 1, False)
    assert 0.0 <= far.step < 1.0


def test_what_cannot_come_as_far_is_left() -> None:
    step = standing(0.0, 30.0).step
    needed = 100.0
    losses = [needed + MARGIN + HOPED * step + d for d in (-0.1, 0.1)]
    assert hopeful([standing(loss, 30.0) for loss in losses], [needed] * 2) == [True, False]
    assert hopeful([standing(np.inf)], [needed]) == [True]  # nothing is known of it yet
    early = [standing(loss, 30.0, iterations=PATIENCE - 1) for loss in losses]
    assert hopeful(early, [needed] * 2) == [True, True]  # so early a step tells less


def test_fits_are_compared_with_a_share_of_the_best_that_counts() -> None:
    before, best = 1000.0, 800.0
    optima = [standing(best), standing(before - 100.0), standing(before - 20.0), standing(100.0)]
    assert Race(before, 0.5, np.array([True, True, True, False]))(optima) == [True, True, False, True]
    assert Race(before, 0.5, np.zeros(4, bool))(optima) == [True] * 4  # none that counts has gained
    dear = standing(300.0)._replace(log_evidence=-950.0)  # the least loss, not worth its unknowns
    assert Race(before, 0.5, np.ones(2, bool))([dear, standing(before - 100.0)]) == [True, True]
    worse = [standing(before + 100.0), standing(before + 50.0)]
    assert Race(before, 0.5, np.ones(2, bool))(worse) == [False, True]  # the best of them in any case


def test_a_fit_that_is_left_stops_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = setup(model(), recording(), (), [LOAD], 2)
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, width=len(plan.start))

    def advanced(self: Fitter, state: Course, most: int, chunk: np.ndarray) -> list[np.ndarray]:
        loss = np.where(np.isfinite(state.loss[chunk]), state.loss[chunk] - 1.0, 100.0)
        after = state._replace(loss=loss, iteration=state.iteration[chunk] + ROUND)
        return [np.asarray(a) if len(a) == len(chunk) else np.asarray(a)[chunk] for a in after]

    seen: list[int] = []

    def hopes(optima: Sequence[Optimum]) -> list[bool]:
        seen.append(len(optima))
        return [True, False]

    monkeypatch.setattr(fit.Fitter, "_advanced", advanced)
    start = Hypothesis(plan.start, (0, len(plan.start) - 2), np.ones(len(plan.windows.episode)))
    on, off = fitter([start, start], hopes=hopes)
    assert (on.left, off.left) == (False, True)
    assert (on.iterations, off.iterations) == (MOST, ROUND)
    assert set(seen) == {2}  # always all of them: one that was left may have been ahead
    assert not any(o.left for o in fitter([start, start]))
