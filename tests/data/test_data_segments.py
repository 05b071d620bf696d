"""Rows know the user's episode, the segment of it and their time."""

from pathlib import Path

import numpy as np
import pytest

from simpel_cli.data import Episode, Measurements, origins, places, read, transitions
from simulators.model import Declared

DECAY = Declared(name="decay", dt=1.0, states={"x": {"range": [0, 1000]}}, dynamics={"x": "-x"}).model()


def named(*names: str) -> list[Episode]:
    return [Episode(n, np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 0)), np.zeros((3, 0))) for n in names]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a", "a/2", "b"], [("a", 1), ("a", 2), ("b", 1)]),
        (["a/2", "a/3"], [("a", 2), ("a", 3)]),  # the first segment was too short to be kept
        (["a/1", "a/2"], [("a/1", 1), ("a/2", 1)]),  # the user's own names
        (["day/0", "day/2", "day/2/2"], [("day/0", 1), ("day/2", 1), ("day/2", 2)]),
        (["2024/02", "a/b", "/"], [("2024/02", 1), ("a/b", 1), ("/", 1)]),
    ],
)
def test_origins(names: list[str], expected: list[tuple[str, int]]) -> None:
    assert list(origins(named(*names)).items()) == list(zip(names, expected, strict=True))


def test_rows_that_are_transitions_are_never_segments() -> None:
    pairs = [episode._replace(next_states=episode.states) for episode in named("a", "a/2")]
    assert origins(pairs) == {"a": ("a", 1), "a/2": ("a/2", 1)}


def test_places_of_a_cut_recording(tmp_path: Path) -> None:
    """Times do not start at 0, one row of `up` is missing, and `by: time` cuts both episodes."""
    rows = [("up", 100 + i, i) for i in range(12) if i != 3] + [("down", 7 + i, 500 - i) for i in range(8)]
    (tmp_path / "d.csv").write_text("run,t,x\n" + "".join(f"{r},{t},{x}\n" for r, t, x in rows))
    split = {"test_fraction": 0.5, "by": "time"}
    recording = read(Measurements("d.csv", time="t", episode="run", split=split), DECAY, tmp_path, 0)
    pairs = transitions(recording.test, 0)
    of = origins((*recording.train, *recording.test))
    where = places(recording.test, of, pairs.episode, pairs.row)
    assert list(dict.fromkeys(zip(where.episode, where.segment, strict=True))) == [("up", 3), ("down", 2)]
    at = {(run, float(x)): t for run, t, x in rows}
    found = [at[run, x] for run, x in zip(where.episode, pairs.states[:, 0], strict=True)]
    np.testing.assert_array_equal(where.time, found)
    np.testing.assert_array_equal(where.row, pairs.row)
