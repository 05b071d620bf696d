"""A velocity that is not the rate of its position, or is nothing but that rate, is found and named."""

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from test_sensor_checks import check, measured, motion

from simpel_cli.data.estimation.derived_speeds import derived, difference_kind, differences, filter_kind
from simpel_cli.data.estimation.kinematics import Motion, agreement, kinematics
from simpel_cli.data.estimation.rounded_speeds import rounded_kind

RNG = np.random.default_rng(0)


def pair(scale: float = 1.0, offset: float = 0.0, noise: float = 0.01, dt: float = 0.02, rows: int = 400) -> Motion:
    t = dt * np.arange(rows)
    pieces = []
    for phase in (0.0, 2.0):
        p, v = motion(t, phase=phase)
        pieces.append(
            (t, p + RNG.normal(0, 1.2 * noise, rows), scale * (v + offset + RNG.normal(0, 3.6 * noise, rows)))
        )
    return Motion("a", "w", "rad/s", pieces)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.03])
@pytest.mark.parametrize(
    ("scale", "text"),
    [
        (180 / np.pi, "times d(a)/dt: the velocity looks like degrees per s"),
        (np.pi / 180, "the position looks like degrees"),
        (1000.0, "the velocity looks like mm/s where the position is in m"),
        (0.001, "the position looks like mm"),
        (-1.0, "w is -1 times d(a)/dt: the sign is flipped"),
        (-180 / np.pi, "the sign is flipped, and the velocity looks like degrees per s"),
        (60.0, "one per minute"),
        (0.02, "the velocity looks like a change per row, not per s"),
        (1.5, "times d(a)/dt: compare their units"),
    ],
)
def test_scale_and_sign(scale: float, text: str, noise: float) -> None:
    found = kinematics([pair(scale, noise=noise)])
    assert not found.ok
    if text.startswith("w is -1"):
        assert found.detail.startswith("w is -")
        assert found.detail.endswith("the sign is flipped")
    else:
        assert text in found.detail


@pytest.mark.parametrize("offset", [0.4, -1.0])
@pytest.mark.parametrize("noise", [0.001, 0.03])
def test_offset(offset: float, noise: float) -> None:
    found = kinematics([pair(offset=offset, noise=noise)])
    assert not found.ok
    reading = float(found.detail.split("reads ")[1].split()[0])
    assert reading == pytest.approx(offset, abs=0.1)
    assert "rad/s where a stands still: an offset of the sensor" in found.detail


def test_estimates_are_unbiased_and_their_errors_honest() -> None:
    z = []
    for _ in range(100):
        found = agreement(pair(1.3, 0.2, noise=0.03))
        assert found is not None
        z.append([(found.ratio - 1.3) / (1.3 * found.ratio_error), (found.offset - 1.3 * 0.2) / found.offset_error])
    assert np.all(np.abs(np.mean(z, axis=0)) < 0.4)
    # neighbouring windows share a row, so that the offset is known better than their residuals tell
    assert np.all((np.std(z, axis=0) > 0.3) & (np.std(z, axis=0) < 1.5))


def test_slow_sampling_is_no_fault() -> None:
    """Eight rows per swing: a difference of the position is 10 % off, the integral of the velocity is not."""
    assert kinematics([pair(dt=2 * np.pi / 3 / 8, noise=0.001)]).ok


def test_another_quantity_and_a_delay_are_named() -> None:
    t = 0.02 * np.arange(400)
    p, v = motion(t)
    found = kinematics([Motion("a", "w", "rad/s", [(t, p, np.cos(11 * t))])])
    assert not found.ok
    assert "w and d(a)/dt do not go together" in found.detail
    late = kinematics([Motion("a", "w", "rad/s", [(t[26:], p[26:], v[:-26])])])  # a quarter of a swing
    assert not late.ok


