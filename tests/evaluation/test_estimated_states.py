"""Scores where a state was estimated: the noise of a target has its variance, and free runs count where it was measured."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.evaluation.bootstrap import Blocks
from simpel_cli.evaluation.free_run import FreeRun, free_run_table
from simpel_cli.evaluation.one_step import one_step
from simpel_cli.evaluation.posterior import Posterior
from simpel_cli.inference.predictive import Predictive
from simulators.model import Quantity

SIGMA, ROWS = 0.5, 40


def posterior() -> Posterior:
    def predict(x: Any) -> Predictive:
        return Predictive(jnp.zeros((1, len(x), 1)), jnp.full(1, SIGMA))

    def members(x: Any) -> jax.Array:
        return jnp.zeros((1, x.shape[1], 1))

    return Posterior(predict, members, 1)


def test_a_target_that_is_known_less_is_predicted_more_widely() -> None:
    y = np.random.default_rng(0).normal(size=(ROWS, 1))
    precision = np.where(np.arange(ROWS) % 2, 1.0, 0.25)[:, None]
    found = one_step(posterior(), np.zeros((ROWS, 1)), y, precision)
    scale = SIGMA / np.sqrt(precision)
    np.testing.assert_allclose(found.nll[:, :1], -norm.logpdf(y, 0.0, scale), rtol=1e-5)
    np.testing.assert_allclose(found.std, scale, rtol=1e-5)
    plain = one_step(posterior(), np.zeros((ROWS, 1)), y)
    np.testing.assert_allclose(plain.nll[:, :1], -norm.logpdf(y, 0.0, SIGMA), rtol=1e-5)


def test_errors_ahead_are_of_measured_states() -> None:
    runs, steps = 6, 4
    error = np.ones((runs, steps + 1, 2))
    known = np.ones(error.shape, bool)
    error[::2, :, 0], known[::2, :, 0] = 100.0, False  # estimates that are far off
    known[:, 2, 1] = False
    nothing = np.zeros(error.shape)
    encoding = Encoding((Quantity("s", "m", -1.0, 1.0), Quantity("v", "m/s", -1.0, 1.0)), ())
    run = FreeRun(nothing, nothing, nothing, np.zeros(runs, int), np.arange(runs), error, known)
    rows = free_run_table(run, Blocks(np.arange(runs), "rows"), encoding, 0.1)
    value = {(r["metric"], r["output"]): r["value"] for r in rows}
    assert value["free_run_rmse@0.4s", "s"] == 1.0
    assert value["free_run_rmse@0.4s", "v"] == 1.0
    assert np.isnan(value["free_run_rmse@0.2s", "v"])
