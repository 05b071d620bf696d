"""Coordinates of the learning problem and the box that they live in."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simpel_cli.dynamics.domain import Domain
from simpel_cli.dynamics.encoding import Encoding
from simulators.model import Quantity

# an angle between two plain states: order matters
ENCODING = Encoding(
    states=(
        Quantity("v", "m/s", -1, 3),
        Quantity("phi", "rad", -np.pi, np.pi, periodic=True),
        Quantity("z", "m", 4, 5),
    ),
    inputs=(Quantity("u", "V", -2, 2), Quantity("w", "N", 0, 10)),
    outputs=(Quantity("load", "kg", np.nan, np.nan),),
    stack=1,
)
STATES = np.array([[0.5, 3.0, 4.2], [-1.0, -3.1, 4.9], [2.0, 0.0, 4.0]])
INPUTS = np.arange(12.0).reshape(3, 4)


def test_dimensions_names_units() -> None:
    assert (ENCODING.dim_state, ENCODING.dim_x, ENCODING.dim_y) == (4, 8, 5)
    assert ENCODING.y_names == ("v", "sin(phi)", "cos(phi)", "z", "load")
    assert ENCODING.y_units == ("m/s", "1", "1", "m", "kg")
    np.testing.assert_array_equal(ENCODING.per_target({"phi": 2.0, "load": 3.0}, 0.5), [0.5, 2, 2, 0.5, 3])


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_encode_and_decode_are_inverse(kind: Any) -> None:
    encoded = ENCODING.encode(kind(STATES))
    np.testing.assert_allclose(encoded[:, 1] ** 2 + encoded[:, 2] ** 2, 1, rtol=1e-12)
    np.testing.assert_allclose(encoded[:, [0, 3]], STATES[:, [0, 2]], rtol=0)
    np.testing.assert_allclose(ENCODING.decode(encoded), STATES, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ENCODING.decode(ENCODING.encode(kind(STATES[0]))), STATES[0], rtol=1e-12)
    assert isinstance(encoded, np.ndarray) == isinstance(kind(STATES), np.ndarray)


def test_angles_come_back_in_one_turn() -> None:
    wound = STATES + np.array([0, 4 * np.pi, 0])
    np.testing.assert_allclose(ENCODING.decode(ENCODING.encode(wound)), STATES, rtol=1e-12, atol=1e-12)


def test_decode_takes_pairs_off_the_unit_circle() -> None:
    encoded = ENCODING.encode(STATES) * np.array([1, 0.3, 0.3, 1])
    np.testing.assert_allclose(ENCODING.decode(encoded), STATES, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_inputs_and_targets(kind: Any) -> None:
    x = ENCODING.to_x(kind(STATES), kind(INPUTS))
    assert x.shape == (3, ENCODING.dim_x)
    states, stacked = ENCODING.split_x(x)
    np.testing.assert_allclose(states, STATES, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(stacked, INPUTS, rtol=0)
    after = STATES + np.array([0.1, 0.4, -0.2])  # the first angle passes pi
    y = ENCODING.to_y(kind(STATES), kind(after), kind(np.full((3, 1), 7.0)))
    np.testing.assert_allclose(y[:, [0, 3, 4]], np.tile([0.1, -0.2, 7.0], (3, 1)), rtol=1e-12)
    np.testing.assert_allclose(y[:, 1], np.sin(after[:, 1]) - np.sin(STATES[:, 1]), rtol=1e-12)
    reached = ENCODING.advance(ENCODING.encode(kind(STATES)), y)
    np.testing.assert_allclose(reached, ENCODING.encode(after), rtol=1e-12, atol=1e-12)


def test_advance_stays_on_the_unit_circle() -> None:
    wrong = np.tile([0.0, 0.3, 0.4, 0.0, 0.0], (3, 1))
    reached = ENCODING.advance(ENCODING.encode(STATES), wrong)
    np.testing.assert_allclose(np.hypot(reached[:, 1], reached[:, 2]), 1, rtol=1e-12)
    off = ENCODING.encode(STATES) + wrong[:, :4]
    np.testing.assert_allclose(ENCODING.decode(reached), ENCODING.decode(off), rtol=1e-12)  # same direction


def test_static_function_has_no_state() -> None:
    static = Encoding((), (Quantity("x", "1", -5, 5),), (Quantity("f", "1", np.nan, np.nan),))
    x = static.to_x(np.zeros((3, 0)), np.ones((3, 1)))
    assert (static.dim_state, x.shape, static.y_names) == (0, (3, 1), ("f",))
    assert static.y_kinds == ("value",)
    assert ENCODING.y_kinds == ("change",) * 4 + ("value",)
    assert static.to_y(np.zeros((3, 0)), np.zeros((3, 0)), np.ones((3, 1))).shape == (3, 1)


def test_domain_is_uniform_in_the_declared_box() -> None:
    domain = Domain(ENCODING)
    low, high = domain.bounds()
    np.testing.assert_allclose(low, [-1, -np.pi, 4, -2, 0, -2, 0])
    np.testing.assert_allclose(high, [3, np.pi, 5, 2, 10, 2, 10])
    n = 20_000
    x = np.asarray(domain.sample(jax.random.key(0), n, jnp.float64))
    mean, std = domain.x_moments()
    # four standard errors of a mean; of a standard deviation at kurtosis 1.8 (uniform) and 1.5 (sine) less than that
    assert np.all(np.abs(x.mean(axis=0) - mean) < 4 * std / n**0.5)
    np.testing.assert_allclose(x.std(axis=0), std, rtol=4 * 0.5 / n**0.5)
    states, inputs = ENCODING.split_x(x)
    points = np.column_stack([states, inputs])
    assert np.all((points >= low) & (points <= high))
    # uniform, and independent: no correlation beyond 4.5 standard errors, spread of (high - low)/sqrt(12)
    np.testing.assert_allclose(points.std(axis=0), (high - low) / 12**0.5, rtol=0.02)
    assert np.abs(np.corrcoef(points.T) - np.eye(7)).max() < 4.5 / n**0.5
