"""Autocorrelation and cumulated periodogram against closed forms, and how often white signals leave their bands."""

import numpy as np
import pytest

from simpel_cli.filtering.likelihood.whiteness import autocorrelation, cumulated_periodogram, memory


def test_autocorrelation_of_an_autoregression() -> None:
    """r_l of e[k] = a e[k-1] + n is a^l, whether in one piece or in many."""
    random = np.random.default_rng(0)
    pieces = []
    for _ in range(40):
        e = np.zeros(500)
        for k in range(1, 500):
            e[k] = 0.6 * e[k - 1] + random.normal()
        pieces.append(e)
    found = autocorrelation(pieces, lags=4)
    assert found is not None
    np.testing.assert_allclose(found.value, 0.6 ** np.arange(1, 5), atol=0.02)
    assert found.band == pytest.approx(1.96 / np.sqrt(40 * 500), rel=1e-3)


def test_missing_rows_do_not_count() -> None:
    random = np.random.default_rng(1)
    e = random.normal(size=4000)
    shifted = e.copy()
    shifted[1::2] = np.nan  # every pair at an odd lag is gone
    found = autocorrelation([shifted], lags=3)
    assert found is not None
    assert found.value[0] == found.value[2] == 0
    assert found.band == pytest.approx(1.96 / np.sqrt(2000), rel=1e-3)


def test_a_sine_rises_at_its_frequency() -> None:
    found = cumulated_periodogram([np.sin(2 * np.pi * 0.2 * np.arange(100))])
    assert found is not None
    np.testing.assert_allclose(np.interp([0.18, 0.21], found.frequency, found.value), [0, 1], atol=1e-9)


def test_white_signals_stay_in_the_bands() -> None:
    """The bands are asymptotic: 5 % of white signals leave them, somewhat fewer where rows are few."""
    random = np.random.default_rng(2)
    left, beyond = [], []
    for _ in range(400):
        pieces = [random.normal(size=150) for _ in range(3)]
        acf, cumulated = autocorrelation(pieces, lags=10), cumulated_periodogram(pieces)
        assert acf is not None
        assert cumulated is not None
        left.append(np.abs(acf.value) > acf.band)
        beyond.append(np.max(np.abs(cumulated.value - 2 * cumulated.frequency)) > cumulated.band)
    assert np.mean(left) == pytest.approx(0.05, abs=0.015)
    assert 0.01 < np.mean(beyond) < 0.08


@pytest.mark.parametrize("pieces", [[], [np.full(20, np.nan)], [np.zeros(20)], [np.ones(2)]])
def test_too_little_says_nothing(pieces: list[np.ndarray]) -> None:
    assert autocorrelation(pieces) is None
    assert cumulated_periodogram(pieces) is None


def test_errors_that_follow_each_other_are_told_from_white_ones() -> None:
    random = np.random.default_rng(0)
    white = random.normal(size=(5, 60))
    slow = np.sin(0.3 * np.arange(60))[None] + 0.5 * white
    assert memory(white) is None
    assert memory(-np.diff(white, axis=1)) is None  # of a differentiated column: the next error is opposite
    assert memory(slow) == (pytest.approx(0.6, abs=0.15), 1)
    told = memory(np.sin(2.2 * np.arange(60))[None] + 0.8 * white)  # errors of a filter that cannot follow a fast swing
    assert told is not None
    assert abs(told[0]) > 0.2
    assert told[1] > 1
    white[:, ::7] = np.nan
    assert memory(white) is None
