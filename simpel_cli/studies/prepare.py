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
from simpel_cli.inference.protocols import Inference, Method, Normaliser, Problem, Setting, Training
from simpel_cli.inference.system import normaliser_of
from simpel_cli.runs.settings import stream
from simpel_cli.studies.open import Study

STRETCH = 500  # steps per call of the compiled program; the draws of the prior are refreshed as often


class Fitted(NamedTuple):
    """A rule bound to the training transitions of every seed."""

    assembled: Assembled
    bind: Callable[[Problem], Inference]
    keys: Key[Array, " seeds"]
    training: list[Training]
    available: int  # training transitions that `data.n_train` chose from
    normaliser: Normaliser

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
    training = [
        training_arrays(
            select(pairs, measurements.n_train, measurements.choice, measurements.seed_or(seed)), encoding, alike=alike
        )
        for seed in settings.all_seeds
    ]
    # one normaliser for all seeds and all n_train: results stay comparable
    normaliser = normaliser_of(study.system, stream(0, "normaliser"))
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
    keys = jnp.stack([stream(seed, "train") for seed in settings.all_seeds])
    return Fitted(assembled, _bound(study.method, assembled.setting), keys, training, len(pairs.row), normaliser)


def training_arrays(pairs: Transitions, encoding: Encoding, *, alike: bool) -> Training:
    """Return network inputs and targets in data units; a change that was estimated counts as far as it is known.

    Args:
        pairs: training transitions.
        encoding: coordinates.
        alike: whether all targets count alike.
    """
    x, y = test_arrays(pairs, encoding)
    if alike:
        return Training(x, y)
    weight = pairs.weight[:, encoding.quantity_of_target]
    beyond = pairs.beyond[:, encoding.quantity_of_target]
    # what was estimated by the simulator agrees with it, and an end of a sensor is no value: they tell nothing of the noise
    return Training(x, y, weight, ((weight == 1) & (beyond == 0)).astype(float), beyond)


def _bound(method: Method, setting: Setting) -> Callable[[Problem], Inference]:
    def bind(problem: Problem) -> Inference:
        return method.bind(setting, problem)

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
    dtype = assembled.problems.x.dtype
    limits = limits_of((tested or study).measurements, study.system.encoding)

    def of_seed(i: int) -> Posterior:
        problem, own = jax.tree.map(lambda a: a[i], (assembled.problems, state))
        return Posterior(
            predict=lambda x: predict(problem, own, jnp.asarray(x, dtype))._replace(limits=limits),
            members=lambda x: members(problem, own, jnp.asarray(x, dtype)),
            particles=study.method.particles,
        )

    return [of_seed(i) for i in range(study.settings.seeds)]
