"""Scales of the gap and of the noise, and the law of the noise, chosen by what the training transitions say under the prior."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from simpel_cli.errors import ConfigError
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Normaliser, Training, multiplied
from simpel_cli.inference.system import System
from simpel_cli.priors.function_prior import FunctionPrior, GapGP, GPPrior, SimulatorPrior
from simpel_cli.priors.gap_scale import marginal_likelihood_scales
from simpel_cli.priors.lengthscales import most_likely
from simpel_cli.priors.marginal_likelihood import TYPICAL_SCALE, noise_of_smooth
from simpel_cli.priors.noise_law import (
    LEAST_GAIN,
    LEAST_ROWS,
    TAILS,
    Law,
    Moments,
    gain_of_tails,
    student_t,
    weights_of,
)

SCALE_POINTS, SCALE_DRAWS = 512, 512
WORLD_SCALE_POINTS = 128


class Chooser(NamedTuple):
    """A prior and what is measured, for which scales are chosen.

    Args:
        prior: as declared.
        bound: to the simulator.
        system: simulator and coordinates.
        normaliser: of the system.
        noise: of the likelihood.
        noise_init: typical noise, normalised, (dy,).
    """

    prior: SimulatorPrior | GPPrior
    bound: FunctionPrior
    system: System
    normaliser: Normaliser
    noise: NoiseModel
    noise_init: np.ndarray

    @property
    def most_rows(self) -> int:
        """Rows that are looked at together."""
        queries = self.prior.uses_simulator and self.system.transition is None
        return WORLD_SCALE_POINTS if queries else SCALE_POINTS

    @property
    def given(self) -> np.ndarray:
        """Declared kappa, normalised, NaN where it is to be chosen, (dy,)."""
        gap: GapGP | None = self.prior.gap
        given = np.zeros(self.system.encoding.dim_y)
        if gap is not None:
            given = given + (np.nan if isinstance(gap.scale, str) else gap.scale)
            if gap.scale == "declared":
                given = self.system.encoding.per_target(self.system.source.gap, np.nan) / self.normaliser.y_std
        return given

    @property
    def declared(self) -> np.ndarray | None:
        """Relevances that the lengthscales to be chosen are near to, (dy, dx); None: they are declared."""
        gap: GapGP | None = self.prior.gap
        if gap is None or not gap.learns_lengthscales:
            return None
        return np.tile(np.asarray(self.bound.input_scale, float), (self.system.encoding.dim_y, 1))

    def normalised(self, x: np.ndarray) -> np.ndarray:
        """Return inputs (m, dx) of unit variance on the domain."""
        return np.asarray((x - self.normaliser.x_mean) / self.normaliser.x_std)

    def correlation(self, x: np.ndarray, longer: float = 1.0, relevance: np.ndarray | None = None) -> np.ndarray:
        """Correlation of the gap at inputs (m, dx), of lengthscales so many times the declared ones.

        Returns:
            (d, m, m): of all outputs together, d = 1, or, with relevances, of each.
        """
        if self.bound.kernel is None:
            return np.zeros((1, len(x), len(x)))
        at = jnp.asarray(self.normalised(x))
        other = self.bound._replace(input_scale=np.asarray(self.bound.input_scale) / longer)
        return np.asarray(other.correlation(at, at, relevance))

    def relevances(self, x: np.ndarray, moments: Moments, weights: np.ndarray | None = None) -> np.ndarray | None:
        """Return the most probable relevances of every output, (dy, dx); None: the lengthscales are declared.

        Args:
            x: inputs of the moments, (m, dx).
            moments: of the prior there.
            weights: of all rows where the noise is Student's t, which holds the white model error, too, (m, dy).
        """
        kernel, declared, given = self.bound.kernel, self.declared, self.given
        if kernel is None or declared is None:
            return None
        at, found = self.normalised(x), []
        for i, own in enumerate(declared):
            if given[i] == 0:  # there is no gap
                found.append(own)
                continue
            rows = moments.rows(i)
            counts = multiplied(moments.precision, weights)
            white = np.full(len(rows), 0.0 if weights is not None else moments.white)
            found.append(
                most_likely(
                    kernel, at[rows], moments.samples[:, rows, i], moments.targets[rows, i], white, own,
                    float(self.noise_init[i]), None if np.isnan(given[i]) else float(given[i]),
                    None if counts is None else counts[rows, i],
                )
            )  # fmt: skip
        return np.stack(found)

    def moments(self, training: Training, key: PRNGKeyArray, relevance: np.ndarray | None = None) -> Moments:
        """Return the prior at training rows with normalised targets; relevance: that was chosen."""
        x, targets = training.x, training.y
        samples = np.zeros((2, *targets.shape))
        if self.prior.uses_simulator:
            drawn = self.system.simulate(key, x, SCALE_DRAWS)
            samples = (drawn - self.normaliser.y_mean) / self.normaliser.y_std
        white = self.prior.white_variance
        correlation = self.correlation(x, relevance=relevance)
        return Moments(samples, correlation, targets, white, training.precision, training.tells)


class Chosen(NamedTuple):
    """Of one set of training rows.

    Args:
        gap: kappa, normalised, (dy,).
        noise: sigma of the largest marginal likelihood, 0 where it is not asked for, (dy,).
        law: Student's t noise, weights of all rows; None: Gaussian.
        relevance: one over the gap's lengthscales, (dy, dx); None: as they are declared.
    """

    gap: np.ndarray
    noise: np.ndarray
    law: Law | None
    relevance: np.ndarray | None = None


class Looked(NamedTuple):
    """What Gaussian noise comes to in the rows that were looked at.

    Args:
        gap, noise: kappa and sigma, normalised, (dy,).
        rows: that were looked at; None: there were none, or nothing was to be chosen.
        moments: of the prior there.
        gain: nats by which every tail of Student's t is ahead, (T,).
        relevance: see `Chosen`.
    """

    gap: np.ndarray
    noise: np.ndarray
    rows: np.ndarray | None
    moments: Moments | None
    gain: np.ndarray
    relevance: np.ndarray | None


def chosen(
    chooser: Chooser,
    training: list[Training],
    keys: list[PRNGKeyArray],
    law: str,
    kept: str | None = None,
) -> tuple[list[Chosen], float]:
    """Choose scales for every set of training rows, and one law of the noise for all of them.

    Args:
        chooser: prior and system.
        training: rows of every seed, with normalised targets.
        keys: one per seed.
        law: of the noise: gaussian, student_t, or auto: what the data say.
        kept: what `auto` once came to, of a run that began: another machine's rounding does not decide again.

    Returns:
        The choices, and the nats by which Student's t is ahead of the Gaussian, per seed; NaN: it was not looked at.
    """
    if law == "student_t" and not chooser.noise.learn:
        raise ConfigError(
            "data.noise.law: student_t, but its degrees of freedom and scale are learned, and method.noise.learn=false keeps "
            "the noise as it is declared. Set method.noise.learn=true, or data.noise.law=gaussian."
        )
    looked = [_looked(chooser, rows, key, law) for rows, key in zip(training, keys, strict=True)]
    gain = np.mean([one.gain for one in looked], axis=0).max()
    heavy = gain > LEAST_GAIN if kept is None else kept == "student_t"
    if law == "gaussian" or looked[0].moments is None or (law == "auto" and not heavy):
        return [Chosen(one.gap, one.noise, None, one.relevance) for one in looked], float(gain)
    return [_heavy(chooser, *each) for each in zip(looked, training, keys, strict=True)], float(gain)


def _looked(chooser: Chooser, training: Training, key: PRNGKeyArray, law: str) -> Looked:
    """Kappa and lengthscales are what the prior declares; what it does not is chosen by marginal likelihood, as sigma is."""
    size, noise, given = chooser.system.encoding.dim_y, chooser.noise, chooser.given
    unknown, x, relevance = np.full(len(TAILS), np.nan), training.x, chooser.declared
    # of more rows than are looked at networks learn the noise better than those tell it
    with_noise = noise.learn and noise.marginal_share > 0 and 0 < len(x) <= chooser.most_rows
    with_law = law != "gaussian" and noise.learn and (len(x) >= LEAST_ROWS or law == "student_t")
    if len(x) == 0:  # nothing to choose by
        return Looked(np.where(np.isnan(given), TYPICAL_SCALE, given), np.zeros(size), None, None, unknown, relevance)
    if not (np.isnan(given).any() or with_noise or with_law or relevance is not None):
        return Looked(given, np.zeros(size), None, None, unknown, None)
    rows = np.arange(len(x))
    if len(x) > chooser.most_rows:  # the first ones may all be of one episode
        key, key_rows = jax.random.split(key)
        rows = np.asarray(jax.random.choice(key_rows, len(x), (chooser.most_rows,), replace=False))
    moments = chooser.moments(training.take(rows), key)
    relevance = chooser.relevances(x[rows], moments)
    if relevance is not None:
        moments = moments._replace(correlation=chooser.correlation(x[rows], relevance=relevance))
    found = [
        marginal_likelihood_scales(
            *moments.whitened(i),
            chooser.noise_init[i],
            moments.white_of(i),
            None if np.isnan(given[i]) else float(given[i]),
        )
        for i in range(size)
    ]
    scale, sigma = (np.array(values) for values in zip(*found, strict=True))
    sigma = np.where(training.silent, chooser.noise_init, sigma)
    gain = gain_of_tails(moments, scale, sigma) if with_law else unknown
    if with_noise:
        sigma = _smooth(chooser, x[rows], moments, sigma)
    sigma = sigma if with_noise or with_law else np.zeros(size)
    return Looked(scale, sigma, rows, moments if with_law else None, gain, relevance)


def _smooth(
    chooser: Chooser, x: np.ndarray, moments: Moments, sigma: np.ndarray, law: np.ndarray | None = None
) -> np.ndarray:
    """Return a noise that is no less than what a smooth function leaves, where there is no simulator."""
    if chooser.prior.uses_simulator:
        return sigma
    left = noise_of_smooth(
        lambda longer: jnp.asarray(chooser.correlation(x, longer)[0]), moments.targets, np.array(len(x), np.int32),
        moments.white, 1.0, np.full(len(sigma), 1e-3), chooser.noise_init, multiplied(law, moments.precision), moments.tells,
    )  # fmt: skip
    return np.maximum(sigma, np.asarray(left))


def _heavy(chooser: Chooser, looked: Looked, training: Training, key: PRNGKeyArray) -> Chosen:
    """Return the choice for noise that is Student's t."""
    assert looked.moments is not None
    assert looked.rows is not None
    x, moments, init = training.x[looked.rows], looked.moments, chooser.noise_init
    law = student_t(moments, looked.gap, looked.noise, init, given=chooser.given)
    relevance = chooser.relevances(x, moments, law.weights)
    if relevance is not None:  # a few rows that are far off had bent the gap
        moments = moments._replace(correlation=chooser.correlation(x, relevance=relevance))
        law = student_t(moments, law.gap, law.scale, init, given=chooser.given)
    scale = _smooth(chooser, x, moments, law.scale, law.weights)
    weights = np.ones(training.y.shape)
    weights[looked.rows] = law.weights
    rest = np.setdiff1d(np.arange(len(training.x)), looked.rows)
    for k, rows in enumerate(np.array_split(rest, -(-len(rest) // chooser.most_rows)) if len(rest) else []):
        moments = chooser.moments(training.take(rows), jax.random.fold_in(key, k), relevance)
        weights[rows] = weights_of(law, moments)
    return Chosen(law.gap, scale, law._replace(weights=weights, scale=scale), relevance)
