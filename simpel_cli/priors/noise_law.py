"""The law of the measurement noise, Gaussian or Student's t, by the leave-one-out log score of the training transitions.

Under the prior's moments, y ~ N(mean(g), C + sigma^2 W^-1), C = cov(g) + kappa^2 R, the error of row j where it is left
out and its variance are

    e_j = [A^-1 r]_j / [A^-1]_jj,    v_j = 1/[A^-1]_jj,    A = C + sigma^2 W^-1,    r = y - mean(g)

so that e_j/sqrt(v_j) is a held-out sample of the law. The white model error w is part of Student's t noise, and is divided
by the weights with it: whose tails it has, no data tell. Of Gaussian noise it is not. Which law, is asked of all outputs
together, with one tail 1/nu and a scale per output: fifty rows of one output seldom hold an outlier. If it is Student's t,
weights W, scales and tails follow by expectation and conditional maximisation; every tail has a normal prior about the
common one.

Reference: Rasmussen and Williams (2006), eqs. 5.10-5.12 (leave one out); Liu and Rubin (1995), ML estimation of the t
distribution using EM and its extensions, ECM and ECME, Statistica Sinica 5 (the tail by the likelihood itself).
"""

from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from simpel_cli.priors.gap_scale import marginal_likelihood_scales

TAILS = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45])  # 1/nu
SCALES = np.geomspace(0.2, 2.0, 47)  # of the errors' standard deviations
SPREAD = 0.1  # of an output's tail about the common one
LEAST_GAIN = 3.0  # nats that Student's t has to be ahead by
LEAST_ROWS = 20  # fewer tell nothing of a tail
ROUNDS = 8


class Law(NamedTuple):
    """Student's t noise of every output.

    Args:
        tail: 1/nu, (dy,).
        weights: expected weight of every row, (m, dy).
        gap: kappa with these weights, normalised, (dy,).
        scale: of noise and white model error together, normalised, (dy,).
    """

    tail: np.ndarray
    weights: np.ndarray
    gap: np.ndarray
    scale: np.ndarray


