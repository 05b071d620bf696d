"""Noise whose scale goes with the row, `data.noise.scale`: its shape of rows and targets, and predictions row by row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.control.task import Task
from simpel_cli.control.world import learned_world
from simpel_cli.data import Measurements
from simpel_cli.data.recording import Episode, Recording, transitions
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.evaluation import Posterior, free_run
from simpel_cli.filtering.measurements.windows import windows_of
from simpel_cli.inference.noise_scale import LEAST, NoiseScale, noise_scale_of
from simpel_cli.inference.predictive import Predictive
from simulators.model import Quantity

RNG = np.random.default_rng(0)
ANGLE, SPEED, INPUT = (
    Quantity("phi", "rad", -np.pi, np.pi, periodic=True),
    Quantity("w", "rad/s", -4.0, 8.0),
    Quantity("u", "V", -1.0, 3.0),
)
READING = Quantity("q", "", np.nan, np.nan)
TURNING = Encoding((ANGLE, SPEED), (INPUT,), (READING,))
SHAPES = {"phi": "0.1 + abs(phi)", "w": "0.2 + u**2", "q": "where(q > 0, 0.5 + 0.1*q, 1 + w**2)"}


def scale_of(formulas: dict[str, object], encoding: Encoding = TURNING) -> NoiseScale:
    found = noise_scale_of(formulas, encoding)
    assert found is not None
    return found


def shape(phi: np.ndarray, w: np.ndarray, u: np.ndarray, q: np.ndarray) -> np.ndarray:
    phi = (phi + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([0.1 + np.abs(phi), 0.2 + u**2, np.where(q > 0, 0.5 + 0.1 * q, 1 + w**2)])


def turning(rows: int = 6, seed: int = 0) -> Episode:
    rng = np.random.default_rng(seed)
    states = np.column_stack([rng.uniform(-9, 9, rows), rng.uniform(-4, 8, rows)])
    return Episode(f"e{seed}", np.arange(rows) * 0.1, states, rng.uniform(-1, 3, (rows, 1)), rng.normal(size=(rows, 1)))


@pytest.mark.parametrize("tail", [None, jnp.array([0.3, 0.1])], ids=["gaussian", "student_t"])
def test_every_row_is_predicted_with_its_own_noise(tail: jax.Array | None) -> None:
    particles = jnp.asarray(RNG.normal(size=(5, 4, 2)))
    noise, y = jnp.asarray(RNG.uniform(0.2, 2, (4, 2))), jnp.asarray(RNG.normal(size=(4, 2)))
    found = Predictive(particles, noise, tail)
    for j in range(4):
        one, at = Predictive(particles[:, j : j + 1], noise[j], tail), y[j : j + 1]
        for name in ("log_prob", "log_prob_per_output", "cdf", "crps", "mahalanobis"):
            np.testing.assert_allclose(getattr(found, name)(y)[j], getattr(one, name)(at)[0], rtol=1e-12, err_msg=name)
        np.testing.assert_allclose(found.std[j], one.std[0], rtol=1e-12)
        np.testing.assert_allclose(found.noise_std[j], one.noise_std, rtol=1e-12)
    same = Predictive(particles, jnp.broadcast_to(noise[:1], (4, 2)), tail)
    np.testing.assert_array_equal(same.share_within(y), Predictive(particles, noise[0], tail).share_within(y))


def test_a_change_has_the_noise_of_both_its_rows() -> None:
    episodes = [turning(6, 1), turning(5, 2)]
    pairs = transitions(episodes, 0)
    found = scale_of(SHAPES).of_transitions(episodes, pairs)
    assert found.shape == (9, 4)
    for e, first in ((0, 0), (1, 5)):
        own = episodes[e]
        s = shape(own.states[:, 0], own.states[:, 1], own.inputs[:, 0], own.outputs[:, 0])
        change = np.sqrt((s[:-1, :2] ** 2 + s[1:, :2] ** 2) / 2)
        expected = np.column_stack([change[:, 0], change[:, 0], change[:, 1], s[:-1, 2]])
        np.testing.assert_allclose(found[first : first + len(expected)], expected, rtol=1e-12)


def test_rows_that_do_not_follow_each_other_end_in_their_next_states() -> None:
    after = turning(6, 5).states
    own = turning(6, 1)._replace(next_states=after)
    found = scale_of(SHAPES).of_transitions([own], transitions([own], 0))
    before, ends = (shape(s[:, 0], s[:, 1], own.inputs[:, 0], own.outputs[:, 0]) for s in (own.states, after))
    np.testing.assert_allclose(found[:, 0], np.sqrt((before[:, 0] ** 2 + ends[:, 0] ** 2) / 2), rtol=1e-12)


def test_what_is_predicted_takes_the_place_of_what_was_measured() -> None:
    """Where predictions are the measured values and the input stays, the scale is that of the measured transitions."""
    own = turning(6, 3)._replace(inputs=np.full((6, 1), 1.7))
    pairs = transitions([own], 0)
    scale = scale_of(SHAPES)
    x = TURNING.to_x(pairs.states, pairs.inputs)
    y = TURNING.to_y(pairs.states, pairs.next_states, pairs.outputs)
    expected = scale.of_transitions([own], pairs)
    np.testing.assert_allclose(scale.of_targets(x, y), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(scale.of_targets)(jnp.asarray(x), jnp.asarray(y)), expected, rtol=1e-9)
    narrow = jax.jit(scale.of_targets)(jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32))
    assert narrow.dtype == jnp.float32
    np.testing.assert_allclose(narrow, expected, rtol=1e-4)
    typical = np.sqrt(np.mean(expected**2, axis=0))
    np.testing.assert_allclose(np.mean(scale.relative(x, y, typical) ** 2, axis=0), 1, rtol=1e-9)


def test_a_scale_that_goes_to_zero_where_nothing_was_measured_stops_at_a_thousandth() -> None:
    static = Encoding((), (INPUT,), (READING,))
    scale = scale_of({"q": "abs(u)"}, static)
    np.testing.assert_allclose(
        scale.relative(np.array([[0.0], [3.0]]), np.zeros((2, 1)), np.array([2.0]))[:, 0], [LEAST, 1.5]
    )


def test_windows_count_values_by_their_noise_and_missing_ones_by_the_middle() -> None:
    train, test = turning(40, 1), turning(40, 2)
    train.states[3, 1] = np.nan
    measured = Recording((train,), (test,), ("q",), {}, (), (), ())
    scale = scale_of({"q": "0.5 + abs(w)", "w": "1 + 0.1*u"})
    found = scale.counted(measured)
    w = np.where(np.isfinite(train.states[:, 1]), train.states[:, 1], 2.0)  # the middle of [-4, 8]
    known = np.isfinite(train.states[:, 1])
    s_q, s_w = 0.5 + np.abs(w), 1 + 0.1 * train.inputs[:, 0]
    expected = np.column_stack([np.mean(s_w[known] ** 2) / s_w**2, np.mean(s_q**2) / s_q**2])
    windows = windows_of(
        found.train, ["phi", "w"], ["w", "q"], ["q"], np.zeros(2), np.ones(2), lead=1, dt=0.1, longest=30
    )
    ok = windows.ok.reshape(-1, 2)[: len(w)]
    expected[3, 0] = 0
    np.testing.assert_allclose(ok, expected, rtol=1e-12)
    again = scale.of_episode(test)[:, 2] / np.sqrt(np.mean(s_q**2))
    assert found.test[0].weight is not None
    np.testing.assert_allclose(found.test[0].weight[:, 2], again**-2, rtol=1e-12)
    assert (found.test[0].weight[:, 0] == 1).all()


def test_a_spike_in_what_the_noise_goes_with_is_no_wrong_expression_before_it_is_left_out() -> None:
    inputs = np.full((40, 1), 2.0)
    inputs[7] = -30.0
    train, test = turning(40, 1)._replace(inputs=inputs), turning(10, 2)._replace(inputs=np.full((10, 1), 4.0))
    measured = Recording((train,), (test,), ("q",), {}, (), (), ())
    scale = scale_of({"q": "u"})
    found = scale.counted(measured, spikes=True)
    np.testing.assert_allclose(found.train[0].weight[:, 2], 1.0)  # type: ignore[index]
    np.testing.assert_allclose(found.test[0].weight[:, 2], 0.25)  # type: ignore[index]
    with pytest.raises(DataError, match="is no positive number in 1 of 50 rows"):
        scale.counted(measured)
    mostly = measured._replace(train=(train._replace(inputs=-inputs),))
    with pytest.raises(DataError, match="is no positive number in 39 of 50 rows"):
        scale.counted(mostly, spikes=True)


CART = Encoding((Quantity("s", "m", -5.0, 5.0), Quantity("v", "m/s", -1.0, 1.0)), (Quantity("u", "V", -1.0, 1.0),))


def test_free_runs_have_the_noise_of_the_rows_they_reach() -> None:
    """A cart that moves by 1 in every step; its sensors are noisier far away and where the input is large."""
    scale, typical, sigma = scale_of({"s": "1 + s**2", "v": "2 + u"}, CART), np.array([2.0, 4.0]), np.array([0.1, 0.3])

    def members(x: np.ndarray) -> jax.Array:
        return jnp.asarray(np.broadcast_to([1.0, 0.0], (*x.shape[:-1], 2)))

    def typical_predict(x: np.ndarray) -> Predictive:
        return Predictive(members(np.asarray(x)[None]), jnp.asarray(sigma))

    def predict(x: np.ndarray) -> Predictive:
        found = typical_predict(x)
        return found._replace(noise_scale=jnp.asarray(sigma * scale.relative(x, np.asarray(found.mean), typical)))

    posterior = Posterior(predict, members, 1, typical_predict, lambda x, y: scale.relative(x, y, typical))
    rows = 9
    u = np.linspace(-1, 1, rows)[:, None]
    path = Episode(
        "a", np.arange(rows) * 0.1, np.column_stack([np.arange(rows) * 1.0, np.zeros(rows)]), u, np.zeros((rows, 0))
    )
    run = free_run(posterior, CART, (path,), 4)
    assert run is not None
    np.testing.assert_allclose(run.error, 0, atol=1e-12)
    for k, first in enumerate(run.row):
        at = path.states[first : first + 5, 0]
        np.testing.assert_allclose(run.std[k, :, 0], 0.1 * (1 + at**2) / 2, rtol=1e-9)
        inputs = u[[*range(first, first + 4), first + 3], 0]  # after the last step it is not known
        np.testing.assert_allclose(run.std[k, :, 1], 0.3 * (2 + inputs) / 4, rtol=1e-9)


def test_roll_outs_of_a_policy_have_the_noise_of_where_they_are() -> None:
    scale, typical = scale_of({"v": "0.1 + abs(s)"}, CART), np.ones(2)
    goal = Task(reward="-s**2", horizon=5, initial={"s": [-1, 1]}).bind(CART)
    world = learned_world(
        CART, goal, lambda x: jnp.zeros((*x.shape[:-1], 2), x.dtype), jnp.array([1e-9, 0.5]), 2, "tsinf",
        relative=lambda x, y: scale.relative(x, y, typical),
    )  # fmt: skip
    n = 4000
    begun = world.reset(jax.random.key(0), n)
    far = np.where(np.arange(n) % 2, 3.0, 0.0)
    begun = begun._replace(encoded=jnp.asarray(np.column_stack([far, np.zeros(n)]), begun.encoded.dtype))
    after = world.step(jax.random.key(1), begun, jnp.zeros((n, 1), begun.encoded.dtype)).situation.encoded[:, 1]
    for place in (0.0, 3.0):
        np.testing.assert_allclose(np.std(np.asarray(after)[far == place]), 0.5 * (0.1 + place), rtol=0.05)


STATIC = {"path": "a.csv"}


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        ("abs(y)", r"data\.noise\.scale: 'abs\(y\)' is not allowed, only expressions by name, e\.g\. \{y: 0\.01"),
        ({"y": "abs(y"}, r"data\.noise\.scale\.y: this is not a formula"),
        ({"y": None}, r"data\.noise\.scale\.y: None is not allowed, only an expression of the row or a positive number"),
        ({"y": 0}, r"data\.noise\.scale\.y: 0 is not allowed, only an expression .* 0\.01 \+ 0\.05\*abs\(y\), or leave y"),
        ({"y": [1, 2]}, r"data\.noise\.scale\.y: \[1, 2\] is not allowed, only an expression of the row or a positive number"),
        ({"y": True}, r"data\.noise\.scale\.y: True is not allowed"),
    ],
)  # fmt: skip
def test_what_is_no_expression_is_named_before_anything_is_read(scale: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Measurements(path="a.csv", noise={"scale": scale})


def test_what_is_no_law_is_named_as_it_was_given() -> None:
    with pytest.raises(
        ConfigError, match=r"data\.noise\.law: \['gaussian'\] is not allowed, only auto or gaussian or student_t"
    ):
        Measurements(path="a.csv", noise={"law": ["gaussian"]})


def test_only_what_has_noise_has_a_scale() -> None:
    config = Measurements(path="a.csv", noise={"scale": {"ww": "1"}})
    with pytest.raises(
        ConfigError, match=r"data\.noise\.scale\.ww: the simulator has no such state or output .* Did you mean w"
    ):
        config.check_names(("phi", "w", "q", "u"), ("phi", "w", "q"))
    with pytest.raises(
        ConfigError, match=r"data\.noise\.scale\.u: u is an input; only states and outputs are measured"
    ):
        Measurements(path="a.csv", noise={"scale": {"u": 1}}).check_names(("w", "u"), ("w",))
    with pytest.raises(ConfigError, match=r"data\.noise\.scale\.w: w was not measured, so that it has no noise"):
        noise_scale_of({"w": "1"}, TURNING, ("w",))


@pytest.mark.parametrize(
    ("formula", "message"),
    [
        ("0.1*abs(qq)", r"data\.noise\.scale\.q: unknown name 'qq'; known here: phi, q, u, w, pi\. Did you mean q"),
        ("r + 1", r"data\.noise\.scale\.q: r \+ 1 needs r, which was not measured\. Use one of phi, w, u, q"),
        ("1/0", r"data\.noise\.scale\.q: this part is not a finite number"),
        ("q^2", r"data\.noise\.scale\.q: `\^` is not allowed: write \*\* for a power"),
    ],
)  # fmt: skip
def test_names_that_an_expression_cannot_have(formula: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        noise_scale_of({"q": formula}, TURNING, ("r",))


@pytest.mark.parametrize(("formula", "value"), [("u - 1", "-0.5"), ("abs(u - 0.5)", "0"), ("log(u - 0.6)", "nan")])
def test_an_expression_that_is_no_scale_is_counted_in_rows(formula: str, value: str) -> None:
    train = turning(4, 1)._replace(inputs=np.array([[2.0], [2.5], [0.5], [2.7]]))
    test = turning(5, 2)._replace(inputs=np.full((5, 1), 2.0))
    measured = Recording((train,), (test,), ("q",), {}, (), (), ())
    with pytest.raises(
        DataError, match=rf"scale\.q: .* is no positive number in 1 of 9 rows \(it is {value} in row 2 of episode e1"
    ):
        scale_of({"q": formula}).refuse_wrong(measured)
    with pytest.raises(DataError, match="in 1 of 9 rows"):
        scale_of({"q": formula}).counted(measured)
    with pytest.raises(ConfigError, match="is no positive number everywhere in the ranges of the simulator"):
        scale_of({"q": formula}).of_ranges(np.full((1, 4), 0.5), np.zeros((1, 4)))
