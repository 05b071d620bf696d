"""A step of a fit inside the unit box: what leaves the box goes to its wall, and the others go where they then belong."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from simpel_cli.filtering.likelihood.steps import ENOUGH, proposed

CURVATURE = 400.0


def narrow_valley(seed: int, d: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Curvatures of a valley that is a hundred times narrower than long, and where it is deepest: outside the box."""
    random = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(random.normal(size=(d, d)))
    fisher = turn @ np.diag(CURVATURE * np.geomspace(1, 1e4, d)) @ turn.T
    return fisher, random.uniform(-1, 2, d)


@pytest.mark.parametrize("seed", range(12))
def test_steps_end_where_a_quadratic_is_least_inside_the_box(seed: int) -> None:
    fisher, deepest = narrow_valley(seed)
    part, moves = jnp.full(5, 0.5), jnp.ones(5, bool)
    known = minimize(
        lambda z: 0.5 * (z - deepest) @ fisher @ (z - deepest), np.full(5, 0.5), jac=lambda z: fisher @ (z - deepest),
        bounds=[(0, 1)] * 5, method="L-BFGS-B", options={"maxiter": 5000, "ftol": 1e-15, "gtol": 1e-8},
    )  # fmt: skip
    loss = lambda z: 0.5 * float((z - deepest) @ fisher @ (z - deepest))  # noqa: E731
    for _ in range(40):
        following, promised = proposed(
            part, jnp.asarray(fisher @ (part - deepest)), jnp.asarray(fisher), jnp.asarray(1e-6), moves
        )
        assert float(following.min()) >= 0
        assert float(following.max()) <= 1
        np.testing.assert_allclose(promised, loss(np.asarray(part)) - loss(np.asarray(following)), rtol=1e-6, atol=1e-6)
        if float(promised) < ENOUGH:
            break
        part = following
    assert loss(np.asarray(part)) < known.fun + 0.5


def test_what_does_not_move_and_what_is_held_at_a_wall_stay() -> None:
    part = jnp.array([0.0, 0.5, 0.3])
    following, _ = proposed(
        part, jnp.array([10.0, 10.0, 10.0]), 100 * jnp.eye(3), jnp.asarray(0.0), jnp.array([True, False, True])
    )
    np.testing.assert_allclose(following, [0.0, 0.5, 0.2], atol=1e-6)
