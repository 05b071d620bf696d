"""From a study to the problems of every seed, and from a trained state to posteriors."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from simpel_cli.data import Measurements, Transitions, no_transitions, select, transitions
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.evaluation import Posterior, test_arrays
from simpel_cli.inference.assemble import Assembled, assemble
from simpel_cli.inference.noise_scale import LEAST, NoiseScale, noise_scale_of, with_noise_of_rows
from simpel_cli.inference.protocols import Inference, Method, Normaliser, Problem, Setting, Training
from simpel_cli.inference.system import normaliser_of
from simpel_cli.runs.settings import stream
from simpel_cli.studies.open import Study

SCALE_POINTS = 1000  # of the simulator's ranges, where there are no measurements to find the typical noise of
STRETCH = 500  # steps per call of the compiled program; the draws of the prior are refreshed as often


class Fitted(NamedTuple):
    """A rule bound to the training transitions of every seed."""

    assembled: Assembled
    bind: Callable[[Problem], Inference]
    keys: Key[Array, " seeds"]
    training: list[Training]
    available: int  # training transitions that `data.n_train` chose from
    normaliser: Normaliser
    scale: NoiseScale | None = None  # of the measurement noise, where it differs from row to row
    relative: list[np.ndarray | None] | None = None  # of every seed, that of its training targets over the typical one

    @property
    def n_train(self) -> int:
        """Number of training transitions."""
        return len(self.training[0].x)

    @property
    def target_std(self) -> np.ndarray:
        """Spread of the targets over the simulator's ranges, in data units, as the networks were trained with."""
        return np.asarray(self.assembled.problems.normaliser.y_std[0], dtype=float)


def prepare(study: Study, kept_law: str | None = None) -> Fitted:
    """Choose the training transitions of every seed and assemble the problems.

    Args:
        study: the declared configuration with its measurements.
        kept_law: law of the noise in the run's checkpoint; None: there is none yet.
    """
    settings, measurements = study.settings, study.measurements
    source, encoding = study.system.source, study.system.encoding
    recorded = study.recording.train
    carried = (encoding.stack, encoding.linear)
    outputs = len(study.recording.outputs)
    pairs = transitions(recorded, *carried) if recorded else no_transitions(source, outputs, *carried)
    alike = bool((pairs.weight == 1).all()) and not pairs.beyond.any()
    # one normaliser for all seeds and all n_train: results stay comparable
    normaliser = normaliser_of(study.system, stream(0, "normaliser"))
    scale = noise_scale_of(measurements.noise_scale, encoding, _unmeasured(study))
    typical, of_pairs = (None, lambda chosen: None) if scale is None else _scaled(study, scale, pairs, normaliser)
    chosen = [
        select(pairs, measurements.n_train, measurements.choice, measurements.seed_or(seed))
        for seed in settings.all_seeds
    ]
    relative = [of_pairs(own) for own in chosen]
    training = [
        training_arrays(own, encoding, alike=alike, relative=uneven)
        for own, uneven in zip(chosen, relative, strict=True)
    ]
    assembled = assemble(
        study.system,
        normaliser,
        study.prior,
        study.declared.score,
        training,
        study.recording.noise_std,
        study.measurements.noise_std,
        noise=study.method.noise,
        pool=study.method.pool,
        keys=[stream(seed, "prior") for seed in settings.all_seeds],
        precision=settings.precision,
        law=measurements.law,
        kept_law=kept_law,
    )
    if typical is not None:
        every = jnp.asarray(np.tile(typical, (settings.seeds, 1)), assembled.problems.x.dtype)
        assembled = assembled._replace(problems=assembled.problems._replace(noise_rms=every))
    keys = jnp.stack([stream(seed, "train") for seed in settings.all_seeds])
    bind = _bound(study.method, assembled.setting, scale)
    return Fitted(assembled, bind, keys, training, len(pairs.row), normaliser, scale, relative)


def _unmeasured(study: Study) -> tuple[str, ...]:
    """Return the names of the states and outputs that were not measured."""
    measured = study.recording.outputs
    return (*study.recording.estimated, *(q.name for q in study.system.source.outputs if q.name not in measured))


