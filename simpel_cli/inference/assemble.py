"""From a simulator and measured transitions to the arrays that an inference rule reads."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Bank, Normaliser, Problem, Setting, pad_rows, padded_length
from simpel_cli.inference.system import System
from simpel_cli.priors.function_prior import FunctionPrior, GapGP, GPPrior, SimulatorPrior
from simpel_cli.priors.gap_scale import marginal_likelihood_scales
from simpel_cli.priors.marginal_likelihood import TYPICAL_SCALE, noise_of_smooth

SCALE_POINTS, SCALE_DRAWS = 512, 512
WORLD_SCALE_POINTS = 128


class Assembled(NamedTuple):
    """What inference needs, and what the report says about it."""

    setting: Setting
    problems: Problem  # leaves (seeds, ...)
    gap_scale: np.ndarray | None  # kappa per target in data units, of the first seed; None: no gap


def assemble(
    system: System,
    normaliser: Normaliser,
    prior: SimulatorPrior | GPPrior,
    score: object,
    training: list[tuple[np.ndarray, np.ndarray]],
    noise_std: Mapping[str, float],
    declared_noise: Mapping[str, float],
    *,
    noise: NoiseModel,
    pool: int,
    keys: list[PRNGKeyArray],
    precision: str,
) -> Assembled:
    """Build the problem arrays of every seed.

    Args:
        system: simulator and coordinates.
        normaliser: of the system.
        prior: prior declaration.
        score: score estimator.
        training: inputs (m, dx) and targets (m, dy) in data units, one pair per seed, all of one length.
        noise_std: measurement noise per state and output, in its unit, declared or estimated.
        declared_noise: what of it was declared, and so is no upper bound.
        noise: of the likelihood.
        pool: number of domain points of a bank (for worlds).
        keys: one per seed, for draws of the prior that are made here.
        precision: dtype name of the networks.
    """
    dtype = jnp.dtype(precision)
    encoding = system.encoding
    _refuse_lost_digits(encoding, np.asarray(normaliser.y_std), dtype)
    bound = prior.bind(system.transition, *system.dims, np.asarray(normaliser.x_std))
    sigma = encoding.per_target(noise_std, 0.0) / normaliser.y_std
    declared = encoding.per_target(declared_noise, 0.0) / normaliser.y_std
    noise_init, noise_floor = (np.asarray(a) for a in noise.start(sigma, declared))
    problems, scales = [], []
    for (x, y), key in zip(training, keys, strict=True):
        m, length = len(x), padded_length(max(len(x), 1))
        if m == 0:  # what pads must be simulable
            x, y = np.asarray(normaliser.x_mean)[None], np.asarray(normaliser.y_mean)[None]
        targets = (y - normaliser.y_mean) / normaliser.y_std
        key_scale, key_bank = jax.random.split(key)
        scale, sigma = _scales(
            prior, bound, system, normaliser, x[:m], targets[:m], noise_init, key_scale,
            # of more rows than are looked at networks learn the noise better than those tell it
            with_noise=noise.learn and noise.marginal_share > 0 and m <= _most_rows(prior, system),
        )  # fmt: skip
        arrays = Problem(
            x=pad_rows(x, length),
            y=pad_rows(targets, length),
            m=np.array(m, np.int32),
            normaliser=normaliser,
            gap_scale=scale,
            noise_init=noise_init,
            noise_floor=np.asarray(noise.raised(noise_floor, noise.marginal_share * sigma, noise_init)),
            bank=_bank(prior, system, pad_rows(x, length), pool, key_bank),
        )
        problems.append(arrays)
        scales.append(scale)

    def stack(*leaves: np.ndarray) -> jax.Array:
        stacked = np.stack(leaves)
        return jnp.asarray(stacked, dtype if np.issubdtype(stacked.dtype, np.floating) else None)

    setting = Setting(bound, score, lambda key, n: system.domain.sample(key, n, dtype))  # type: ignore[arg-type]
    gap_scale = scales[0] * normaliser.y_std if prior.gap is not None else None
    return Assembled(setting, jax.tree.map(stack, *problems), gap_scale)


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


def _most_rows(prior: SimulatorPrior | GPPrior, system: System) -> int:
    """Rows that the marginal likelihood looks at."""
    queries = prior.uses_simulator and system.transition is None
    return WORLD_SCALE_POINTS if queries else SCALE_POINTS


def _scales(
    prior: SimulatorPrior | GPPrior,
    bound: FunctionPrior,
    system: System,
    normaliser: Normaliser,
    x: np.ndarray,
    targets: np.ndarray,
    noise_init: np.ndarray,
    key: PRNGKeyArray,
    *,
    with_noise: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return kappa and sigma per target in normalised units, sigma 0 where it is not asked for.

    kappa is what the prior declares; what it does not is chosen by marginal likelihood, as sigma is.
    """
    gap: GapGP | None = prior.gap
    size = system.encoding.dim_y
    given = np.zeros(size)
    if gap is not None:
        given = given + (np.nan if isinstance(gap.scale, str) else gap.scale)
        if gap.scale == "declared":
            given = system.encoding.per_target(system.source.gap, np.nan) / normaliser.y_std
    if len(x) == 0:  # nothing to choose by
        return np.where(np.isnan(given), TYPICAL_SCALE, given), np.zeros(size)
    if not (np.isnan(given).any() or with_noise):
        return given, np.zeros(size)
    subset: slice | np.ndarray = slice(None)
    if len(x) > _most_rows(prior, system):  # the first ones may all be of one episode
        key, key_rows = jax.random.split(key)
        subset = np.asarray(jax.random.choice(key_rows, len(x), (_most_rows(prior, system),), replace=False))
    here = x[subset]
    samples = np.zeros((2, len(here), size))
    if prior.uses_simulator:
        samples = (system.simulate(key, here, SCALE_DRAWS) - normaliser.y_mean) / normaliser.y_std
    normalised = (here - normaliser.x_mean) / normaliser.x_std

    def stretched(longer: float) -> Array:
        """Correlation per output of a lengthscale so many times the declared one."""
        other = bound._replace(white_variance=0.0, input_scale=np.asarray(bound.input_scale) / longer)
        return other.covariance(jnp.asarray(normalised), jnp.ones(size))

    correlation = np.asarray(stretched(1.0)[0])
    chosen = [
        marginal_likelihood_scales(
            samples[:, :, i], correlation, targets[subset, i], noise_init[i], prior.white_variance,
            None if np.isnan(given[i]) else float(given[i]),
        )
        for i in range(size)
    ]  # fmt: skip
    scale, sigma = (np.array(values) for values in zip(*chosen, strict=True))
    if with_noise and not prior.uses_simulator:
        smooth = np.asarray(noise_of_smooth(
            lambda longer: stretched(longer)[0], targets[subset], np.array(len(here), np.int32), prior.white_variance, 1.0,
            np.full(size, 1e-3), noise_init,
        ))  # fmt: skip
        sigma = np.maximum(sigma, smooth)
    return scale, sigma if with_noise else np.zeros(size)