def test_a_constant_speed_and_rest_tell_what_they_can() -> None:
    t = 0.02 * np.arange(300)
    noise = RNG.normal(0, 0.001, (2, 300))
    turning = [(t, 5 * t + noise[0], 5 + noise[1])]
    assert kinematics([Motion("a", "w", "rad/s", turning)]).ok
    degrees = [(t, 5 * t + noise[0], np.degrees(5 + noise[1]))]
    assert "looks like degrees per s" in kinematics([Motion("a", "w", "deg/s", degrees)]).detail
    for _ in range(50):
        assert kinematics([Motion("a", "w", "rad/s", [(t, *RNG.normal(0, 0.001, (2, 300)))])]).ok
    stuck = kinematics([Motion("a", "w", "rad/s", [(t, noise[0], motion(t)[1])])])
    assert "w and d(a)/dt do not go together" in stuck.detail
    assert kinematics([Motion("a", "w", "rad/s", [(t, 0 * t, 0 * t)])]).ok
    assert kinematics([Motion("a", "w", "rad/s", [(t[:3], t[:3], t[:3])])]).ok


@pytest.mark.parametrize("kind", ["central", "forward", "backward"])
@pytest.mark.parametrize("noise", [0.001, 0.03])
def test_a_differentiated_velocity_is_found(kind: str, noise: float) -> None:
    t = 0.02 * np.arange(400)
    p = motion(t)[0] + RNG.normal(0, noise, 400)
    v = {
        "central": np.gradient(p, t),
        "forward": np.append(np.diff(p), 0) / 0.02,
        "backward": np.insert(np.diff(p), 0, 0) / 0.02,
    }[kind]
    found = Motion("a", "w", "rad/s", [(t, p, v)])
    assert difference_kind(found) == kind
    assert f"w is the {kind} difference of a" in derived([found]).detail
    assert "set data.columns {w: null}" in derived([found]).detail
    rounded = found._replace(pieces=[(t, np.round(p, 5), np.round(v, 4))])
    assert difference_kind(rounded) == kind


@pytest.mark.parametrize("per_swing", [3, 5, 10, 100, 1000])
def test_an_exact_velocity_is_not_taken_for_a_difference(per_swing: int) -> None:
    """Without any noise a fine sampling makes differences almost exact; they still differ by more than the noise."""
    t = 2 * np.pi / 3 / per_swing * np.arange(max(40, 3 * per_swing))
    assert difference_kind(Motion("a", "w", "rad/s", [(t, *motion(t))])) is None
    falling = Motion("h", "v", "m/s", [(t, -4.905 * t**2, -9.81 * t)])  # a difference is exact here
    assert difference_kind(falling) is None


def test_both_are_shown_for_a_file(tmp_path: Path) -> None:
    a, w = motion(0.02 * np.arange(300))
    noisy = a + RNG.normal(0, 0.003, 300)
    recording = measured(tmp_path, [noisy, noisy], [np.gradient(noisy, 0.02)] * 2)
    assert "w is the central difference of a" in check(recording, "derived").detail
    degrees = measured(tmp_path, [a, a], [np.degrees(w)] * 2)
    assert "degrees per s" in check(degrees, "kinematics").detail
    assert check(measured(tmp_path, [a, a], [w, w]), "kinematics").ok


def savitzky(p: np.ndarray, dt: float) -> np.ndarray:
    from scipy.signal import savgol_filter

    return np.asarray(savgol_filter(p, 7, 2, deriv=1, delta=dt))


def averaged(p: np.ndarray, dt: float) -> np.ndarray:
    return np.convolve(np.gradient(p, dt), np.ones(5) / 5, mode="same")


@pytest.mark.parametrize("smooth", [savitzky, averaged])
@pytest.mark.parametrize("noise", [0.001, 0.03])
def test_a_smoothed_difference_is_found(smooth: Callable, noise: float) -> None:
    t = 0.02 * np.arange(400)
    p = motion(t)[0] + RNG.normal(0, noise, 400)
    found = Motion("a", "w", "rad/s", [(t, p, smooth(p, 0.02))])
    assert difference_kind(found) is None
    assert differences([found]) == {"w": "the smoothed difference of a"}


@pytest.mark.parametrize("per_swing", [3, 5, 10, 100, 1000])
@pytest.mark.parametrize("noise", [(0.0, 0.0), (0.01, 0.0), (0.01, 1e-4), (0.001, 0.03)])
def test_a_velocity_of_its_own_is_no_smoothed_difference(per_swing: int, noise: tuple[float, float]) -> None:
    t = 2 * np.pi / 3 / per_swing * np.arange(max(300, 3 * per_swing))
    p, v = (x + RNG.normal(0, s, len(t)) if s else x for x, s in zip(motion(t), noise, strict=True))
    assert filter_kind(Motion("a", "w", "rad/s", [(t, p, v)])) is None