def _scaled(
    study: Study, scale: NoiseScale, pairs: Transitions, normaliser: Normaliser
) -> tuple[np.ndarray, Callable[[Transitions], np.ndarray | None]]:
    """Return the typical scale of the noise of every target, (dy,), and the map from training transitions to relative ones.

    Typical is the root mean square over all training transitions, one for all seeds and all n_train; where nothing was
    measured, over the simulator's ranges.

    Raises:
        DataError: an expression is no scale somewhere.
    """
    recorded, encoding = study.recording.train, study.system.encoding
    scale.refuse_wrong(study.recording)
    measured = scale.of_transitions(recorded, pairs)
    if not len(measured):
        x = np.asarray(study.system.domain.sample(stream(0, "noise_scale"), SCALE_POINTS, jnp.float64))
        spread = np.random.default_rng(0).normal(size=(len(x), encoding.dim_y)) * normaliser.y_std
        measured = scale.of_ranges(x, np.asarray(normaliser.y_mean + spread))
    typical = np.sqrt(np.mean(measured**2, axis=0))
    if np.allclose(measured, typical, rtol=1e-9, atol=0):  # the noise is the same in every training row
        return typical, lambda chosen: None
    return typical, lambda chosen: np.maximum(scale.of_transitions(recorded, chosen) / typical, LEAST)


def training_arrays(
    pairs: Transitions, encoding: Encoding, *, alike: bool, relative: np.ndarray | None = None
) -> Training:
    """Return network inputs and targets in data units; a change that was estimated counts as far as it is known.

    Args:
        pairs: training transitions.
        encoding: coordinates.
        alike: whether all targets count alike, but for their noise.
        relative: scale of every target's noise over the typical one, (m, dy); None: 1.
    """
    x, y = test_arrays(pairs, encoding)
    if alike and relative is None:
        return Training(x, y)
    weight = pairs.weight[:, encoding.quantity_of_target]
    counts = weight
    if relative is not None:  # what was estimated is known no better where a sensor is quiet
        counts = weight * np.where(weight < 1, np.minimum(relative**-2, 1.0), relative**-2)
    beyond = pairs.beyond[:, encoding.quantity_of_target]
    # what was estimated by the simulator agrees with it, and an end of a sensor is no value: they tell nothing of the noise
    return Training(x, y, counts, ((weight == 1) & (beyond == 0)).astype(float), beyond)


def _bound(method: Method, setting: Setting, scale: NoiseScale | None) -> Callable[[Problem], Inference]:
    def bind(problem: Problem) -> Inference:
        rule = method.bind(setting, problem)
        if scale is None or problem.noise_rms is None:
            return rule
        return with_noise_of_rows(rule, scale, problem.noise_rms)

    return bind


def limits_of(measurements: Measurements, encoding: Encoding) -> np.ndarray | None:
    """Return the lowest and highest reading of every target, (dy, 2), of outputs whose sensor saturates; None: none does."""
    ends = measurements.ends()
    limits = np.tile([-np.inf, np.inf], (encoding.dim_y, 1))
    for i, q in enumerate(encoding.outputs, encoding.dim_state):
        limits[i] = ends.get(q.name, limits[i])
    return limits if np.isfinite(limits).any() else None


def posteriors(study: Study, fitted: Fitted, state: Any, tested: Study | None = None) -> list[Posterior]:
    """Return the posterior of every seed as functions of arrays in data units.

    Args:
        study: what was fitted.
        fitted: its problems.
        state: of the rule.
        tested: whose sensors predictions are of; None: those of the study.
    """
    bind, assembled = fitted.bind, fitted.assembled
    predict = jax.jit(lambda problem, state, x: bind(problem).predict(state, x))
    members = jax.jit(lambda problem, state, x: bind(problem).members(state, x))
    typical = jax.jit(lambda problem, state, x: study.method.bind(assembled.setting, problem).predict(state, x))
    dtype, scale = assembled.problems.x.dtype, fitted.scale
    limits = limits_of((tested or study).measurements, study.system.encoding)

    def of_seed(i: int) -> Posterior:
        problem, own = jax.tree.map(lambda a: a[i], (assembled.problems, state))
        found = Posterior(
            predict=lambda x: predict(problem, own, jnp.asarray(x, dtype))._replace(limits=limits),
            members=lambda x: members(problem, own, jnp.asarray(x, dtype)),
            particles=study.method.particles,
        )
        if scale is None:
            return found
        return found._replace(
            typical=lambda x: typical(problem, own, jnp.asarray(x, dtype)),
            relative=lambda x, y: scale.relative(x, y, np.asarray(problem.noise_rms, float)),
        )

    return [of_seed(i) for i in range(study.settings.seeds)]
