"""Rows that are not whole, made whole by the filter: estimates against the exact motion, and what they count."""

import numpy as np
import pytest
from test_filter_clock import DT, model, motion, recording

from simpel_cli.data import transitions, with_measured_targets
from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.filtering import estimated_rows
from simpel_cli.filtering.estimated_rows import MOST_WEIGHT, NOTHING, with_estimates
from simulators.model import Declared, Model

NOISE, ROWS = 0.02, 60


def episodes(count: int = 6, seed: int = 3) -> tuple[list[Episode], list[np.ndarray]]:
    """Return episodes with all values, and their exact motion."""
    random, made, exact = np.random.default_rng(seed), [], []
    for k in range(count):
        time, u = np.arange(ROWS) * DT, random.normal(size=ROWS)
        true = motion(time, u, time[:-1])
        true = np.concatenate([true, motion(np.append(time, time[-1] + DT), np.append(u, 0.0), time[-1:])])
        exact.append(true)
        measured = true + NOISE * random.normal(size=true.shape)
        made.append(Episode(f"{k}", time, measured, u[:, None], np.zeros((ROWS, 0))))
    return made, exact


def recorded(made: list[Episode], test: int = 1) -> Recording:
    noise = {"s": NOISE, "v": NOISE}
    return Recording(tuple(made[:-test]), tuple(made[-test:]), (), noise, (), (Check("c", True, ""),), ())


def rarely(episode: Episode, every: int = 4) -> Episode:
    """Return an episode whose speed was measured in every so-many-th row."""
    states = episode.states.copy()
    states[np.arange(len(states)) % every != 0, 1] = np.nan
    return episode._replace(states=states)


@pytest.fixture(scope="module")
def seldom() -> tuple[Recording, Recording, list[np.ndarray]]:
    made, exact = episodes()
    given = recorded([rarely(e) for e in made])
    return given, with_estimates(given, model(), ("s", "v")), exact


def test_what_is_missing_is_estimated_as_well_as_it_says(seldom: tuple[Recording, Recording, list[np.ndarray]]) -> None:
    given, found, exact = seldom
    assert not estimated_rows.whole(given)
    assert estimated_rows.whole(found)
    errors, claimed = [], []
    for before, after, true in zip(given.train, found.train, exact, strict=False):
        assert after.weight is not None
        there = np.isfinite(before.states)
        np.testing.assert_array_equal(after.states[there], before.states[there])  # what was measured stays
        np.testing.assert_array_equal(after.weight == 1, there)
        gone = ~there[:, 1]
        errors.append((after.states - true)[gone, 1])
        claimed.append(NOISE / np.sqrt(after.weight[gone, 1]))
    error, std = np.concatenate(errors), np.concatenate(claimed)
    assert np.sqrt(np.mean(error**2)) < 0.7 * NOISE
    assert np.mean(np.abs(error) < 1.645 * std) > 0.85
    told = found.checks[-1]
    assert told.name == "estimated by the simulator's filter"
    assert told.detail.startswith("v: 75 % of the rows (standard deviation")
    assert not told.ok


def test_where_a_posterior_is_tested_the_future_is_not_looked_at(
    seldom: tuple[Recording, Recording, list[np.ndarray]],
) -> None:
    given, found, _ = seldom
    last = given.test[0]
    moved = last.states.copy()
    moved[40:] += 0.5
    other = with_estimates(given._replace(test=(last._replace(states=moved),)), model(), ("s", "v"))
    np.testing.assert_array_equal(other.test[0].states[:40], found.test[0].states[:40])
    ahead = given.train[0].states.copy()
    ahead[40:] += 0.5
    learned = with_estimates(
        given._replace(train=(given.train[0]._replace(states=ahead), *given.train[1:])), model(), ("s", "v")
    )
    assert np.abs(learned.train[0].states[:40] - found.train[0].states[:40]).max() > 1e-3


def test_changes_count_by_the_variance_of_both_ends(seldom: tuple[Recording, Recording, list[np.ndarray]]) -> None:
    _, found, _ = seldom
    pairs = transitions(found.train, 0)
    weight = found.train[0].weight
    assert weight is not None
    np.testing.assert_allclose(pairs.weight[2], 2 / (1 / weight[2] + 1 / weight[3]))
    tested = transitions(found.test, 0)
    kept = with_measured_targets(tested, found.test)
    assert set(kept.row % 4) == {3}  # the row after has the speed, too
    nothing = [e._replace(weight=np.full(e.states.shape, 0.5)) for e in found.test]
    assert len(with_measured_targets(tested, nothing).row) == len(tested.row)


