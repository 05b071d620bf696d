"""A latency that the data give by a range: the best one, its interval, on the same readings throughout."""

from collections.abc import Mapping

import numpy as np
import pytest

from simpel_cli.data.recording import Episode, Recording
from simpel_cli.discovery.latency import estimated, in_words, same_readings, sentence_of


@pytest.mark.parametrize(("true", "at_end"), [(0.0371, False), (0.2, True)])
def test_the_best_of_a_curve(true: float, at_end: bool) -> None:
    sd, asked = 0.004, []

    def evidence(at: Mapping[str, float]) -> float:
        asked.append(at["y"])
        return -0.5 * ((at["y"] - true) / sd) ** 2

    found = estimated(evidence, {"y": (0.0, 0.1)}, 0.05)["y"]
    assert found.at_end is at_end
    assert ("wider" in in_words({"y": found})) is at_end
    assert found.low <= found.value <= found.high
    assert f"y is recorded {found.value:.3g} s late" in sentence_of({"y": found})
    assert found.gain > 5
    assert len(asked) < 25
    if not at_end:
        assert found.value == pytest.approx(true, abs=1e-6)
        assert found.high - found.low == pytest.approx(2 * 1.645 * sd, rel=1e-3)
    else:
        assert found.value == pytest.approx(0.1)


def test_two_that_depend_on_each_other() -> None:
    def evidence(at: Mapping[str, float]) -> float:
        a, b = at["y"] - 0.03, at["z"] - 0.06
        return float(-(a**2 + b**2 + a * b) / 0.005**2)

    found = estimated(evidence, {"y": (0.0, 0.1), "z": (0.0, 0.1)}, 0.05)
    assert found["y"].value == pytest.approx(0.03, abs=0.01)
    assert found["z"].value == pytest.approx(0.06, abs=0.01)


def test_the_same_readings_count_at_every_latency() -> None:
    """Stamps 0, 1, ...: with a latency of 1.5 rows a reading is half a row early in the row before the one before."""
    time = np.arange(10.0)
    kept = []
    for late, shift in ((0.0, 0), (0.5, 0), (0.0, 1), (0.5, 1)):
        latency = shift + late
        values = np.full((10, 1), np.nan)
        stamps = np.arange(int(np.ceil(latency)), 10)
        rows = np.ceil(stamps - latency).astype(int)
        values[rows, 0] = stamps
        early = np.where(np.isfinite(values), late, 0.0)
        episode = Episode("e", time, values, np.zeros((10, 0)), np.zeros((10, 0)), late=early if late else None)
        recording = Recording((episode,), (), (), {}, (), (), ())
        found = same_readings(recording, {"s": 0}, {"s": latency}, {"s": 2.0}, 1.0).train[0].states[:, 0]
        kept.append(sorted(found[np.isfinite(found)]))
    assert all(own == [2, 3, 4, 5, 6, 7, 8, 9] for own in kept)
