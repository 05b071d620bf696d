"""How much data, in the user's words."""

import numpy as np
import pytest

from simpel_cli.data import Episode, Recording
from simpel_cli.data.summary import held_out_summary, split_summary


def part(*names: str, states: int = 1, pairs: bool = False) -> tuple[Episode, ...]:
    values = np.zeros((5, states))
    empty = np.zeros((5, 0))
    return tuple(Episode(n, np.arange(5.0), values, empty, empty, values if pairs else None) for n in names)


def recording(train: tuple[Episode, ...], test: tuple[Episode, ...]) -> Recording:
    return Recording(train, test, (), {}, (), (), ())


@pytest.mark.parametrize(
    ("train", "test", "split", "judged"),
    [
        (part("0", "1"), part("2"), "2 train / 1 test episodes", "1 episode"),
        (part("0", "0/2", "1"), part("2", "2/2"), "2 train / 1 test episodes in 3 / 2 segments", "1 episode in 2 segments"),
        (part("0", "1"), part("0/2", "1/2"), "2 train / 2 test episodes (parts of the same)", "2 episodes"),
        (part("0", "0/3", states=0), part("0/2", states=0), "10 train / 5 test rows", "5 rows"),
        (part("a", "b", states=0), part("c", states=0), "2 train / 1 test episodes", "1 episode"),
        (part("train", pairs=True), part("test", pairs=True), "5 train / 5 test rows", "5 rows"),
        (part("a", "b", pairs=True), part("c", pairs=True), "2 train / 1 test episodes", "1 episode"),
    ],
)  # fmt: skip
def test_extent(train: tuple[Episode, ...], test: tuple[Episode, ...], split: str, judged: str) -> None:
    assert split_summary(recording(train, test)) == split
    assert held_out_summary(recording(train, test)) == judged
