"""What is claimed of an effect has to show in the errors."""

import numpy as np
import pytest

from simpel_cli.discovery.search.share import explained

NOISE = np.array([0.1, 1.0])


@pytest.mark.parametrize(
    ("before", "after", "share", "near", "left", "enough"),
    [
        ([10, 90], [0.1, 1.1], 1.0, True, True, True),
        ([10, 90], [5, 45], 0.75, False, True, True),
        ([10, 90], [9, 81], 0.19, False, True, False),
        ([10, 90], [9, 81], 0.19, False, False, True),  # what is left is white: it is no model error
        ([0.342, 3.42], [0.343, 3.43], -0.006, False, False, False),
        ([10, 1.1], [1, 1.2], 0.99, False, True, True),  # a quantity at its noise says nothing
        ([0.2, 1.1], [0.15, 1.2], float("nan"), True, True, True),
        ([0.2, 1.1], [0.4, 1.2], float("nan"), False, True, True),  # nothing was beyond the noise
    ],
)
def test_share(before: list, after: list, share: float, near: bool, left: bool, enough: bool) -> None:
    found = explained(np.array(before, float), np.array(after, float), NOISE)
    assert found.share == pytest.approx(share, abs=0.02, nan_ok=True)
    assert found.near is near
    assert found.enough(left=left) is enough


def test_the_worst_quantity_is_named_and_unmeasured_ones_are_not() -> None:
    found = explained(np.array([1.0, 9.0, np.nan]), np.array([0.9, 8.0, np.nan]), np.array([0.1, 1.0, 1.0]))
    assert found[2:] == (0, pytest.approx(9.0))
    assert explained(np.array([np.nan]), np.array([np.nan]), np.array([1.0])).near