class Moments(NamedTuple):
    """The prior at the training rows, normalised.

    Args:
        samples: draws of the simulator, (N, m, dy).
        correlation: of the gap, (d, m, m): of all outputs together, d = 1, or of each, d = dy.
        targets: measured, (m, dy).
        white: white model error of the prior, a variance.
        precision: how much each target counts, its noise has the variance sigma^2/precision, (m, dy); None: all alike.
        tells: whether it tells of the noise, (m, dy); None: every one does.
    """

    samples: np.ndarray
    correlation: np.ndarray
    targets: np.ndarray
    white: float
    precision: np.ndarray | None = None
    tells: np.ndarray | None = None

    def correlation_of(self, i: int) -> np.ndarray:
        """Return the correlation of the gap of an output, (m, m)."""
        return self.correlation[min(i, len(self.correlation) - 1)]

    def rows(self, i: int) -> np.ndarray:
        """Return the rows that tell of an output's noise; of none, all of them."""
        every = np.arange(len(self.targets))
        if self.tells is None:
            return every
        found = np.flatnonzero(self.tells[:, i] > 0)
        return found if len(found) else every

    def silent(self, i: int) -> bool:
        """Whether no row tells of an output's noise, which then stays as it is."""
        return self.tells is not None and not (self.tells[:, i] > 0).any()

    def whitened(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return samples (N, m'), correlation (m', m') and targets (m',) of `rows`, in units in which all count alike."""
        rows = self.rows(i)
        root = np.ones(len(rows)) if self.precision is None else np.sqrt(self.precision[rows, i])
        correlation = self.correlation_of(i)[np.ix_(rows, rows)] * np.outer(root, root)
        return self.samples[:, rows, i] * root[None], correlation, self.targets[rows, i] * root

    def white_of(self, i: int) -> np.ndarray:
        """Return the variance of the white model error of `rows`, (m',), in units in which all targets count alike."""
        rows = self.rows(i)
        precision = np.ones(len(rows)) if self.precision is None else self.precision[rows, i]
        return np.asarray(self.white * precision)

    def of_output(self, i: int, kappa: float) -> tuple[np.ndarray, np.ndarray]:
        """Return covariance of the function, (m', m'), and residual, (m',), in units in which all targets count alike."""
        samples, correlation, targets = self.whitened(i)
        covariance = np.atleast_2d(np.cov(samples, rowvar=False))
        return covariance + kappa**2 * correlation, targets - samples.mean(axis=0)


class LeftOut(NamedTuple):
    """What the other rows say of every row, (m,) each.

    Args:
        error: of the row where it is left out.
        function: variance of the function there, without the noise.
        squared: expected square of the row's noise, where it is not left out.
    """

    error: np.ndarray
    function: np.ndarray
    squared: np.ndarray


def left_out(covariance: np.ndarray, residual: np.ndarray, variance: np.ndarray) -> LeftOut:
    """Leave out every row in turn; variance: of the noise per row, (m,)."""
    inverse = np.linalg.inv(covariance + np.diag(variance))
    diagonal = np.diag(inverse)
    pull = inverse @ residual
    squared = (variance * pull) ** 2 + np.maximum(variance - variance**2 * diagonal, 0.0)
    return LeftOut(pull / diagonal, np.maximum(1 / diagonal - variance, 0.0), squared)


def profile(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log score of standardised errors (m,) for Gaussian noise and every tail, each at its best scale.

    Both results are (1 + T,); the first entry is the Gaussian's. A scale is a multiple of the errors' standard deviation; its
    logarithm has the prior N(0, 1).
    """
    tau = TAILS[:, None, None]
    u = z[None, None, :] / SCALES[None, :, None]
    constant = gammaln((1 / tau + 1) / 2) - gammaln(1 / tau / 2) + 0.5 * np.log(tau / np.pi)
    heavy = np.sum(constant - (1 / tau + 1) / 2 * np.log1p(tau * u**2), axis=2)
    light = np.sum(-0.5 * u[:1] ** 2 - 0.5 * np.log(2 * np.pi), axis=2)
    scores = np.concatenate([light, heavy]) - len(z) * np.log(SCALES)[None] - 0.5 * np.log(SCALES)[None] ** 2
    best = np.argmax(scores, axis=1)
    return np.take_along_axis(scores, best[:, None], axis=1)[:, 0], SCALES[best]


def gain_of_tails(moments: Moments, kappa: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return by how many nats every tail, common to all outputs, is ahead of the Gaussian, (T,).

    Args:
        moments: of the prior.
        kappa: scale of the gap, (dy,).
        sigma: Gaussian noise, (dy,).
    """
    total = np.zeros(len(TAILS))
    for i in range(len(sigma)):
        if moments.silent(i):
            continue
        covariance, residual = moments.of_output(i, kappa[i])
        variance = sigma[i] ** 2 + moments.white_of(i)
        found = left_out(covariance, residual, variance)
        scores, _ = profile(found.error / np.sqrt(found.function + variance))
        total += scores[1:] - scores[0]
    return total


def student_t(
    moments: Moments, kappa: np.ndarray, sigma: np.ndarray, noise_init: np.ndarray, *, given: np.ndarray
) -> Law:
    """Return the law where it is Student's t.

    Args:
        moments: of the prior.
        kappa: scale of the gap for Gaussian noise, (dy,).
        sigma: Gaussian noise, (dy,), where to begin.
        noise_init: its typical value, (dy,).
        given: kappa where it is declared, NaN where it is chosen, (dy,).
    """
    m, size = moments.targets.shape
    kappa, sigma = kappa.copy(), np.sqrt(sigma**2 + moments.white)
    weights, tail = np.ones((m, size)), np.full(size, 0.25)
    rows = [moments.rows(i) for i in range(size)]
    silent = np.array([moments.silent(i) for i in range(size)], bool)
    told = np.stack([np.isin(np.arange(m), own) for own in rows], axis=1) & ~silent[None]
    count = np.maximum(told.sum(axis=0), 1)
    for turn in range(ROUNDS):
        scores = np.zeros((size, len(TAILS)))
        squared = np.zeros((m, size))
        for i in range(size):
            if turn and np.isnan(given[i]) and turn % 3 == 1:
                kappa[i], own = _weighted_scales(moments, i, weights[rows[i], i], noise_init[i])
                sigma[i] = np.sqrt(own**2 + moments.white)
            covariance, residual = moments.of_output(i, kappa[i])
            found = left_out(covariance, residual, sigma[i] ** 2 / weights[rows[i], i])
            if not silent[i]:
                scores[i] = profile(found.error / np.sqrt(found.function + sigma[i] ** 2))[0][1:]
            squared[rows[i], i] = found.squared
        tail = _tails(scores)
        weights = np.where(told, (1 + tail) / (1 + tail * squared / sigma**2), 1.0)
        # M-step of the scale with its prior, log sigma ~ N(log noise_init, 1), which decides where there are few rows
        data = np.where(silent, noise_init**2, np.sum(weights * squared * told, axis=0) / count)
        sigma = np.exp((count * np.log(data) / 2 + np.log(noise_init) / 2) / (count + 0.5))
    return Law(tail, weights, kappa, sigma)


def weights_of(law: Law, moments: Moments) -> np.ndarray:
    """Return the expected weights of other rows under a law, (m, dy); moments: of the prior there."""
    m, size = moments.targets.shape
    weights = np.ones((m, size))
    for _ in range(ROUNDS):
        for i in range(size):
            if moments.silent(i):
                continue
            covariance, residual = moments.of_output(i, law.gap[i])
            rows = moments.rows(i)
            found = left_out(covariance, residual, law.scale[i] ** 2 / weights[rows, i])
            weights[rows, i] = (1 + law.tail[i]) / (1 + law.tail[i] * found.squared / law.scale[i] ** 2)
    return weights


def _tails(scores: np.ndarray) -> np.ndarray:
    """Return every output's most probable tail, its prior centred on the common one; scores: (dy, T)."""
    common = TAILS[int(np.argmax(scores.sum(axis=0)))]
    prior = -0.5 * ((TAILS - common) / SPREAD) ** 2
    posterior = scores + prior[None]
    mass = np.exp(posterior - posterior.max(axis=1, keepdims=True))
    found: np.ndarray = (mass * TAILS[None]).sum(axis=1) / mass.sum(axis=1)
    return found


def _weighted_scales(moments: Moments, i: int, weights: np.ndarray, noise_init: float) -> tuple[float, float]:
    """Return kappa and sigma of the largest marginal likelihood with rows that count by their weights."""
    root, (samples, correlation, targets) = np.sqrt(weights), moments.whitened(i)
    scales = marginal_likelihood_scales(
        samples * root[None], correlation * np.outer(root, root), targets * root, noise_init, moments.white
    )
    return scales.gap, scales.noise
