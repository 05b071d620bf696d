"""When the fits of a batch end: what crawls along a valley makes room."""

import numpy as np
import pytest
from linear_plant import LOAD, model, recording

from simpel_cli.filtering.likelihood import fit
from simpel_cli.filtering.likelihood.fit import MOST, ROUND, SLOW, Course, Fitter, Hypothesis
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
