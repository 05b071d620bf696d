"""The effective number of different particles."""

import numpy as np
import pytest

from simpel_cli.evaluation.diversity import distinct_particles, effective_number
from simpel_cli.evaluation.posterior import CHUNK, Posterior
from simpel_cli.inference.predictive import Predictive


def test_all_alike_are_one_and_all_apart_are_all() -> None:
    assert effective_number(np.ones((7, 5, 2))) == pytest.approx(1.0)
    assert effective_number(20.0 * np.arange(7)[:, None, None] * np.ones((7, 5, 2))) == pytest.approx(7.0)


def test_two_that_are_one_noise_apart_count_as_the_docstring_says_and_a_nan_is_no_number() -> None:
    assert effective_number(np.stack([np.zeros((4, 3)), np.ones((4, 3))])) == pytest.approx(1.64, abs=0.01)
    assert np.isnan(effective_number(np.full((2, 4, 3), np.nan)))


def test_two_groups_are_two_and_a_lonely_one_counts_less() -> None:
    h = np.zeros((8, 3, 1))
    h[4:] = 30.0
    assert effective_number(h) == pytest.approx(2.0)
    h[:] = 0
    h[0] = 30.0
    # entropy of shares 1/8 and 7/8
    assert effective_number(h) == pytest.approx(np.exp(-(np.log(1 / 8) / 8 + 7 / 8 * np.log(7 / 8))))


def test_closer_than_the_noise_is_the_same() -> None:
    rng = np.random.default_rng(0)
    apart = rng.normal(size=(6, 1, 2))

    def posterior(noise: float) -> Posterior:
        def predict(x: np.ndarray) -> Predictive:
            assert len(x) == CHUNK
            return Predictive(apart + np.zeros((6, CHUNK, 2)), np.array([noise, noise]))

        return Posterior(predict, lambda x: x, 6)

    x = rng.normal(size=(40, 3))
    found = [distinct_particles(posterior(noise), x) for noise in (100.0, 1.0, 0.01)]
    assert found[0] == pytest.approx(1.0, abs=0.01)
    assert found[0] < found[1] < found[2]
    assert found[2] == pytest.approx(6.0)
