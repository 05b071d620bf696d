"""When the fits of a batch end: what crawls along a valley makes room."""

import numpy as np
import pytest
from linear_plant import LOAD, model, recording

from simpel_cli.filtering.likelihood import fit
from simpel_cli.filtering.likelihood.fit import MOST, ROUND, SLOW, Fitter, Hypothesis
from simpel_cli.filtering.likelihood.steps import Course
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


@pytest.mark.parametrize(("slope", "rounds"), [(0.0, 1), (50.0, 2), (np.inf, 1)])
def test_a_fit_that_ends_where_a_newton_step_promises_much_goes_on_once(
    slope: float, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the damping of refused steps made it promise nothing; not where the likelihood is not finite."""
    plan = setup(model(), recording(), (), [LOAD], 2)
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, width=len(plan.start))
    begun = []

    def advanced(self: Fitter, state: Course, most: int, chunk: np.ndarray) -> list[np.ndarray]:
        begun.append(
            (state.damping[chunk].copy(), (state.trial - state.part)[chunk].copy(), state.rejected[chunk].copy())
        )
        own = Course(*(np.asarray(a)[chunk] for a in state))
        finite = bool(np.isfinite(slope))
        gradient = np.full(own.gradient.shape, slope if finite else 0.0)
        after = own._replace(
            loss=np.full(len(chunk), 100.0 if finite else np.inf), gradient=gradient,
            iteration=own.iteration + ROUND, rejected=np.full(len(chunk), 6), done=np.full(len(chunk), True),
            damping=np.full(len(chunk), 1e3),
        )  # fmt: skip
        return list(after)

    monkeypatch.setattr(fit.Fitter, "_advanced", advanced)
    weight = np.ones(len(plan.windows.episode))
    (found,) = fitter([Hypothesis(plan.start, (0, len(plan.start) - 2), weight)])
    assert len(begun) == rounds
    assert found.iterations == rounds * ROUND
    damping, away, rejected = begun[-1]
    assert damping < 1
    assert not away.any()
    assert rejected == 0