def low_pass(p: np.ndarray, dt: float) -> np.ndarray:
    from scipy.signal import lfilter

    return np.asarray(lfilter([0.5], [1, -0.5], np.gradient(p, dt)))


def backward(p: np.ndarray, dt: float) -> np.ndarray:
    return np.diff(p, prepend=p[0]) / dt


def butterworth(p: np.ndarray, dt: float) -> np.ndarray:
    from scipy.signal import butter, lfilter

    return np.asarray(lfilter(*butter(2, 0.3), np.diff(p, prepend=p[0]) / dt))


def both_ways(p: np.ndarray, dt: float) -> np.ndarray:
    from scipy.signal import butter, filtfilt

    return np.asarray(filtfilt(*butter(2, 0.15), np.gradient(p, dt)))


@pytest.mark.parametrize("missing", [0.0, 0.12])
@pytest.mark.parametrize("filtered", [low_pass, butterworth, both_ways])
@pytest.mark.parametrize("noise", [0.001, 0.03])
def test_a_filtered_difference_is_found(filtered: Callable, noise: float, missing: float) -> None:
    t = 0.02 * np.arange(600)
    p = motion(t)[0] + RNG.normal(0, noise, 600)
    there = RNG.random(600) >= missing  # whole rows
    found = Motion("a", "w", "rad/s", [(t[there], p[there], filtered(p, 0.02)[there])])
    assert differences([found]) == {"w": "the smoothed difference of a"}


def test_short_stretches_between_gaps_are_enough_for_a_filter_that_looks_back() -> None:
    """Fifty whole stretches of rows: too few for the weights of one that was run both ways."""
    t = 0.02 * np.arange(400)
    p = motion(t)[0] + np.random.default_rng(3).normal(0, 0.01, 400)
    there = np.isin(np.arange(400) % 40, np.arange(11))
    assert filter_kind(Motion("a", "w", "rad/s", [(t[there], p[there], low_pass(p, 0.02)[there])])) == "smoothed"


@pytest.mark.parametrize(("rate", "tick"), [(60, 1e-3), (400, 1e-3), (15, 1e-2)])
@pytest.mark.parametrize("filtered", [savitzky, low_pass, butterworth])
def test_stamps_may_be_rounded(filtered: Callable, rate: float, tick: float) -> None:
    """Their median step is not their mean one."""
    t = np.arange(1500) / rate
    p = motion(t)[0] + RNG.normal(0, 0.01, 1500)
    found = Motion("a", "w", "rad/s", [(np.round(t / tick) * tick, p, filtered(p, 1 / rate))])
    assert differences([found]) == {"w": "the smoothed difference of a"}


def test_a_long_pause_is_a_gap_like_others_and_no_rows_tell_nothing() -> None:
    t = 0.02 * np.arange(600)
    p = motion(t)[0] + RNG.normal(0, 0.01, 600)
    paused = np.where(np.arange(600) < 300, t, t + 1e7)
    assert filter_kind(Motion("a", "w", "rad/s", [(paused, p, low_pass(p, 0.02))])) == "smoothed"
    assert filter_kind(Motion("a", "w", "rad/s", [(t[:1], p[:1], p[:1])])) is None
    assert filter_kind(Motion("a", "w", "rad/s", [])) is None


@pytest.mark.parametrize("filtered", [low_pass, butterworth, both_ways])
def test_a_filtered_velocity_of_its_own_is_none(filtered: Callable) -> None:
    """A filter behind another sensor: what the position's noise is does not show in it."""
    t = 0.02 * np.arange(600)
    p, v = motion(t)
    noisy = np.cumsum(v + RNG.normal(0, 0.03, 600)) * 0.02
    assert filter_kind(Motion("a", "w", "rad/s", [(t, p + RNG.normal(0, 0.01, 600), filtered(noisy, 0.02))])) is None


