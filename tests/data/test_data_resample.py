"""Resampling: slow motion survives, fast motion is suppressed instead of aliased, inputs keep their mean."""

import numpy as np
import pytest

from simpel_cli.data.recording import Episode
from simpel_cli.data.resample import lowpass, resample


def tone(hertz: float, dt: float, seconds: float = 10.0, jitter: float = 0.0) -> Episode:
    rng = np.random.default_rng(0)
    time = 3.0 + dt * np.arange(round(seconds / dt))
    time = time + jitter * dt * rng.uniform(-1, 1, len(time))
    wave = np.sin(2 * np.pi * hertz * time)[:, None]
    return Episode("0", time, wave, (time[:, None] % 1), 2 * wave)


@pytest.mark.parametrize("raw", [0.01, 0.0125, 0.03])
def test_a_fast_tone_is_suppressed(raw: float) -> None:
    (brought,), _, check = resample((tone(12.0, raw),), raw, 0.1)
    assert np.max(np.abs(brought.states)) < 2e-3
    assert "zero-phase low-pass at 3.5 Hz" in check.detail


@pytest.mark.parametrize(("raw", "jitter"), [(0.01, 0.0), (0.01, 0.2), (0.03, 0.0), (0.2, 0.0)])
def test_a_slow_tone_passes_without_delay(raw: float, jitter: float) -> None:
    (brought,), _, _ = resample((tone(0.5, raw, jitter=jitter),), raw, 0.1)
    expected = np.sin(np.pi * brought.time)
    inner = slice(2, -2)  # a spline is less exact at its ends
    np.testing.assert_allclose(brought.states[inner, 0], expected[inner], atol=3e-3)
    np.testing.assert_allclose(brought.outputs, 2 * brought.states)
    np.testing.assert_allclose(np.diff(brought.time), 0.1)


def test_only_rows_with_the_whole_filter_inside_are_kept() -> None:
    (brought,), _, check = resample((tone(0.5, 0.01),), 0.01, 0.1)
    assert brought.time[0] == pytest.approx(3.4)
    assert brought.time[-1] == pytest.approx(3.0 + 9.5)
    assert "4 rows dropped at either end" in check.detail


def test_constants_and_ramps_pass_exactly() -> None:
    time = 0.01 * np.arange(500)
    states = np.stack([np.full(500, 7.0), 3 * time], axis=1)
    (brought,), _, _ = resample((Episode("0", time, states, np.empty((500, 0)), np.empty((500, 0))),), 0.01, 0.1)
    np.testing.assert_allclose(brought.states[:, 0], 7.0, rtol=1e-12)
    np.testing.assert_allclose(brought.states[:, 1], 3 * brought.time, atol=1e-10)


def test_inputs_are_means_over_the_interval_that_follows() -> None:
    time = 0.02 * np.arange(300)
    inputs = np.random.default_rng(0).normal(size=(300, 1))
    (brought,), _, _ = resample((Episode("0", time, np.sin(time)[:, None], inputs, np.empty((300, 0))),), 0.02, 0.1)
    first = round(brought.time[0] / 0.02)
    means = inputs[first : first + 5 * len(brought.time), 0].reshape(-1, 5).mean(axis=1)
    np.testing.assert_allclose(brought.inputs[:, 0], means, atol=1e-12)


def test_a_segment_shorter_than_the_filter_is_dropped_and_counted() -> None:
    brought, _, check = resample((tone(0.5, 0.01), tone(0.5, 0.01, seconds=0.7)), 0.01, 0.1)
    assert len(brought) == 1
    assert not check.ok
    assert "1 of 2 segments are too short" in check.detail


def test_noise_gain_is_what_white_noise_keeps() -> None:
    noise = np.random.default_rng(0).normal(size=(200_000, 1))
    episode = Episode("0", 0.01 * np.arange(200_000), noise, np.empty((200_000, 0)), np.empty((200_000, 0)))
    (brought,), gain, _ = resample((episode,), 0.01, 0.1)
    assert np.std(brought.states) == pytest.approx(gain, rel=0.02)
    assert lowpass(10.0).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("dt", [0.1, 0.095])
@pytest.mark.parametrize("more", [-1, 0, 1])
def test_segments_about_as_long_as_the_filter(more: int, dt: float) -> None:
    rows = len(lowpass(dt / 0.01)) + more
    brought, _, check = resample((tone(0.5, 0.01, seconds=0.01 * rows),), 0.01, dt)
    assert brought == ()
    assert "1 of 1 segments are too short" in check.detail


def test_an_input_that_is_linear_between_rows_is_read_where_the_states_are() -> None:
    """Its value at the new row, not the mean over the interval behind it, which lags by half of one."""
    raw, dt = 0.01, 0.1
    episode = tone(0.5, raw)
    wave = np.sin(np.pi * episode.time)[:, None]
    episode = episode._replace(inputs=np.concatenate([wave, wave], axis=1))
    (brought,), _, _ = resample((episode,), raw, dt, linear=(1,))
    at = np.sin(np.pi * brought.time)
    inner = slice(2, -2)
    np.testing.assert_allclose(brought.inputs[inner, 1], at[inner], atol=3e-3)
    assert np.max(np.abs(brought.inputs[inner, 0] - at[inner])) > 0.1
