"""Rows that are not dt apart, values that were measured before their row, and measurements that count less."""

import jax.numpy as jnp
import numpy as np
import pytest
from filter_derivatives import check_derivatives

from simpel_cli.data.recording import Check, Episode, Recording
from simpel_cli.filtering.likelihood.track import Noise
from simpel_cli.filtering.measurements.windows import clocked
from simpel_cli.filtering.setup import Setup, setup
from simulators.model import Declared, Model

DT, ROWS, A, B = 0.2, 16, 0.7, 1.3


def model() -> Model:
    return Declared(
        "clockwork", dt=DT,
        states={"s": {"unit": "m", "range": [-3, 3]}, "v": {"unit": "m/s", "range": [-3, 3]}},
        inputs={"u": {"unit": "V", "range": [-3, 3]}},
        parameters={"a": {"unit": "1/s", "range": [0.2, 1.2]}, "b": {"unit": "m/s^2/V", "range": [0.8, 1.8]}},
        dynamics={"s": "v", "v": "b*u - a*v"},
    ).model()  # fmt: skip


def motion(time: np.ndarray, u: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return (s, v) at any time of dv/dt = B u - A v, ds/dt = v, with u held from stamp to stamp; closed form."""
    state = np.array([[0.3, -1.5]])
    for k in range(len(time) - 1):
        state = np.concatenate([state, [_after(state[-1], u[k], time[k + 1] - time[k])]])
    rows = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    return np.stack([_after(state[k], u[k], t - time[k]) for k, t in zip(rows, at, strict=True)])


def _after(x: np.ndarray, u: float, h: float) -> np.ndarray:
    end, decay = B * u / A, np.exp(-A * h)
    return np.array([x[0] + end * h + (x[1] - end) * (1 - decay) / A, end + (x[1] - end) * decay])


def recording(jitter: float, late: bool, noise: float = 0.01) -> tuple[Recording, np.ndarray]:
    """Five episodes with stamps that stray, and values of v that were measured up to a row before; the true readings."""
    random = np.random.default_rng(7)
    episodes, truth = [], []
    for k in range(5):
        time = np.arange(ROWS) * DT + jitter * DT * random.uniform(-1, 1, ROWS)
        u = random.normal(size=ROWS)
        early = np.zeros((ROWS, 2))
        if late:
            early[1:, 1] = random.uniform(0, 0.99, ROWS - 1) * np.diff(time)
        read = np.stack([motion(time, u, time - early[:, i])[:, i] for i in (0, 1)], axis=1)
        truth.append(read)
        measured = read + noise * random.normal(size=read.shape)
        episodes.append(Episode(f"{k}", time, measured, u[:, None], np.zeros((ROWS, 0)), late=early if late else None))
    checks = (Check("c", True, ""),)
    return Recording(tuple(episodes[:4]), tuple(episodes[4:]), (), {"s": noise, "v": noise}, (), checks, ()), np.array(
        truth
    )


def p_of(plan: Setup) -> np.ndarray:
    p = plan.augmented.neutral.copy()
    p[:2] = A, B
    return p


@pytest.mark.parametrize(("jitter", "late"), [(0.3, False), (0.0, True), (0.3, True)])
def test_readings_are_those_of_the_exact_motion(jitter: float, late: bool) -> None:
    """Nothing is heard of the measurements: what is predicted is the motion from the true start, at every stamp."""
    measured, truth = recording(jitter, late)
    plan = setup(model(), measured, (), [], 4)
    assert plan.clocked
    u = plan.windows.arrays[2]
    deaf = Noise(jnp.full(2, 1e6), jnp.zeros(2))
    for w in range(len(u)):
        rows = jnp.zeros((ROWS, 2))
        track, _ = plan.rule.track(
            jnp.asarray(p_of(plan)), deaf, rows, rows + 1, u[w], jnp.array([0.3, -1.5]), jnp.full(2, 1e-9)
        )
        # cubic Hermite: (h A)^4/384 of what v still has to go, within a row
        np.testing.assert_allclose(-np.asarray(track.innovation), truth[w], atol=2e-5)


def test_a_free_run_reads_late_values_late() -> None:
    from simpel_cli.filtering.errors_ahead import Assessor

    measured, _ = recording(0.3, True, noise=1e-6)
    plan = setup(model(), measured, (), [], 4)
    z = plan.start.copy()
    z[:2] = [plan.coordinates.unit(i, v) for i, v in enumerate((A, B))]
    found = Assessor(plan, 5)(z, plan.windows)
    assert np.nanmax(np.abs(found.free)) < 2e-5
    assert np.nanmax(np.abs(found.ahead)) < 2e-5


def test_an_even_clock_with_rounded_stamps_is_even() -> None:
    time = np.arange(200) * 0.0333

    def episodes(time: np.ndarray, late: np.ndarray | None = None) -> list[Episode]:
        return [
            Episode("e", time, np.zeros((len(time), 1)), np.zeros((len(time), 0)), np.zeros((len(time), 0)), late=late)
        ]

    assert not clocked(episodes(time), 0.0333)
    assert not clocked(episodes(np.round(time, 2)), 0.0333)
    assert not clocked(episodes(time, np.zeros((200, 1))), 0.0333)
    assert clocked(episodes(time, np.full((200, 1), 0.01)), 0.0333)
    assert clocked(episodes(time + np.random.default_rng(0).uniform(0, 0.01, 200)), 0.0333)


@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_derivatives_follow_the_clock_and_the_weights(weight: float) -> None:
    plan = setup(model(), recording(0.3, True)[0], (), [], 2)
    y, ok, u, start, spread = (a[0] for a in plan.windows.arrays)
    ok = ok.at[2::3].set(weight).at[5, 0].set(0.0)
    u = u.at[:, 3].max(0.3 * DT)  # v is late in the first row, too: the piece of a cut record begins so
    # the slope of an early value is of second order
    check_derivatives(plan, (y, ok, u, start, spread), 1e-3)


def test_a_weight_is_a_larger_noise() -> None:
    plan = setup(model(), recording(0.0, False)[0], (), [], 2)
    y, ok, u, start, spread = (a[0] for a in plan.windows.arrays)
    p, q = jnp.asarray(p_of(plan)), jnp.array([0.0, 0.1])
    light, _ = plan.rule.track(p, Noise(jnp.full(2, 0.05), q), y, 0.25 * ok, u, start, spread)
    loud, _ = plan.rule.track(p, Noise(jnp.full(2, 0.1), q), y, ok, u, start, spread)
    for a, b in zip(light, loud, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
