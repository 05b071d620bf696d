"""Metrics of synthetic posteriors whose quality is known by construction, bootstrap intervals, and free runs."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, norm
from systems import model

from simpel_cli.data.recording import Episode
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.dynamics.transition import encoding_of, transition
from simpel_cli.evaluation import (
    CHUNK,
    Blocks,
    Posterior,
    blocks_of,
    bootstrap,
    chi_squared_quantile,
    free_run,
    free_run_table,
    one_step,
    one_step_table,
    windows,
)
from simpel_cli.inference.predictive import Predictive
from simulators.model import Quantity

N, DY = 3000, 2
ENCODING = Encoding((Quantity("a", "m", -1, 1), Quantity("b", "s", -1, 1)), (Quantity("u", "V", -1, 1),))
OUTPUTS = (*ENCODING.y_names, "joint")
NOISE = np.array([0.2, 3.0])
SPREAD = np.array([0.4, 1.5])  # of the targets


def synthetic(claimed: float, particles: int = 20) -> Posterior:
    """A Gaussian posterior that claims `claimed` times the true spread (that of N(x, noise^2)), half of it epistemic."""
    quantiles = norm.ppf((np.arange(particles) + 0.5) / particles)
    quantiles = quantiles / quantiles.std() / 2**0.5
    # outputs of a particle are uncorrelated over the particles
    offsets = np.column_stack([quantiles, np.random.default_rng(1).permutation(quantiles)]) * NOISE * claimed

    def predict(x: np.ndarray) -> Predictive:
        return Predictive(jnp.asarray(x[None, :, :DY] + offsets[:, None]), jnp.asarray(NOISE * claimed / 2**0.5))

    def members(x: np.ndarray) -> jax.Array:
        return jnp.asarray(x[..., :DY] + offsets[:, None])

    return Posterior(predict, members, particles)


@pytest.fixture(scope="module")
def data() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(N, ENCODING.dim_x))
    return x, x[:, :DY] + NOISE * rng.normal(size=(N, DY))


def rows_of(
    posterior: Posterior, data: tuple[np.ndarray, np.ndarray], encoding: Encoding = ENCODING
) -> list[dict[str, object]]:
    blocks = blocks_of(np.arange(N) // 10, np.zeros(N), 1, "s")
    return one_step_table(one_step(posterior, *data), blocks, encoding, SPREAD)


def table(posterior: Posterior, data: tuple[np.ndarray, np.ndarray]) -> dict[tuple[str, str], float]:
    rows = rows_of(posterior, data)
    return {(str(r["metric"]), str(r["output"])): float(r["value"]) for r in rows}  # type: ignore[arg-type]


def test_calibrated_posterior(data: tuple[np.ndarray, np.ndarray]) -> None:
    t = table(synthetic(1.0), data)
    for i, output in enumerate(OUTPUTS):
        assert abs(t["coverage_90", output] - 0.9) < 4 * (0.09 / N) ** 0.5
        assert t["coverage_90_low", output] < 0.9 < t["coverage_90_high", output]
        assert t["calibration_error", output] < 0.015
        if output != "joint":
            # entropy, CRPS sigma/sqrt(pi), mean absolute error sigma sqrt(2/pi), of a Gaussian
            assert t["nll", output] == pytest.approx(0.5 * np.log(2 * np.pi * np.e * NOISE[i] ** 2), abs=0.05)
            assert t["rmse", output] == pytest.approx(NOISE[i], rel=0.05)
            assert t["mae", output] == pytest.approx(NOISE[i] * (2 / np.pi) ** 0.5, rel=0.05)
            assert t["crps", output] == pytest.approx(NOISE[i] / np.pi**0.5, rel=0.05)
    assert t["rmse", "joint"] == pytest.approx(np.hypot(*NOISE), rel=0.05)
    assert t["nll", "joint"] == pytest.approx(t["nll", "a"] + t["nll", "b"], abs=0.05)
    # errors of half and of twice the spread, 0.2 m / 0.4 m and 3 s / 1.5 s
    for output, expected in zip(OUTPUTS, (0.5, 2.0, (4.25 / 2) ** 0.5), strict=True):
        assert t["nrmse", output] == pytest.approx(expected, rel=0.05)
        assert t["nrmse_low", output] < t["nrmse", output] < t["nrmse_high", output]


def test_joint_errors_have_a_unit_only_where_the_outputs_share_one(data: tuple[np.ndarray, np.ndarray]) -> None:
    def units(encoding: Encoding) -> dict[object, object]:
        return {r["metric"]: r["unit"] for r in rows_of(synthetic(1.0), data, encoding) if r["output"] == "joint"}

    both_m = Encoding((Quantity("a", "m", -1, 1), Quantity("b", "m", -1, 1)), ENCODING.inputs)
    for encoding, unit in ((ENCODING, "mixed"), (both_m, "m")):
        found = units(encoding)
        assert {found[m] for m in ("rmse", "mae", "crps", "rmse_low", "crps_high")} == {unit}
        assert (found["nll"], found["nrmse"], found["coverage_90"]) == ("nat", "1", "1")


@pytest.mark.parametrize(("claimed", "coverage"), [(0.5, 0.589), (2.0, 0.9990)])
def test_wrong_spread_shows(data: tuple[np.ndarray, np.ndarray], claimed: float, coverage: float) -> None:
    good, bad = table(synthetic(1.0), data), table(synthetic(claimed), data)
    for output in OUTPUTS:
        assert bad["calibration_error", output] > 0.1
        assert bad["nll", output] > good["nll", output] + 0.2
        assert bad["crps", output] > good["crps", output] * 1.02
    for output in OUTPUTS[:DY]:  # P(|z| < 1.645 claimed)
        assert abs(bad["coverage_90", output] - coverage) < 0.03
        assert bad["rmse", output] == pytest.approx(good["rmse", output], rel=1e-6)  # a matter of the mean alone


@pytest.mark.parametrize("degrees", [1, 2, 7])
def test_chi_squared_quantiles(degrees: int) -> None:
    levels = np.array([0.05, 0.5, 0.95])
    np.testing.assert_allclose(chi_squared_quantile(levels, degrees), chi2.ppf(levels, degrees), rtol=1e-10)


@pytest.mark.parametrize("n", [CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK + 7])
def test_chunks_do_not_show(data: tuple[np.ndarray, np.ndarray], n: int) -> None:
    x, y = (a[:n] for a in data)
    whole = one_step(synthetic(1.0), x, y)
    order = np.random.default_rng(0).permutation(n)
    shuffled = one_step(synthetic(1.0), x[order], y[order])
    for name, a, b in zip(whole._fields, whole, shuffled, strict=True):
        assert a.shape[0] == n, name
        np.testing.assert_allclose(a[order], b, rtol=1e-12, err_msg=name)
    one = one_step(synthetic(1.0), x[-1:], y[-1:])
    np.testing.assert_allclose(one.nll[0], whole.nll[-1], rtol=1e-12)


def correlated(rng: np.random.Generator, blocks: int, length: int) -> np.ndarray:
    """Values with mean 0.3 of which half of the variance is shared within a block."""
    return 0.3 + np.repeat(rng.normal(size=blocks), length) + rng.normal(size=blocks * length)


def test_intervals_cover_the_mean_of_correlated_points_as_often_as_they_say() -> None:
    n_blocks, length, repeats = 40, 10, 300
    episode = np.repeat(np.arange(n_blocks), length)
    row = np.tile(np.arange(length), n_blocks)
    by_block = blocks_of(episode, row, length, "rows")
    by_point = Blocks(np.arange(len(row)), "points")
    rng = np.random.default_rng(0)
    hits = np.zeros(2)
    for _ in range(repeats):
        points = correlated(rng, n_blocks, length)
        for k, blocks in enumerate((by_block, by_point)):
            estimate = bootstrap(points, blocks, lambda m: m, resamples=400)
            assert estimate.value == pytest.approx(points.mean(), rel=1e-12)
            hits[k] += estimate.low < 0.3 < estimate.high
    covered = hits / repeats
    # three standard errors of a proportion, and 2 % that a percentile interval over 40 blocks is known to be short
    assert 0.95 - 0.02 - 3 * (0.05 * 0.95 / repeats) ** 0.5 < covered[0] < 0.99
    assert covered[1] < 0.75  # points taken for independent: far too short


def test_interval_has_the_width_of_the_standard_error() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=4000)
    estimate = bootstrap(points, Blocks(np.arange(4000), "points"), lambda m: m)
    assert estimate.high - estimate.low == pytest.approx(2 * 1.96 * points.std() / 4000**0.5, rel=0.1)


def test_statistic_is_of_the_mean() -> None:
    points = np.array([1.0, 9.0, 9.0, 9.0])
    estimate = bootstrap(points, Blocks(np.array([0, 0, 1, 1]), "blocks"), np.sqrt)
    assert estimate == (7.0**0.5, 5.0**0.5, 3.0)


def test_blocks() -> None:
    row = np.tile(np.arange(25), 2)
    few = blocks_of(np.repeat(["c", "a"], 25), row, 10, "rows")
    np.testing.assert_array_equal(np.bincount(few.of_point), [10, 10, 5] * 2)
    assert (few.kind, str(few)) == ("windows of 10 rows", "6 windows of 10 rows")
    many = blocks_of(np.repeat(np.arange(12), 5), np.tile(np.arange(5), 12), 2, "rows")
    assert (many.kind, str(many)) == ("episodes", "12 episodes")


def test_windows_of_time_start_with_the_episode_and_do_not_see_rounding() -> None:
    time = np.concatenate([7.3 + 0.1 * np.arange(40), 100.05 + 0.1 * np.arange(20)])
    blocks = blocks_of(np.repeat(["a", "b"], [40, 20]), time, 1.0, "s")
    np.testing.assert_array_equal(np.bincount(blocks.of_point), [10] * 6)
    assert blocks.kind == "windows of 1 s"
    assert "nothing" in str(blocks_of(np.repeat("a", 40), time[:40], 10.0, "s"))


# Free runs


PENDULUM = model("pendulum", m=0.8, l=1.2, C_m=1.0)
HORIZON = 40
ALONE = Blocks(np.arange(6), "runs")


def episodes(stack: int, count: int = 2, length: int = 100) -> tuple[Episode, ...]:
    """Driven swings through the hanging position (phi = pi), with angles that run on; the action of `stack` steps ago acts."""
    encoding = encoding_of(PENDULUM)
    step = jax.jit(transition(PENDULUM, encoding).step)
    rng = np.random.default_rng(0)
    made = []
    for i in range(count):
        inputs = rng.uniform(-2.5, 2.5, (length, 1))
        states = [np.array([3.0, 4.5 + i])]
        for t in range(length - 1):
            x = encoding.to_x(states[-1], inputs[max(t - stack, 0)])
            after = encoding.decode(x[:3] + np.asarray(step(jnp.asarray(x), jnp.zeros(0))))
            turn = (after[0] - states[-1][0] + np.pi) % (2 * np.pi) - np.pi
            states.append(np.array([states[-1][0] + turn, after[1]]))
        made.append(Episode(str(i), np.arange(length) * 0.05, np.array(states), inputs, np.zeros((length, 0))))
    return tuple(made)


def perfect(encoding: Encoding, pick: Callable[[jax.Array], jax.Array], bias: tuple[float, ...] = (0.0,)) -> Posterior:
    """The pendulum itself as posterior; particle l accelerates by bias l too much. `pick` chooses the input that acts."""
    one = transition(PENDULUM, encoding_of(PENDULUM)).step
    offsets = jnp.asarray(bias)[:, None, None] * jnp.array([0.0, 0.0, 1.0])[None, None]

    @jax.jit
    def members(x: jax.Array) -> jax.Array:
        plain = jnp.concatenate([x[..., :3], pick(x[..., 3:])], axis=-1)
        return jax.vmap(jax.vmap(lambda x: one(x, jnp.zeros(0))))(plain) + offsets

    def predict(x: np.ndarray) -> Predictive:
        return Predictive(members(np.tile(x[None], (len(bias), 1, 1))), jnp.array([0.003, 0.004, 0.05]))

    return Posterior(predict, members, len(bias))


def test_free_run_of_the_truth_has_no_error() -> None:
    encoding = encoding_of(PENDULUM)
    measured = episodes(0)
    assert (
        measured[0].states[:, 0].min() < 3.0 < 2 * np.pi - 3.0 < measured[0].states[:, 0].max()
    )  # passes the wrap at pi
    run = free_run(perfect(encoding, lambda u: u), encoding, measured, HORIZON)
    assert run is not None
    assert run.error.shape == (2 * 3, HORIZON + 1, 2)
    np.testing.assert_allclose(run.error, 0, atol=1e-9)
    # without spread, the noise is left; the variance of the angle is the sum of those of its pair
    np.testing.assert_allclose(run.std[..., 0], 0.005, rtol=1e-6)
    np.testing.assert_allclose(run.std[..., 1], 0.05, rtol=1e-6)
    rows = {(r["metric"], r["output"]): r["value"] for r in free_run_table(run, ALONE, encoding, 0.05)}
    assert rows["free_run_rmse@2s", "phi"] == pytest.approx(0, abs=1e-9)
    assert {m for m, _ in rows} >= {"free_run_rmse@0.5s", "free_run_rmse@1s", "free_run_rmse@2s_high"}


def test_free_run_sees_the_stack_of_past_actions() -> None:
    encoding = encoding_of(PENDULUM, stack=2)
    measured = episodes(2)
    oldest = free_run(perfect(encoding, lambda u: u[..., :1]), encoding, measured, HORIZON)
    newest = free_run(perfect(encoding, lambda u: u[..., -1:]), encoding, measured, HORIZON)
    assert oldest is not None
    assert newest is not None
    np.testing.assert_allclose(oldest.error, 0, atol=1e-9)
    assert np.abs(newest.error).max() > 0.1
    assert oldest.row.min() == 2  # the first rows have no such past


def test_particles_follow_their_own_paths() -> None:
    encoding = encoding_of(PENDULUM)
    run = free_run(perfect(encoding, lambda u: u, (-0.02, 0.02)), encoding, episodes(0), HORIZON)
    assert run is not None
    spread = np.sqrt(run.std[..., 1] ** 2 - 0.05**2)
    np.testing.assert_allclose(spread[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(spread[:, 1], 0.02, rtol=1e-6)  # after one step, half of the distance of the two
    assert np.all(spread[:, 5] > 3 * 0.02)
    assert np.all(np.abs(run.error[:, 1, 1]) < 1e-9)  # the mean of the two is right


def test_direction_is_averaged_on_the_circle() -> None:
    encoding = encoding_of(PENDULUM)
    still = Episode("0", np.arange(9) * 0.05, np.tile([np.pi - 0.01, 0.0], (9, 1)), np.zeros((9, 1)), np.zeros((9, 0)))
    apart = jnp.array([-0.1, 0.1])[:, None, None]

    def members(x: np.ndarray) -> jax.Array:
        angle = jnp.arctan2(jnp.asarray(x[..., :1]), jnp.asarray(x[..., 1:2])) + apart
        after = jnp.concatenate([jnp.sin(angle), jnp.cos(angle), jnp.zeros_like(angle)], axis=-1)
        return after - jnp.asarray(x[..., :3])

    posterior = Posterior(lambda x: Predictive(members(np.tile(x[None], (2, 1, 1))), jnp.zeros(3)), members, 2)
    run = free_run(posterior, encoding, (still,), 3)
    assert run is not None
    # one particle turns to either side and passes pi; the mean stays, the spread grows by 0.1 a step
    np.testing.assert_allclose(run.error[..., 0], 0, atol=1e-9)
    np.testing.assert_allclose(run.std[..., 0], np.tile([0, 0.1, 0.2, 0.3], (len(run.std), 1)), atol=1e-9)


def test_windows_overlap_by_half_and_fit() -> None:
    assert windows(episodes(0, count=1, length=100), 40, 0) == [(0, 0), (0, 20), (0, 40)]
    assert windows(episodes(0, count=1, length=41), 40, 0) == [(0, 0)]
    assert windows(episodes(0, count=1, length=41), 40, 1) == []
    encoding = encoding_of(PENDULUM)
    assert free_run(perfect(encoding, lambda u: u), encoding, episodes(0, length=40), 40) is None
