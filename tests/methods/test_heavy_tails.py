"""Methods with Student's t noise: one row that is far off does not drag them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_methods import FEW, FIXED, GRID, NOISE, SMALL, N, X, prior_of, problem_of, run, setting_of

from simpel_cli.inference.predictive import Predictive
from simpel_cli.methods.exact_gp import ExactGP
from simpel_cli.methods.fmap import FunctionMAP
from simpel_cli.methods.fsvgd import FSVGD
from simpel_cli.methods.greybox import GreyBox
from simpel_cli.methods.pathwise import Pathwise
from simpel_cli.methods.repulsive import Repulsive
from simpel_cli.methods.svgd import SVGD
from simpel_cli.methods.sysid import SysID
from simpel_cli.priors.function_prior import GPPrior

TAIL, OFF = 0.3, 40 * NOISE
TRUE = 1.2 * X + 0.3
Y = TRUE + NOISE * np.random.default_rng(1).normal(size=(N, 1))
Y[np.argmax(X)] += OFF  # at the end, where it has the most pull


def predicted(method: Any, gap: bool, *, heavy: bool, steps: int) -> Predictive:
    problem = problem_of(Y, 0.3 if gap else 0.0)
    if heavy:
        squared = ((problem.y - jnp.asarray(1.2 * problem.x + 0.3)) / NOISE) ** 2
        weights = (1 + TAIL) / (1 + TAIL * squared)
        problem = problem._replace(tail=jnp.full(1, TAIL), weights=weights)
    rule = method.bind(setting_of(prior_of(gap)._replace(draws=128)), problem)
    return jax.jit(rule.predict)(run(rule, steps), jnp.asarray(GRID))


@pytest.mark.parametrize(
    ("method", "gap"), [(SysID(noise=FIXED), False), (ExactGP(SysID(noise=FIXED)), True)], ids=["sysid", "gp"]
)
def test_a_row_that_is_far_off_drags_the_gaussian_only(method: Any, gap: bool) -> None:
    light, heavy = (predicted(method, gap, heavy=h, steps=30) for h in (False, True))
    truth = 1.2 * GRID + 0.3
    dragged, kept = (np.max(np.abs(np.asarray(p.mean) - truth)) for p in (light, heavy))
    assert dragged > 0.25
    assert kept < 0.12
    assert light.tail is None
    np.testing.assert_allclose(heavy.noise_std, heavy.noise_scale / np.sqrt(1 - 2 * TAIL))


def test_weights_of_one_are_the_gaussian() -> None:
    """In closed form: rows that all count fully are rows without weights."""
    plain = predicted(ExactGP(SysID(noise=FIXED)), True, heavy=False, steps=1)
    problem = problem_of(Y, 0.3)._replace(weights=jnp.ones((32, 1)))
    rule = ExactGP(SysID(noise=FIXED)).bind(setting_of(prior_of(True)), problem)
    same = rule.predict(run(rule, 1), jnp.asarray(GRID))
    np.testing.assert_allclose(same.mean, plain.mean, atol=1e-6)
    np.testing.assert_allclose(same.epistemic_std, plain.epistemic_std, atol=1e-6)


def bound(method: Any) -> tuple[Any, Any]:
    """The rule and its beginning with rows that count by their weights."""
    problem = problem_of(Y, 0.3)
    squared = ((problem.y - jnp.asarray(1.2 * problem.x + 0.3)) / NOISE) ** 2
    problem = problem._replace(tail=jnp.full(1, TAIL), weights=(1 + TAIL) / (1 + TAIL * squared))
    rule = method.bind(setting_of(prior_of(True)._replace(draws=128)), problem)
    return rule, rule.init(jax.random.key(0))


def test_paths_go_past_the_row_that_is_far_off() -> None:
    """In closed form, before any network is trained."""
    _, state = bound(Pathwise(**SMALL | {"particles": 20}, pool=8, features=64, noise=FIXED))
    at = int(np.argmax(X))
    assert abs(float(np.mean(np.asarray(state.paths.known)[0, at])) - float(TRUE[at, 0])) < 0.15


def test_the_residual_of_a_grey_box_is_scaled_without_it() -> None:
    """Its scale and the floor of its noise are those of the other rows, not of the one that is far off."""
    _, state = bound(GreyBox(sysid=SysID(noise=FIXED), residual=FSVGD(**FEW), prior=GPPrior(scale="auto")))
    assert float(state.noise_floor[0]) < 0.09
    assert float(state.scale[0]) < 0.04


METHODS = {
    "simpel": (FSVGD(**FEW), True), "map": (FunctionMAP(**FEW), True), "repulsive": (Repulsive(**FEW), True),
    "precondition": (FSVGD(**FEW, precondition=True), True), "svgd": (SVGD(**SMALL), False),
    "greybox": (GreyBox(residual=FSVGD(**FEW)), True),
    "pathwise": (Pathwise(**SMALL, pool=8, features=64), True),
}  # fmt: skip


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_the_law(name: str) -> None:
    method, gap = METHODS[name]
    found = predicted(method, gap, heavy=True, steps=3)
    assert np.isfinite(np.asarray(found.particles)).all()
    np.testing.assert_allclose(found.tail, [TAIL])


def test_the_pull_of_a_row_is_bounded() -> None:
    from simpel_cli.methods.function_space import log_likelihood

    def pull(error: float, tail: Any) -> float:
        h = jnp.full((1, 1, 1), error)
        slope = jax.grad(lambda h: log_likelihood(h, jnp.ones(1), jnp.zeros((1, 1)), jnp.ones(1), tail))(h)
        return float(jnp.abs(slope[0, 0, 0]))

    assert np.isclose(pull(100.0, None), 100.0)
    assert pull(100.0, jnp.full(1, TAIL)) < 0.05
    assert np.isclose(pull(0.01, jnp.full(1, TAIL)), 0.01 * (1 + TAIL), rtol=1e-3)
