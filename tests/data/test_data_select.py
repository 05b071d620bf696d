"""Splits without leaks and nested choices."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simpel_cli.data import Measurements, Recording, read, select, transitions
from simpel_cli.errors import DataError
from simulators.model import Declared

DECAY = Declared(name="decay", dt=1.0, states={"x": {"range": [0, 1000]}}, dynamics={"x": "-x"}).model()


def read_rows(folder: Path, split_of: Any = None, episodes: int = 8, seed: int = 0, **keys: Any) -> Recording:
    rows = 10
    lines = ["run,t,x,part"]
    for run in range(episodes):
        lines += [f"{run},{i},{100 * run + i},{split_of(run, i) if split_of else ''}" for i in range(rows)]
    (folder / "d.csv").write_text("\n".join(lines))
    return read(Measurements("d.csv", **({"time": "t", "episode": "run"} | keys)), DECAY, folder, seed)


def values(recording: Recording) -> tuple[set[float], set[float]]:
    train, test = (
        {float(x) for episode in part for x in episode.states[:, 0]} for part in (recording.train, recording.test)
    )
    return train, test


def test_by_episode_keeps_episodes_whole_and_depends_on_the_seed(tmp_path: Path) -> None:
    chosen = set()
    for seed in range(5):
        recording = read_rows(tmp_path, seed=seed)
        train, test = values(recording)
        assert not train & test
        assert len(train | test) == 80
        assert len(recording.test) == 2
        assert {len(e.time) for e in (*recording.train, *recording.test)} == {10}
        chosen.add(tuple(e.name for e in recording.test))
    assert len(chosen) > 1
    assert values(read_rows(tmp_path, seed=3)) == values(read_rows(tmp_path, seed=3))


def test_the_datas_own_seed_wins(tmp_path: Path) -> None:
    assert len({tuple(e.name for e in read_rows(tmp_path, seed=s).test) for s in range(5)}) > 1
    config = Measurements("d.csv", time="t", episode="run", seed=7)
    assert len({tuple(e.name for e in read(config, DECAY, tmp_path, s).test) for s in range(5)}) == 1


def test_by_time_takes_the_end_and_no_transition_crosses(tmp_path: Path) -> None:
    recording = read_rows(tmp_path, episodes=2, split={"test_fraction": 0.3, "by": "time"})
    train, test = values(recording)
    assert train == {100 * e + i for e in range(2) for i in range(7)}
    assert test == {100 * e + i for e in range(2) for i in range(7, 10)}
    assert len(transitions(recording.train, 0).row) == 2 * 6
    assert len(transitions(recording.test, 1).row) == 2 * 1


def test_by_column_leaves_other_values_out_and_counts_them(tmp_path: Path) -> None:
    parts = ["train", "train", "valid", "test"]
    recording = read_rows(tmp_path, lambda run, _: parts[run], episodes=4, split={"column": "part"})
    assert [e.name for e in recording.train] == ["0", "1"]
    assert [e.name for e in recording.test] == ["3"]
    (check,) = [c for c in recording.checks if c.name == "split"]
    assert "10 rows marked 'valid' left out" in check.detail


def test_a_split_inside_an_episode_may_cut_it_once_but_not_alternate(tmp_path: Path) -> None:
    recording = read_rows(tmp_path, lambda _, i: "train" if i < 6 else "test", split={"column": "part"})
    assert {len(e.time) for e in recording.train} == {6}
    with pytest.raises(DataError, match=r"'part' changes 9 times within episode 0.*both trained on and tested on"):
        read_rows(tmp_path, lambda _, i: "train" if i % 2 else "test", split={"column": "part"})


def test_two_tests_may_lie_on_either_side_of_what_is_trained_on(tmp_path: Path) -> None:
    def part(_: int, i: int) -> str:
        return "arrow" if i < 3 else "train" if i < 7 else "sine"

    recording = read_rows(tmp_path, part, split={"column": "part", "test": ["arrow", "sine"]})
    assert sorted({len(e.time) for e in recording.train}) == [4]
    assert sorted({len(e.time) for e in recording.test}) == [3]


def test_an_empty_split_and_a_single_episode_are_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="the test split is empty") as error:
        read_rows(tmp_path, lambda run, _: "train", split={"column": "part"})
    assert error.value.exit_code == 3
    with pytest.raises(DataError, match=r"train split is empty. The split column has only '1', '2'"):
        read_rows(tmp_path, lambda run, _: run % 2 + 1, split={"column": "part"})
    with pytest.raises(DataError, match="by: time"):
        read_rows(tmp_path, episodes=1)


def test_n_episodes_takes_the_first_training_episodes_only(tmp_path: Path) -> None:
    everything = read_rows(tmp_path)
    fewer = read_rows(tmp_path, n_episodes=2)
    assert [e.name for e in fewer.train] == [e.name for e in everything.train][:2]
    assert [e.name for e in fewer.test] == [e.name for e in everything.test]
    with pytest.raises(DataError, match=r"n_episodes: 7.*have 6"):
        read_rows(tmp_path, n_episodes=7)


def test_selection_is_nested_and_seeded(tmp_path: Path) -> None:
    pairs = transitions(read_rows(tmp_path).train, 0)
    chosen = [set(select(pairs, n, "random", 4).states[:, 0]) for n in (5, 20, 50)]
    assert [len(c) for c in chosen] == [5, 20, 50]
    assert chosen[0] < chosen[1] < chosen[2]
    assert chosen[1] != set(select(pairs, 20, "random", 5).states[:, 0])
    assert chosen[1] != set(select(pairs, 20, "first", 4).states[:, 0])
    first = select(pairs, 20, "first", 4)
    np.testing.assert_array_equal(first.states, pairs.states[:20])
    np.testing.assert_array_equal(first.next_states, first.states + 1)
    assert select(pairs, None, "random", 0) is pairs


def test_more_than_there_are(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"data.n_train: 55 .* the data have 54") as error:
        select(transitions(read_rows(tmp_path).train, 0), 55, "random", 0)
    assert error.value.exit_code == 3


STATIC = Declared(
    name="line", dt=1.0, inputs={"x": {"range": [0, 1000]}}, parameters={"a": {"range": [0, 2]}},
    outputs={"f": {"expression": "a*x"}},
).model()  # fmt: skip


def read_points(folder: Path, seed: int = 0, rows: int = 40, **keys: Any) -> Recording:
    (folder / "d.csv").write_text("x,f\n" + "".join(f"{i},{2 * i + (i % 7)}\n" for i in range(rows)))
    return read(Measurements("d.csv", **keys), STATIC, folder, seed)


def points(recording: Recording) -> tuple[list[float], list[float]]:
    train, test = (transitions(part, 0).inputs[:, 0].tolist() for part in (recording.train, recording.test))
    return train, test


def test_one_episode_without_states_is_split_by_rows(tmp_path: Path) -> None:
    recording = read_points(tmp_path)
    train, test = points(recording)
    assert sorted(train + test) == list(range(40))
    assert len(test) == 10
    assert test != list(range(30, 40))  # drawn at random, not the end
    (check,) = [c for c in recording.checks if c.name == "split"]
    assert check.ok
    assert "10 of 40 rows, drawn at random (seed 0), are the test" in check.detail
    assert points(read_points(tmp_path)) == (train, test)
    assert points(read_points(tmp_path, seed=1)) != (train, test)
    assert len(points(read_points(tmp_path, rows=2))[1]) == 1
    assert points(read_points(tmp_path, split={"by": "time"}))[1] == list(range(30, 40))


def test_rows_that_need_their_neighbours_are_not_split_at_random(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="one episode only"):
        read_points(tmp_path, stack_actions=1)
    with pytest.raises(DataError, match="one row only"):
        read_points(tmp_path, rows=1)