def test_a_declared_one_is_no_news() -> None:
    t = 0.02 * np.arange(400)
    p = motion(t)[0] + RNG.normal(0, 0.01, 400)
    found = derived([Motion("a", "w", "rad/s", [(t, p, np.gradient(p, t))])], ["w"])
    assert found.ok
    assert found.detail == "w: declared as computed from other columns"


def rounded(values: np.ndarray, step: float) -> np.ndarray:
    return step * np.round(values / step)


@pytest.mark.parametrize("steps", [0.5, 1.5, 3.0])
@pytest.mark.parametrize(
    ("filtered", "kind"), [(low_pass, "central"), (np.gradient, "central"), (backward, "backward")]
)
def test_what_was_rounded_is_a_filtered_difference_all_the_same(filtered: Callable, kind: str, steps: float) -> None:
    """Steps in standard deviations of the position's noise, and in those of what the filter makes of it."""
    t, random = 0.02 * np.arange(600), np.random.default_rng(8)
    p = motion(t)[0] + (noise := random.normal(0, 0.01, 600))
    made, there = filtered(p, 0.02), random.random(600) >= 0.02
    of_noise = float(np.std(filtered(noise, 0.02)))
    found = Motion(
        "a", "w", "rad/s", [(t[there], rounded(p, steps * 0.01)[there], rounded(made, steps * of_noise)[there])]
    )
    assert rounded_kind(found) == f"{kind} (filtered and rounded)"
    assert "set data.columns {w: null}" in derived([found]).detail


def resting(t: np.ndarray) -> np.ndarray:
    return np.where(t % 4 < 0.3, 3.0, 0.0)


@pytest.mark.parametrize(
    "speed", [lambda t: 5 * np.sin(0.5 * t), resting, lambda t: np.cos(t), lambda t: 3 * np.cos(3 * t)],
    ids=["slow", "resting", "gentle", "swift"],
)  # fmt: skip
def test_a_velocity_that_stands_on_its_steps_is_no_difference(speed: Callable) -> None:
    """Its errors of rounding are alike from row to row, so that it misses a filter by less than independent ones."""
    t = 0.02 * np.arange(600)
    v = speed(t)
    p = np.cumsum(v) * 0.02
    for own, of_p, of_v, seed in product((0.01, 0.05), (0.005, 0.02), (0.1, 0.3, 0.5, 1.3), range(3)):
        random = np.random.default_rng(seed)
        read = rounded(p + random.normal(0, 0.01, 600), of_p), rounded(v + random.normal(0, own, 600), of_v)
        assert rounded_kind(Motion("a", "w", "rad/s", [(t, *read)])) is None


@pytest.mark.parametrize("own", [0.003, 0.05, 0.3])
@pytest.mark.parametrize("steps", [0.5, 3.0, 10.0])
@pytest.mark.parametrize("late", [False, True])
def test_a_rounded_velocity_of_its_own_is_no_difference(steps: float, own: float, late: bool) -> None:
    t = 0.02 * np.arange(600)
    for seed in range(10):
        random = np.random.default_rng(seed)
        p, v = motion(t)
        v = low_pass(np.cumsum(v) * 0.02, 0.02) if late else v  # filtered, and of another sensor
        read = (
            rounded(p + random.normal(0, 0.01, 600), steps * 0.01),
            rounded(v + random.normal(0, own, 600), steps * own),
        )
        assert rounded_kind(Motion("a", "w", "rad/s", [(t, *read)])) is None


def test_rounding_that_hides_the_noise_tells_nothing_nor_do_few_rows_or_numbers_as_they_are() -> None:
    t, random = 0.02 * np.arange(600), np.random.default_rng(8)
    p = motion(t)[0] + random.normal(0, 0.01, 600)
    v = low_pass(p, 0.02)
    assert rounded_kind(Motion("a", "w", "rad/s", [(t, rounded(p, 0.2), rounded(v, 3.0))])) is None
    assert rounded_kind(Motion("a", "w", "rad/s", [(t, p, v)])) is None
    few = slice(0, 80)
    assert rounded_kind(Motion("a", "w", "rad/s", [(t[few], rounded(p, 0.02)[few], rounded(v, 0.2)[few])])) is None
    assert rounded_kind(Motion("a", "w", "rad/s", [])) is None
