"""From a simulator and measured transitions to the arrays that an inference rule reads."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError
from simpel_cli.inference.censored import with_sites
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import (
    Bank,
    Normaliser,
    Problem,
    Setting,
    Training,
    multiplied,
    pad_rows,
    padded_length,
)
from simpel_cli.inference.scales import Chooser, chosen
from simpel_cli.inference.system import System
from simpel_cli.priors.function_prior import GPPrior, SimulatorPrior


class Assembled(NamedTuple):
    """What inference needs, and what the report says about it."""

    setting: Setting
    problems: Problem  # leaves (seeds, ...)
    gap_scale: np.ndarray | None  # kappa per target in data units, of the first seed; None: no gap
    heavy_tails: float  # nats of leave-one-out log score by which Student's t noise is ahead; NaN: not looked at


def assemble(
    system: System,
    normaliser: Normaliser,
    prior: SimulatorPrior | GPPrior,
    score: object,
    training: list[Training],
    noise_std: Mapping[str, float],
    declared_noise: Mapping[str, float],
    *,
    noise: NoiseModel,
    pool: int,
    keys: list[PRNGKeyArray],
    precision: str,
    law: str = "auto",
    kept_law: str | None = None,
) -> Assembled:
    """Build the problem arrays of every seed.

    Args:
        system: simulator and coordinates.
        normaliser: of the system.
        prior: prior declaration.
        score: score estimator.
        training: rows with targets in data units, one set per seed, all of one length.
        noise_std: measurement noise per state and output, in its unit, declared or estimated.
        declared_noise: what of it was declared, and so is no upper bound.
        noise: of the likelihood.
        pool: number of domain points of a bank (for worlds).
        keys: one per seed, for draws of the prior that are made here.
        precision: dtype name of the networks.
        law: of the noise: gaussian, student_t, or auto: what the training data say (`priors.noise_law`).
        kept_law: what `auto` came to when the run began; None: it begins now.
    """
    dtype = jnp.dtype(precision)
    encoding = system.encoding
    _refuse_lost_digits(encoding, np.asarray(normaliser.y_std), dtype)
    bound = prior.bind(system.transition, *system.dims, np.asarray(normaliser.x_std))
    sigma = encoding.per_target(noise_std, 0.0) / normaliser.y_std
    declared = encoding.per_target(declared_noise, 0.0) / normaliser.y_std
    noise_init, noise_floor = (np.asarray(a) for a in noise.start(sigma, declared))
    silent = np.any([own.silent for own in training], axis=0)
    if silent.any():  # the noise of a change is that of both its ends
        both = np.where(np.arange(encoding.dim_y) < encoding.dim_state, np.sqrt(2), 1.0)
        noise_init = np.where(silent, np.maximum(both * sigma, noise.floor), noise_init)
        noise_floor = np.minimum(noise_floor, 0.99 * noise_init)
        training = [_silenced(own, silent) for own in training]
    rows = [own._replace(y=(own.y - normaliser.y_mean) / normaliser.y_std) for own in training]
    split = [jax.random.split(key) for key in keys]
    chooser = Chooser(prior, bound, system, normaliser, noise, noise_init)
    choices, gain = chosen(chooser, rows, [key for key, _ in split], law, kept_law)
    # what lies at a sensor's end is no number: it takes its place by what the other rows say
    rows = [with_sites(chooser, own, choice, key) for own, choice, (key, _) in zip(rows, choices, split, strict=True)]
    problems = []
    for (x, y, relative, tells, _), (_, key), own in zip(rows, split, choices, strict=True):
        m, length = len(x), padded_length(max(len(x), 1))
        weights = multiplied(None if own.law is None else own.law.weights, relative)
        if m == 0:  # what pads must be simulable
            x, y = np.asarray(normaliser.x_mean)[None], np.zeros((1, encoding.dim_y))
            relative, tells, weights = (None if a is None else np.ones(y.shape) for a in (relative, tells, weights))
        floors = own.noise if m <= chooser.most_rows else np.zeros_like(own.noise)
        arrays = Problem(
            x=pad_rows(x, length),
            y=pad_rows(y, length),
            m=np.array(m, np.int32),
            normaliser=normaliser,
            gap_scale=own.gap,
            noise_init=noise_init if own.law is None else np.maximum(own.law.scale, noise.floor),
            noise_floor=np.asarray(noise.raised(noise_floor, noise.marginal_share * floors, noise_init)),
            bank=_bank(prior, system, pad_rows(x, length), pool, key),
            tail=None if own.law is None else own.law.tail,
            weights=None if weights is None else pad_rows(weights, length),
            precision=None if relative is None else pad_rows(relative, length),
            tells=None if tells is None else pad_rows(tells, length),
            gap_relevance=own.relevance,
        )
        problems.append(arrays)

    def stack(*leaves: np.ndarray) -> jax.Array:
        stacked = np.stack(leaves)
        return jnp.asarray(stacked, dtype if np.issubdtype(stacked.dtype, np.floating) else None)

    setting = Setting(bound, score, lambda key, n: system.domain.sample(key, n, dtype))  # type: ignore[arg-type]
    gap_scale = choices[0].gap * normaliser.y_std if prior.gap is not None else None
    return Assembled(setting, jax.tree.map(stack, *problems), gap_scale, gain)


def _silenced(training: Training, silent: np.ndarray) -> Training:
    """Return training rows none of whose targets tells of the noise of some outputs."""
    return training._replace(tells=None if training.tells is None else np.where(silent[None], 0.0, training.tells))


def _refuse_lost_digits(encoding: Encoding, y_std: np.ndarray, dtype: jnp.dtype) -> None:
    """Refuse a precision in which the change of a state drowns in the state's rounding."""
    for q in encoding.states:
        if q.periodic:
            continue
        size, change = max(abs(q.low), abs(q.high)), y_std[encoding.y_names.index(q.name)]
        if float(jnp.finfo(dtype).eps) * size > 0.01 * change:
            raise ConfigError(
                f"run.precision: {dtype.name} cannot hold a change of {change:.3g} {q.unit} in `{q.name}`, which is as large "
                f"as {size:.3g}. Use run.precision=float64, or declare the state as a difference from a reference."
            )


def _bank(prior: SimulatorPrior | GPPrior, system: System, x: np.ndarray, pool: int, key: PRNGKeyArray) -> Bank | None:
    """Query a world once: at the training inputs and at a pool of domain points."""
    if system.transition is not None or not prior.uses_simulator:
        return None
    key_x, key_phi = jax.random.split(key)
    points = np.concatenate([x, np.asarray(system.domain.sample(key_x, pool, jnp.float64))])
    return Bank(points, np.moveaxis(system.simulate(key_phi, points, prior.draws), 0, -1))
