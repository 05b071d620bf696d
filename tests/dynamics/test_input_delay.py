"""Delayed and lagged inputs against their exact answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import lfilter

from simpel_cli.dynamics.between_rows import WAY
from simpel_cli.dynamics.input_delay import as_read, delayed_inputs, play, slewed

DT, SUBSTEPS, LEAD = 0.1, 4, 8
U = np.random.default_rng(0).normal(size=(LEAD + 12, 1))


def arrived(delay: float, lag: float, u: np.ndarray = U) -> np.ndarray:
    out = delayed_inputs(jnp.asarray(u), jnp.array([delay]), jnp.array([lag]), dt=DT, substeps=SUBSTEPS, lead=LEAD)
    return np.asarray(out)[:, :, 1, 0]  # the mean


def staircase(t: np.ndarray) -> np.ndarray:
    return U[np.clip(np.floor(t / DT + 1e-12).astype(int), 0, len(U) - 1), 0]


def means(delay: float, fine: int = 4000) -> np.ndarray:
    """Mean over every substep of the input that was given `delay` ago, by brute force."""
    h = DT / SUBSTEPS
    edges = LEAD * DT + np.arange((len(U) - LEAD) * SUBSTEPS) * h
    offsets = (np.arange(fine) + 0.5) / fine * h
    return staircase(edges[:, None] + offsets - delay).mean(axis=1).reshape(-1, SUBSTEPS)


def test_nothing_happens_without_delay_and_lag() -> None:
    np.testing.assert_allclose(arrived(0.0, 0.0), np.repeat(U[LEAD:], SUBSTEPS, axis=1), rtol=1e-12)


def test_a_delay_of_whole_rows_shifts_them() -> None:
    np.testing.assert_allclose(
        arrived(3 * DT, 0.0), np.repeat(U[LEAD - 3 : -3], SUBSTEPS, axis=1), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("delay", [0.013, 0.05, 0.137, 0.21])
def test_a_delay_below_a_row_is_the_mean_of_what_arrives(delay: float) -> None:
    np.testing.assert_allclose(arrived(delay, 0.0), means(delay), atol=2e-3)


@pytest.mark.parametrize("lag", [0.02, 0.15, 0.6])
def test_a_lag_is_the_solution_of_its_equation(lag: float) -> None:
    h = DT / SUBSTEPS
    w, exact = U[0, 0], []
    for u in np.repeat(U[:, 0], SUBSTEPS):
        keep = np.exp(-h / lag)
        exact.append(u + (w - u) * (1 - keep) * lag / h)
        w = u + (w - u) * keep
    np.testing.assert_allclose(arrived(0.0, lag).ravel(), np.array(exact)[LEAD * SUBSTEPS :], rtol=1e-9)


@pytest.mark.parametrize(
    ("delay", "lag"), [(0.013, 0.0), (0.06, 0.0), (0.137, 0.0), (0.21, 0.0), (0.0, 0.02), (0.137, 0.04)]
)
def test_a_line_has_the_first_moment_of_what_arrives(delay: float, lag: float) -> None:
    """So a speed moves as far as it does, and a position shows when. A lag answers the line, where a delay comes before it."""
    fine, h = 4000, DT / SUBSTEPS
    t = (np.arange(len(U) * SUBSTEPS * fine) + 0.5) * h / fine
    given, keep = staircase(t - delay), np.exp(-h / fine / lag) if lag else 0.0
    at = np.asarray(lfilter([1 - keep], [1, -keep], given, zi=[keep * given[0]])[0])
    pieces = at.reshape(-1, fine)[LEAD * SUBSTEPS :]
    place = (np.arange(fine) + 0.5) / fine - 0.5
    out = delayed_inputs(jnp.asarray(U), jnp.array([delay]), jnp.array([lag]), dt=DT, substeps=SUBSTEPS, lead=LEAD)
    line = np.asarray(out)[..., 0].reshape(-1, 3)
    np.testing.assert_allclose(line[:, 1], pieces.mean(axis=1), atol=2e-3)
    np.testing.assert_allclose(
        line[:, 2] - line[:, 0], 12 * (pieces * place).mean(axis=1), atol=0.025 if delay and lag else 6e-3
    )
    np.testing.assert_allclose(line[:, 1], (line[:, 0] + line[:, 2]) / 2, rtol=1e-9)
    assert np.abs(line[:, 2] - line[:, 0]).max() > 0.1


def test_a_line_keeps_to_the_range_of_its_input_and_to_its_mean() -> None:
    """Beyond it a root may not be defined; a value that was given is within."""
    u = np.repeat([0.0, 1.0, 0.0, 0.4, 1.0, 0.0], 2)[:, None]
    more = {"dt": DT, "substeps": 2, "lead": 2}
    late = jnp.array([0.03]), jnp.array([0.0])
    free = np.asarray(delayed_inputs(jnp.asarray(u), *late, **more))[..., 0]
    kept = np.asarray(delayed_inputs(jnp.asarray(u), *late, **more, ranges=[(0.0, 0.9)]))[..., 0]
    assert free.min() < -0.1
    assert free.max() > 1.1
    assert kept.min() >= 0  # not even by what was rounded
    assert kept.max() <= 1
    np.testing.assert_allclose(kept[:, :, 1], free[:, :, 1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(kept[:, :, 0] + kept[:, :, 2], 2 * kept[:, :, 1], rtol=1e-12, atol=1e-12)
    within = (free.min(axis=2) >= 0) & (free.max(axis=2) <= 1)
    assert within.any()
    np.testing.assert_allclose(kept[within], free[within], rtol=1e-12, atol=1e-12)


def test_readings_go_by_the_mean_of_what_is_held() -> None:
    u = np.concatenate([U, 0.5 * U], axis=1)
    late = jnp.array([0.03, 0.0]), jnp.array([0.0, 0.0])
    out = delayed_inputs(jnp.asarray(u), *late, dt=DT, substeps=SUBSTEPS, lead=LEAD, linear=(1,))
    read = as_read(out, (1,))
    np.testing.assert_array_equal(read[..., 1], out[..., 1])
    np.testing.assert_array_equal(read[..., 0], jnp.broadcast_to(out[:, :, 1:2, 0], out.shape[:3]))
    np.testing.assert_array_equal(as_read(out, ()), out[:, :, 1:2])
    np.testing.assert_array_equal(as_read(out[0], (1,), 1), read[0])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.05, 0.0), (0.0, 1e-9), (0.1, 0.02)])
def test_what_begins_to_be_late_has_a_derivative(delay: float, lag: float, dtype: jnp.dtype) -> None:
    def arriving(late: jax.Array) -> jax.Array:
        return delayed_inputs(jnp.asarray(U, dtype), late[:1], late[1:], dt=DT, substeps=SUBSTEPS, lead=LEAD)

    at = jnp.array([delay, lag], dtype)
    for way in jnp.eye(2, dtype=dtype):
        slope = jax.jvp(arriving, (at,), (way,))[1]
        step = (arriving(at + 1e-3 * way) - arriving(at)) / 1e-3
        assert float(jnp.abs(slope).max()) > 1
        np.testing.assert_allclose(slope, step, atol=0.15 * float(jnp.abs(step).max()))


@pytest.mark.parametrize("at", [(0.137, 0.0), (0.06, 0.2), (0.313, 0.07)])
def test_derivatives_are_those_of_differences(at: tuple[float, float]) -> None:
    def total(times: jax.Array) -> jax.Array:
        out = delayed_inputs(jnp.asarray(U), times[:1], times[1:], dt=DT, substeps=SUBSTEPS, lead=LEAD)
        return jnp.sum(out * jnp.arange(out.size, dtype=out.dtype).reshape(out.shape))

    gradient = np.asarray(jax.grad(total)(jnp.array(at)))
    for i, step in enumerate((1e-6, 1e-6)):
        move = np.eye(2)[i] * step
        if at[i] == 0:
            continue
        slope = (total(jnp.array(at + move)) - total(jnp.array(at - move))) / (2 * step)
        np.testing.assert_allclose(gradient[i], slope, rtol=1e-5)


def played(half: float, u: np.ndarray = U) -> np.ndarray:
    """The play operator as it is written down."""
    v, out = u[0, 0], []
    for now in u[:, 0]:
        v = min(now + half, max(now - half, v))
        out.append(v)
    return np.array(out)


@pytest.mark.parametrize("half", [0.0, 0.3, 1.1])
def test_a_play_is_the_play_operator(half: float) -> None:
    np.testing.assert_allclose(play(jnp.asarray(U), jnp.array([half]))[:, 0], played(half), rtol=1e-12)


def test_a_play_is_crossed_once_per_reversal() -> None:
    u = np.array([0.0, 1.0, 2.0, 1.8, 1.2, 0.0, 0.3, 3.0])[:, None]
    np.testing.assert_allclose(play(jnp.asarray(u), jnp.array([0.5]))[:, 0], [0, 0.5, 1.5, 1.5, 1.5, 0.5, 0.5, 2.5])


def test_a_play_comes_before_delay_and_lag() -> None:
    both = delayed_inputs(
        jnp.asarray(U), jnp.array([0.137]), jnp.array([0.2]), dt=DT, substeps=SUBSTEPS, lead=LEAD,
        half_play=jnp.array([0.4]),
    )  # fmt: skip
    np.testing.assert_allclose(np.asarray(both)[:, :, 1, 0], arrived(0.137, 0.2, played(0.4)[:, None]), rtol=1e-12)


@pytest.mark.parametrize("half", [0.0, 0.3])
def test_the_slope_in_a_play_is_that_of_a_growing_one(half: float) -> None:
    steps = jnp.arange(1.0, len(U) + 1)
    staying = np.repeat(U, 2, axis=0)[: len(U)]  # inputs that are held for two rows
    total = lambda c: jnp.sum(play(jnp.asarray(staying), c[None])[:, 0] * steps)  # noqa: E731
    slope = (total(jnp.asarray(half + 1e-6)) - total(jnp.asarray(half))) / 1e-6
    assert abs(slope) > 1
    np.testing.assert_allclose(jax.grad(total)(jnp.asarray(half)), slope, rtol=1e-5)


@pytest.mark.parametrize("rows", [0, 1, 2, 3])
def test_a_delay_of_whole_rows_is_that_however_it_is_compiled(rows: int) -> None:
    """In single precision a quotient of times falls to either side of a whole number."""
    dt, inputs = 1 / 30, jax.random.uniform(jax.random.key(0), (64, 4, 2), jnp.float32, -1, 1)
    late = jnp.full(2, rows * 0.1 / 3, jnp.float32)

    def arrived(u: jax.Array, delay: jax.Array) -> jax.Array:
        return delayed_inputs(u, delay, jnp.zeros(2, jnp.float32), dt=dt, substeps=3, lead=3)[0]

    found = jax.jit(jax.vmap(arrived, in_axes=(0, None)))(inputs, late)
    for stage, most in ((0, 3e-5), (1, 5e-6), (2, 3e-5)):
        np.testing.assert_allclose(found[:, :, stage], np.repeat(inputs[:, 3 - rows][:, None], 3, axis=1), atol=most)


def driven(u: np.ndarray, slowness: float, *, linear: bool, fine: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """An actuator of limited rate in small steps: its mean over every row, and where it is at the row."""
    v, means, at_rows = u[0], [], []
    for k in range(len(u)):
        total = 0.0
        at_rows.append(v)
        following = u[min(k + 1, len(u) - 1)]
        for i in range(fine):
            wanted = u[k] + (following - u[k]) * (i + 0.5) / fine if linear else u[k]
            before, v = v, v + np.clip(wanted - v, -DT / fine / slowness, DT / fine / slowness)
            total += (before + v) / 2
        means.append(total / fine)
    return np.array(means), np.array(at_rows)


@pytest.mark.parametrize("rows", [0.3, 1.0, 2.7])
def test_an_actuator_of_limited_rate_is_one_in_small_steps(rows: float) -> None:
    slowness = rows * DT / np.abs(np.diff(U[:, 0])).max()
    held = slewed(jnp.asarray(U), jnp.array([slowness]), DT)[:, 0]
    np.testing.assert_allclose(held, driven(U[:, 0], slowness, linear=False)[0], atol=1e-3)
    smooth = np.sin(0.25 * np.arange(40.0))  # turns, and is caught up with
    slowness = rows * DT / np.abs(np.diff(smooth)).max()
    line = slewed(jnp.asarray(smooth)[:, None], jnp.array([slowness]), DT, jnp.ones(1))[:, 0]
    np.testing.assert_allclose(line, driven(smooth, slowness, linear=True)[1], atol=0.02)


def test_a_rate_without_limit_changes_nothing_and_its_slope_is_that_of_one_that_begins() -> None:
    np.testing.assert_array_equal(slewed(jnp.asarray(U), jnp.zeros(1), DT), U)
    total = lambda s: jnp.sum(slewed(jnp.asarray(U), s[None], DT)[:, 0] * jnp.arange(1.0, len(U) + 1))  # noqa: E731
    for at in (0.0, 0.04):
        slope = (total(jnp.asarray(at + 1e-7)) - total(jnp.asarray(at))) / 1e-7
        assert abs(slope) > 1
        np.testing.assert_allclose(jax.grad(total)(jnp.asarray(at)), slope, rtol=1e-4)


@pytest.mark.parametrize("linear", [(), (0,)])
def test_a_limited_rate_comes_before_delay_and_lag(linear: tuple[int, ...]) -> None:
    given = U if not linear else np.concatenate([U, U[-1:]])
    slow, times = jnp.array([0.07]), (jnp.array([0.137]), jnp.array([0.2]))
    both = delayed_inputs(jnp.asarray(given), *times, dt=DT, substeps=SUBSTEPS, lead=LEAD, slowness=slow, linear=linear)
    first = slewed(jnp.asarray(given), slow, DT, jnp.ones(1) if linear else None)
    after = delayed_inputs(first, *times, dt=DT, substeps=SUBSTEPS, lead=LEAD, linear=linear)
    np.testing.assert_allclose(both, after, rtol=1e-12)
    assert (
        np.abs(
            both - delayed_inputs(jnp.asarray(given), *times, dt=DT, substeps=SUBSTEPS, lead=LEAD, linear=linear)
        ).max()
        > 0.1
    )


def curve(t: np.ndarray, rows: int) -> np.ndarray:
    """What is smooth between rows, with slopes of fourth order; it stood still before the first row."""
    given = np.concatenate([np.repeat(U[:1, 0], 3 * LEAD), U[:rows, 0]])
    near = np.concatenate([given[:1], given[:1], given])
    for _ in range(2):  # the parabola of the last three
        near = np.append(near, 3 * near[-1] - 3 * near[-2] + near[-3])
    slopes = (8 * (near[3:-1] - near[1:-3]) - (near[4:] - near[:-4])) / (12 * DT)
    return CubicHermiteSpline((np.arange(len(given)) - 3 * LEAD) * DT, given, slopes)(t)


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.137, 0.21])
@pytest.mark.parametrize("asked", [True, False])
def test_a_smooth_input_is_where_its_curve_is(delay: float, asked: bool) -> None:
    way = {"way": jnp.array([WAY["smooth"]])} if asked else {"smooth": (0,)}
    late = jnp.array([delay]), jnp.array([0.0])
    out = np.asarray(delayed_inputs(jnp.asarray(U), *late, dt=DT, substeps=SUBSTEPS, lead=LEAD, linear=(0,), **way))
    h = DT / SUBSTEPS
    begin = LEAD * DT + np.arange((len(U) - 1 - LEAD) * SUBSTEPS) * h
    np.testing.assert_allclose(
        out[..., 0].reshape(-1, 3), curve(begin[:, None] + h * np.array([0, 0.5, 1]) - delay, len(U)), atol=1e-9
    )
    if delay == 0:  # at the rows it is what was measured
        np.testing.assert_allclose(out[:, 0, 0, 0], U[LEAD:-1, 0], atol=1e-12)


def test_what_lags_behind_a_smooth_input_follows_its_curve() -> None:
    late, lag, h = jnp.array([0.0]), 0.07, DT / SUBSTEPS
    out = delayed_inputs(
        jnp.asarray(U), late, late + lag, dt=DT, substeps=SUBSTEPS, lead=LEAD, linear=(0,), smooth=(0,)
    )
    fine, w, rows = 400, float(curve(np.array([-LEAD * DT]), len(U))[0]), []
    times = np.arange(-LEAD * SUBSTEPS * fine, (len(U) - 1) * SUBSTEPS * fine) * h / fine
    keep = np.exp(-h / fine / lag)
    for u in curve(times + h / fine / 2, len(U)):
        rows.append(w)
        w = u + (w - u) * keep
    means = np.array(rows[2 * LEAD * SUBSTEPS * fine :]).reshape(-1, fine).mean(axis=1)
    np.testing.assert_allclose(np.asarray(out)[..., 1, 0].ravel(), means, atol=0.01)


def test_a_record_that_begins_is_followed_back_by_its_parabola() -> None:
    """What repeats the first value in front of a record is no measurement."""
    u = np.arange(-1.0, 6.0)[:, None] ** 2
    u = np.concatenate([np.repeat(u[:1], 3, axis=0), u])
    none = jnp.zeros(1), jnp.zeros(1)
    out = delayed_inputs(jnp.asarray(u), *none, dt=DT, substeps=SUBSTEPS, lead=3, linear=(0,), smooth=(0,))
    at = -1 + (np.arange(6 * SUBSTEPS) + 0.5) / SUBSTEPS
    np.testing.assert_allclose(np.asarray(out)[:, :, 1, 0].ravel(), at**2, atol=1e-12)
    known = delayed_inputs(
        jnp.asarray(u).at[1].add(1e-9), *none, dt=DT, substeps=SUBSTEPS, lead=3, linear=(0,), smooth=(0,)
    )
    assert np.abs(np.asarray(known - out)[0]).max() > 1e-3  # here the past is known, and it stood still


def test_without_a_past_the_first_row_bends_as_a_parabola_does() -> None:
    u = (np.arange(6.0) ** 2)[:, None]
    none = jnp.zeros(1), jnp.zeros(1)
    out = delayed_inputs(jnp.asarray(u), *none, dt=DT, substeps=SUBSTEPS, lead=0, linear=(0,), smooth=(0,))
    at = (np.arange(5 * SUBSTEPS) + 0.5) / SUBSTEPS
    np.testing.assert_allclose(np.asarray(out)[:, :, 1, 0].ravel(), at**2, atol=1e-12)


def test_every_word_is_a_place_on_the_way() -> None:
    late = jnp.array([0.013]), jnp.array([0.04])
    more = {"dt": DT, "substeps": SUBSTEPS, "lead": LEAD}
    asked = {w: delayed_inputs(jnp.asarray(U), *late, **more, linear=(0,), way=jnp.array([WAY[w]])) for w in WAY}
    np.testing.assert_allclose(asked["linear"], delayed_inputs(jnp.asarray(U), *late, **more, linear=(0,)), rtol=1e-9)
    held = delayed_inputs(jnp.asarray(U[:-1]), *late, **more, rising=False)
    np.testing.assert_allclose(asked["held"][:, :, 1:2], held, rtol=1e-9)
