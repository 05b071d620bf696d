"""Tables of a search: where windows lie in their episodes, and errors with intervals."""

from typing import Any

import numpy as np
import pytest

from simpel_cli.data.recording import Episode
from simpel_cli.discovery.verdict.tables import (
    column_names,
    error_columns,
    innovation_columns,
    pieces,
    residual_columns,
    trajectory_columns,
)
from simpel_cli.filtering.errors_ahead import FIRST, Assessment
from simpel_cli.filtering.likelihood.latent_force import Force
from simpel_cli.filtering.measurements.windows import windows_of

LEAD = 2


def episode(name: str, rows: int, begin: float = 0.0) -> Episode:
    time = begin + 0.1 * np.arange(rows)
    return Episode(name, time, time[:, None] ** 2, -time[:, None], np.zeros((rows, 0)))


EPISODES = (episode("a", 23), episode("b", 9, 5.0))
WINDOWS = windows_of(EPISODES, ["x"], ["x"], [], np.zeros(1), np.ones(1), lead=LEAD, dt=0.1, longest=10)


def assessment(one_step: Any, ahead: Any = None, free: Any = None) -> Assessment:
    shape = WINDOWS.y.shape
    full = [
        np.broadcast_to(np.asarray(v if v is not None else one_step, float), shape) for v in (one_step, ahead, free)
    ]
    track: Any = None
    claimed = np.full(shape, 4.0)
    return Assessment(full[0], claimed, full[1], full[2], np.zeros(len(WINDOWS.y)), WINDOWS.y + 1.0, track)


def test_pieces_follow_each_other() -> None:
    found = list(pieces(WINDOWS, EPISODES))
    assert [(p.episode, p.rows[0], len(p.rows)) for p in found] == [("a", 0, 8), ("a", 8, 8), ("a", 16, 7), ("b", 0, 8)]
    for w, p in enumerate(found):
        np.testing.assert_allclose(WINDOWS.y[w, : len(p.rows), 0], p.time**2)


def test_residual_rows_carry_state_and_input_of_their_time() -> None:
    shape = (*WINDOWS.y.shape[:2], 1)
    force = np.arange(np.prod(shape), dtype=float).reshape(shape)
    found = Force(WINDOWS.y.copy(), force[:, 1:], force[:, 1:] / 10)
    table = residual_columns(
        "before", "train", found, 0 * force[:, 1:], WINDOWS, EPISODES, {0: ("x", "m/s")}, (["x"], ["u"])
    )
    np.testing.assert_allclose(table["x"], table["time"] ** 2)
    np.testing.assert_allclose(table["u"], -table["time"])
    np.testing.assert_allclose(table["std"], table["force"] / 10)
    assert set(table["acts_on"]) == {"x"}
    assert set(table["unit"]) == {"m/s"}
    assert np.isfinite(table["force"]).all()


def test_a_state_with_a_column_s_name_gets_an_underscore() -> None:
    assert column_names(["phi", "force", "time"]) == ["phi", "force_", "time_"]


def test_innovations_and_free_runs() -> None:
    found = assessment(0.3)
    table = innovation_columns("after", "test", found, WINDOWS, EPISODES, ["x"])
    assert set(table["std"]) == {2.0}
    assert set(table["innovation"]) == {0.3}
    runs = trajectory_columns(found, found, WINDOWS, EPISODES, {"x": "m"})
    np.testing.assert_allclose(runs["after"], runs["measured"] + 1)
    np.testing.assert_allclose(runs["measured"], runs["time"] ** 2)
    assert not runs["free"][:FIRST].any()


def test_errors() -> None:
    """RMSE by horizon, and the ratio; the interval is that of a resampling of three episodes."""
    three = WINDOWS._replace(episode=np.minimum(np.arange(len(WINDOWS.episode)), 2))
    by_episode = np.where(three.episode == 0, 3.0, 1.0)[:, None, None]
    before, after = assessment(by_episode, 2 * by_episode, np.nan), assessment(1.0)
    table = error_columns(before, after, three, {"x": "m"}, {"x": 0.1})
    assert table["horizon"].tolist() == ["one_step", "horizon", "free_run"]
    share = np.mean(three.episode == 0)
    assert table["before"][0] == pytest.approx(np.sqrt(9 * share + 1 - share))
    assert table["before"][1] == pytest.approx(2 * table["before"][0])
    assert np.isnan(table["before"][2])
    assert np.isnan(table["before_low"][2])
    np.testing.assert_allclose(table["reduction"][:2], table["before"][:2])
    assert (table["before_low"][0], table["before_high"][0]) == pytest.approx((1.0, 3.0))
    assert (table["reduction_low"][1], table["reduction_high"][1]) == pytest.approx((2.0, 6.0))
    assert table["after_low"][0] == table["after_high"][0] == 1.0


def test_one_episode_has_the_interval_of_its_blocks() -> None:
    alone = WINDOWS._replace(episode=np.zeros(len(WINDOWS.episode), int))
    rows = alone.ok.shape[1]
    half = np.where(np.arange(rows) % 4 == 0, 4.0, 2.0)[None, :, None]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(alone.episode), rows, 1))
    table = error_columns(assessment(half * signs), assessment(signs), alone, {"x": "m"}, {"x": 0.1})
    assert 2 < table["reduction_low"][0] < table["reduction"][0] < table["reduction_high"][0] < 4
    assert table["after_low"][0] == table["after_high"][0] == 1.0
