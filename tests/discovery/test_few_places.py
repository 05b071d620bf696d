"""An effect that gains in a few places is what an outlier is; one that acts gains in many."""

import numpy as np
import pytest

from simpel_cli.discovery.search.gate.few_places import PLACES, REACH, in_few_places

ENOUGH = 20.0


def gains(places: int, each: float, noise: float = 0.0) -> np.ndarray:
    """Gains by row of an effect that acts in some places, each of two rows, of five windows."""
    found = noise * np.random.default_rng(0).normal(size=(5, 60))
    for k in range(places):
        found[k % 5, 10 * (k // 5) + 3 : 10 * (k // 5) + 5] += each / 2
    return found


@pytest.mark.parametrize(("places", "few"), [(1, True), (2, True), (PLACES, True), (PLACES + 1, True), (8, False)])
def test_places_are_counted(places: int, few: bool) -> None:
    assert in_few_places(gains(places, 30.0 / places), ENOUGH) == few


def test_what_is_left_may_be_enough_by_itself() -> None:
    assert not in_few_places(gains(PLACES + 1, 25.0), ENOUGH)


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_chance_in_every_row_does_not_hide_an_effect_that_acts_everywhere(noise: float) -> None:
    """Rows gain and lose more than the effect adds to each: the best of them are as good as the worst are bad."""
    found = noise * np.random.default_rng(1).normal(size=(5, 60))
    found += (25.0 - found.sum()) / found.size
    assert not in_few_places(found, ENOUGH)


def test_a_place_takes_the_rows_with_it_in_which_the_filter_comes_back() -> None:
    found = np.zeros((2, 40))
    found[1, 20 : 20 + REACH + 1] = 10.0
    assert in_few_places(found, ENOUGH)
    assert in_few_places(found[:, ::-1], ENOUGH)
    found[0, :] = 0.5
    assert not in_few_places(found, 15.0)
