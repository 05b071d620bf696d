"""Single spikes of a sensor are found; what moves, stops, jumps or is kicked is none."""

from collections.abc import Callable

import numpy as np
import pytest

from simpel_cli.data.checks.outliers import lone_values

DT, ROWS, EPISODES = 0.05, 100, 5
Rate = Callable[[np.ndarray, float], list[float]]


def pendulum(x: np.ndarray, u: float) -> list[float]:
    return [x[1], 9.81 * np.sin(x[0]) + u - 0.05 * x[1]]


def sticking_cart(x: np.ndarray, u: float) -> list[float]:
    return [x[1], (4 * u - 60 * x[0] - 2 * x[1]) / 1.4 - 2.0 * np.tanh(x[1] / 0.01)]


def fast_current(x: np.ndarray, u: float) -> list[float]:
    return [x[1], 100.0 * (u - x[1])]  # follows its input within a row


def held(random: np.random.Generator) -> np.ndarray:
    return np.repeat(random.uniform(-2, 2, ROWS), random.integers(3, 12, ROWS))[:ROWS]


def square(random: np.random.Generator) -> np.ndarray:
    return 1.5 * np.where((np.arange(ROWS) // 20) % 2 == 0, 1.0, -1.0)


def slow(random: np.random.Generator) -> np.ndarray:
    return 1.2 * np.sin(0.08 * np.arange(ROWS) + random.uniform(0, 6))


def kicks(random: np.random.Generator) -> np.ndarray:
    return 3.0 * (random.random(ROWS) < 0.05)


def motion(rate: Rate, drive: Callable, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    random = np.random.default_rng(seed)
    states, inputs = [], []
    for _ in range(EPISODES):
        u, x, rows = drive(random), np.array([random.uniform(-0.2, 0.2), 0.0]), []
        for k in range(ROWS):
            rows.append(x.copy())
            for _ in range(20):
                x = x + DT / 20 * np.array(rate(x, u[k]))
        states.append(np.array(rows))
        inputs.append(u[:, None])
    return states, inputs


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.03])
@pytest.mark.parametrize(
    ("rate", "drive"),
    [(pendulum, held), (pendulum, square), (sticking_cart, square), (sticking_cart, slow), (fast_current, kicks)],
)
def test_clean_motions_have_none(rate: Rate, drive: Callable, noise: float) -> None:
    states, inputs = motion(rate, drive, 1)
    random = np.random.default_rng(2)
    for channel in (0, 1):
        pieces = [s[:, channel] for s in states]
        pieces = [p + noise * np.std(np.concatenate(pieces)) * random.normal(size=ROWS) for p in pieces]
        assert sum(mask.sum() for mask in lone_values(pieces, inputs)) == 0


def spiked(size: float) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """A pendulum's angle with noise, spikes of `size` of its standard deviations in 1 % of the rows, and where."""
    states, inputs = motion(pendulum, held, 3)
    random = np.random.default_rng(4)
    pieces = [s[:, 0] + 0.01 * random.normal(size=ROWS) for s in states]
    hits = [np.isin(np.arange(ROWS), random.choice(np.arange(6, ROWS - 6, 7), 2, replace=False)) for _ in pieces]
    spikes = [0.01 * size * h * random.choice([-1, 1], ROWS) for h in hits]
    return [p + s for p, s in zip(pieces, spikes, strict=True)], inputs, hits


@pytest.mark.parametrize("size", [30, 100, 1e6])
def test_planted_spikes_are_found_and_nothing_else(size: float) -> None:
    pieces, inputs, hits = spiked(size)
    found = lone_values(pieces, inputs)
    assert not any((f & ~h).any() for f, h in zip(found, hits, strict=True))
    assert sum((f & h).sum() for f, h in zip(found, hits, strict=True)) >= 9  # of 10


def test_units_do_not_matter() -> None:
    pieces, inputs, _ = spiked(15)
    found = lone_values(pieces, inputs)
    in_other_units = lone_values([180 / np.pi * p + 40 for p in pieces], [1000 * u for u in inputs])
    assert sum(f.sum() for f in found) > 0
    for one, other in zip(found, in_other_units, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_sensor_that_flickers_by_its_least_digit_is_left_alone() -> None:
    pieces = [0.1 * (np.random.default_rng(5).random(200) < 0.05) for _ in range(3)]
    assert not any(mask.any() for mask in lone_values(pieces, [np.zeros((200, 0))] * 3))


def test_a_jump_and_a_corner_are_no_spikes() -> None:
    t = np.arange(100) * DT
    noise = 1e-4 * np.random.default_rng(6).normal(size=(4, 100))
    shapes = [np.where(t > 2, 1.0, 0.0), np.abs(t - 2.0), np.abs(t - 2.02), np.maximum(t - 2, 0) * 5]
    for shape, own in zip(shapes, noise, strict=True):
        assert not any(mask.any() for mask in lone_values([shape + own], [np.zeros((100, 0))]))


def test_too_few_rows_tell_nothing() -> None:
    assert lone_values([], []) == []
    for rows in range(1, 8):
        (mask,) = lone_values([np.arange(rows) % 2.0], [np.zeros((rows, 1))])
        assert mask.shape == (rows,)
        assert not mask.any()