def test_values_measured_before_their_row_are_moved_there() -> None:
    given, _ = recording(0.0, True, noise=1e-3)
    found = with_estimates(given, model(), ("s", "v"))
    for before, after in zip(given.train, found.train, strict=True):
        assert after.weight is None
        assert after.late is None
        true = motion(np.append(before.time, before.time[-1] + DT), np.append(before.inputs[:, 0], 0.0), before.time)
        off, moved = (np.abs(e.states[1:, 1] - true[1:, 1]).max() for e in (before, after))
        assert off > 0.03
        assert moved < 0.012
    assert "values moved to their rows" in found.checks[-1].detail


def angle() -> Model:
    return Declared(
        "turning", dt=DT, states={"phi": {"unit": "rad", "range": [-3.2, 3.2], "periodic": True}},
        inputs={"u": {"unit": "V", "range": [-3, 3]}}, parameters={"b": {"unit": "rad/s/V", "range": [0.5, 3]}},
        dynamics={"phi": "2 + b*u"}, outputs={"y": {"unit": "m", "expression": "cos(phi)"}},
    ).model()  # fmt: skip


def test_an_angle_is_estimated_on_its_turn_and_a_missing_output_counts_nothing() -> None:
    random, made = np.random.default_rng(0), []
    for k in range(5):
        u = random.normal(size=ROWS)
        phi = np.cumsum(np.append(7.0, DT * (2 + 1.4 * u)))[:-1]
        y = np.cos(phi) + 0.01 * random.normal(size=ROWS)
        phi = phi + 0.01 * random.normal(size=ROWS)
        gone = random.random(ROWS) < 0.2
        gone[0] = k == 0
        made.append(
            Episode(f"{k}", np.arange(ROWS) * DT, np.where(gone, np.nan, phi)[:, None], u[:, None],
                    np.where(np.roll(gone, 1), np.nan, y)[:, None])
        )  # fmt: skip
    given = Recording(tuple(made[:4]), tuple(made[4:]), ("y",), {"phi": 0.01, "y": 0.01}, (), (), ())
    found = with_estimates(given, angle(), ())
    for before, after in zip(given.train, found.train, strict=True):
        assert after.weight is not None
        phi = before.states[:, 0]
        there = np.flatnonzero(np.isfinite(phi))
        near = np.interp(np.arange(ROWS), there, phi[there])
        assert np.abs(after.states[:, 0] - near)[there[0] : there[-1]].max() < 1.0
        missing = np.isnan(before.outputs[:, 0])
        np.testing.assert_array_equal(after.weight[missing, 1], NOTHING)
        np.testing.assert_allclose(after.outputs[missing, 0], np.cos(after.states[missing, 0]), atol=0.05)
        assert (after.weight[np.isnan(phi), 0] <= MOST_WEIGHT).all()


def test_a_test_begins_where_every_state_has_been_measured(
    seldom: tuple[Recording, Recording, list[np.ndarray]],
) -> None:
    given, _, _ = seldom
    states = given.test[0].states.copy()
    states[:6, 1] = np.nan
    found = with_estimates(given._replace(test=(given.test[0]._replace(states=states),)), model(), ("s", "v"))
    assert found.test[0].time[0] == pytest.approx(8 * DT)
    assert len(found.train[0].time) == ROWS


def test_a_sensor_whose_noise_nothing_tells_begins_with_a_guess(
    seldom: tuple[Recording, Recording, list[np.ndarray]],
) -> None:
    given, _, _ = seldom
    found = with_estimates(given._replace(noise_std={"s": NOISE}), model(), ("s",))
    assert NOISE / 4 < found.noise_std["v"] < 3 * NOISE


def test_of_what_nothing_measures_estimates_count_as_measurements_do() -> None:
    made, _ = episodes()
    random = np.random.default_rng(5)
    blind = []
    for e in made:
        states = e.states.copy()
        states[:, 1] = np.nan
        states[random.random(len(states)) < 0.1, 0] = np.nan
        states[0, 0] = e.states[0, 0]
        blind.append(e._replace(states=states))
    given = recorded(blind)._replace(estimated=("v",), noise_std={"s": NOISE})
    found = with_estimates(given, model(), ("s",))
    assert "test scores of v compare with estimates: nothing measured it" in found.checks[-1].detail
    assert all(e.weight is None or (e.weight[:, 1] == 1).all() for e in (*found.train, *found.test))
    assert any((e.weight[:, 0] < 1).any() for e in found.train if e.weight is not None)


def test_values_are_told_from_estimates_where_a_transition_ends_with_all_of_them() -> None:
    """States are needed at its end, outputs at its beginning."""
    values = np.full((6, 2), np.nan)
    values[2] = 1.0
    slow = Episode("slow", np.arange(6.0), values[:, :1], np.zeros((6, 1)), values[:, 1:])
    assert not estimated_rows._measured_together([slow]).any()
    early = slow._replace(outputs=np.roll(values[:, 1:], -1, axis=0))
    assert estimated_rows._measured_together([early]).all()
