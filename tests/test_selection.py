"""What a search makes of fits, with fits that are made up."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from simpel_cli.discovery.fit import Fitter, Lane, Optimum
from simpel_cli.discovery.search import QUIETER, Trial
from tests.test_twins import searched


class MadeUp:
    """Fits that go astray unless they begin beside the smaller model."""

    width = 12

    def __init__(self, row: int, neutral: float) -> None:
        self.row, self.neutral, self.far = row, neutral, 0

    def __call__(self, lanes: Sequence[Lane], most: int = 0) -> list[Optimum]:
        found = []
        for lane in lanes:
            far = abs(lane.z[self.row] - self.neutral) > 0.02
            self.far += far and most == 0
            eye, d = np.eye(len(lane.free)), len(lane.free)
            loss = 500.0 if far else 80.0
            found.append(Optimum(lane.z, lane.free, loss, -loss, np.ones(d), 1e3 * eye, np.full(d, 0.5), eye, 1, True))
        return found


def test_a_fit_that_is_worse_than_the_model_it_contains_begins_again_beside_it() -> None:
    search: Any = searched("b")
    t = next(i for i, term in enumerate(search.terms) if term.effect == "drag")
    fitter = MadeUp(search.rows[t][0], search.plan.start[search.rows[t][0]])
    search.fitter = fitter
    z, free = search.plan.start, search.free(())
    eye = np.eye(len(free))
    before = Trial((), Optimum(z, free, 100.0, -100.0, np.zeros(len(free)), eye, z[list(free)], eye, 1, True))
    (trial,) = search.add(before, [t]).trials
    assert fitter.far > 0  # the start of the effect was tried first
    assert trial.optimum.loss == 80.0
    assert isinstance(searched("b").fitter, Fitter)


def test_a_candidate_starts_with_noise_that_a_wrong_size_can_hide_in() -> None:
    search: Any = searched("b")
    n_p, n_r, n_q = search.plan.coordinates.sizes
    z = search.plan.start.copy()
    z[n_p : n_p + n_r + n_q] = 0.0  # a filter that is sure of everything
    for lane in (*search.lanes((0,), 0, z), search.beside(Trial((), search.base().optimum._replace(z=z)), 0)):
        r, q = lane.z[n_p : n_p + n_r], lane.z[n_p + n_r : n_p + n_r + n_q]
        np.testing.assert_array_equal(r, search.plan.start[n_p : n_p + n_r])
        assert (q >= search.plan.start[n_p + n_r : n_p + n_r + n_q] - QUIETER).all()
    loud = z.copy()
    loud[n_p : n_p + n_r + n_q] = 0.95
    np.testing.assert_array_equal(search.loud(loud), loud)


def test_what_did_harm_is_no_candidate() -> None:
    search: Any = searched("b")
    first, *others = search.candidates(())
    search.banned.add(first)
    assert search.candidates(()) == others
