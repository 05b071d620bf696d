"""The law of the noise by leave-one-out log score, on planted noise about smooth functions."""

import numpy as np
import pytest

from simpel_cli.priors.noise_law import LEAST_GAIN, TAILS, Moments, gain_of_tails, left_out, student_t, weights_of

OUTPUTS, SIGMA, KAPPA = 4, 0.05, 0.5


def planted(rows: int, freedom: float | None, seed: int) -> Moments:
    """Rows of functions drawn from the gap's own process, with noise of a law."""
    random = np.random.default_rng(seed)
    x = random.uniform(0, 4, rows)
    correlation = np.exp(-0.5 * (x[:, None] - x[None]) ** 2)
    root = np.linalg.cholesky(correlation + 1e-10 * np.eye(rows))
    smooth = KAPPA * root @ random.normal(size=(rows, OUTPUTS))
    shape = (rows, OUTPUTS)
    noise = random.normal(size=shape) if freedom is None else random.standard_t(freedom, shape)
    return Moments(np.zeros((2, *shape)), correlation[None], smooth + SIGMA * noise, 1e-8)


def gain(moments: Moments) -> float:
    return float(gain_of_tails(moments, np.full(OUTPUTS, KAPPA), np.full(OUTPUTS, SIGMA)).max())


def law_of(moments: Moments):
    scales = np.full(OUTPUTS, KAPPA), np.full(OUTPUTS, 2 * SIGMA)
    return student_t(moments, *scales, np.full(OUTPUTS, 0.1), given=np.full(OUTPUTS, KAPPA))


def test_leaving_out_in_closed_form_is_leaving_out() -> None:
    moments = planted(12, None, 0)
    covariance, residual = moments.of_output(1, KAPPA)
    variance = np.linspace(0.5, 2, 12) * SIGMA**2
    found = left_out(covariance, residual, variance)
    for j in range(12):
        rest = np.arange(12) != j
        inner = np.linalg.inv(covariance[np.ix_(rest, rest)] + np.diag(variance[rest]))
        reach = covariance[j, rest] @ inner
        assert np.isclose(found.error[j], residual[j] - reach @ residual[rest])
        assert np.isclose(found.function[j], covariance[j, j] - reach @ covariance[rest, j], atol=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_gaussian_noise_is_called_gaussian(seed: int) -> None:
    assert gain(planted(60, None, seed)) < LEAST_GAIN


def test_heavy_tails_are_seen_in_fifty_rows() -> None:
    found = [gain(planted(50, 3.0, seed)) > LEAST_GAIN for seed in range(10)]
    assert np.mean(found) >= 0.8


def test_degrees_of_freedom_and_scale_are_recovered() -> None:
    laws = [law_of(planted(300, 3.0, seed)) for seed in range(5)]
    tails, scales = np.array([law.tail for law in laws]), np.array([law.scale for law in laws])
    assert abs(tails.mean() - 1 / 3) < 0.06
    assert abs(scales.mean() / SIGMA - 1) < 0.1
    assert TAILS.min() <= tails.min()
    assert tails.max() <= TAILS.max()


def test_rows_that_are_far_off_count_less() -> None:
    moments = planted(80, 3.0, 1)
    moments.targets[7, 2] += 40 * SIGMA
    law = law_of(moments)
    assert law.weights[7, 2] < 0.02
    assert np.median(law.weights[:, 2]) > 0.5


def test_rows_that_were_not_looked_at_have_weights_of_their_own() -> None:
    law = law_of(planted(200, 3.0, 2))
    other = planted(100, 3.0, 3)
    other.targets[5, 1] += 40 * SIGMA
    weights = weights_of(law, other)
    assert weights[5, 1] < 0.02
    assert 0.5 < np.median(weights) < 1.4
