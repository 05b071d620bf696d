"""From a resolved configuration to everything that fitting or judging a posterior needs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from simpel_cli.config.launch import Job
from simpel_cli.config.nodes import build
from simpel_cli.data import Measurements, Recording, absolute, no_transitions, read, select, transitions
from simpel_cli.errors import ConfigError, DataError, did_you_mean
from simpel_cli.evaluation import Posterior, test_arrays
from simpel_cli.inference.assemble import Assembled, assemble
from simpel_cli.inference.protocols import Inference, Method, Normaliser, Problem, Setting
from simpel_cli.inference.system import System, normaliser_of, system_of
from simpel_cli.priors.function_prior import GPPrior, SimulatorPrior
from simpel_cli.runs.settings import Settings, configure, stream

STRETCH = 500  # steps between two looks of the host; the draws of the prior are refreshed as often
GROUPS = (
    "run", "sim", "data", "prior", "score", "method", "evaluation", "simulation", "effect", "discovery", "policy", "control",
    "reward", "truth", "mujoco", "online", "planner",
)  # fmt: skip


@dataclass(frozen=True)
class Evaluation:
    """The `evaluation:` group.

    Args:
        horizon: length of the free runs, s; null = 20 transitions.
    """

    horizon: float | None = None

    def __post_init__(self) -> None:
        if self.horizon is not None and not self.horizon > 0:
            raise ConfigError(f"evaluation.horizon: got {self.horizon}; it must be positive (s).")

    def steps(self, dt: float) -> int:
        """Number of transitions in the horizon, at least 1."""
        return 20 if self.horizon is None else max(1, round(self.horizon / dt))


class Study(NamedTuple):
    """A configuration turned into objects, with the measurements read."""

    settings: Settings
    device: Any
    system: System
    measurements: Measurements
    recording: Recording
    prior: SimulatorPrior | GPPrior
    score: Any
    method: Method
    evaluation: Evaluation
    choices: dict[str, str]

    @property
    def constants(self) -> dict[str, Any]:
        """Columns of the metric table that are the same in every row."""
        return {
            "experiment": self.settings.name,
            "method": self.choices.get("method", ""),
            "sim": self.system.source.name,
            "data": self.choices.get("data", ""),
            "output": "",
            "unit": "",
        }


def settings_of(config: dict[str, Any]) -> Settings:
    """Build the `run:` group and refuse keys that no verb has."""
    for key in config:
        if key not in (*GROUPS, "choices", "run_dir", "out", "close", "report", "world"):
            raise ConfigError(f"{key}: no such key.{did_you_mean(key, list(GROUPS))} (groups: {', '.join(GROUPS)})")
    return build(config.get("run") or {}, "run", default=Settings)


def source_of(config: dict[str, Any], settings: Settings) -> Any:
    """Build the `sim:` group: a symbolic model, or a world with query access only."""
    declared = build(config["sim"], "sim", settings.plugins)
    try:
        return declared.model()
    except ValueError as error:  # simulators.model.ModelError
        raise ConfigError(str(error)) from error


def open_study(config: dict[str, Any], data_folder: Path, *, whole: bool = True) -> Study:
    """Build every object of a configuration and read the measurements.

    Args:
        config: of the job.
        data_folder: of the data YAML.
        whole: whether every state is needed in every row (see `data.reader.read`).

    Raises:
        ConfigError: a key.
        DataError: the measurements.
    """
    settings = settings_of(config)
    device = configure(settings)
    # everything that can be wrong in the YAML is found before any file is read
    parts = {name: build(config[name], name, settings.plugins) for name in ("prior", "score", "method")}
    measurements = build(config["data"], "data", default=Measurements)
    evaluation = build(config.get("evaluation") or {}, "evaluation", default=Evaluation)
    source = source_of(config, settings)
    # the split does not depend on run.seed: every seed of a sweep is judged on the same episodes
    recording = read(measurements, source, data_folder, 0, whole=whole)
    system = system_of(source, recording.outputs, measurements.stack_actions)
    return Study(
        settings, device, system, measurements, recording, **parts, evaluation=evaluation, choices=config["choices"]
    )


def resolved(job: Job) -> dict[str, Any]:
    """Return the configuration as it is kept in the run directory: absolute path of the data, choices of groups."""
    config = dict(job.config)
    if isinstance(config.get("data"), dict):
        config["data"] = absolute(config["data"], job.data_folder)
    return config


def refuse_untested(recording: Recording) -> None:
    """Refuse measurements of which nothing is kept to test on.

    Raises:
        DataError: with the cure.
    """
    if not recording.test:
        raise DataError(
            "nothing is kept to judge on (data.split.test_fraction is 0, or there are no measurements). Keep some, or name "
            "others: simpel evaluate RUN_DIR data=NAME."
        )


class Fitted(NamedTuple):
    """A rule bound to the training transitions of every seed."""

    assembled: Assembled
    bind: Callable[[Problem], Inference]
    keys: Key[Array, " seeds"]
    training: list[tuple[np.ndarray, np.ndarray]]
    available: int  # training transitions that `data.n_train` chose from
    normaliser: Normaliser

    @property
    def target_std(self) -> np.ndarray:
        """Spread of the targets over the simulator's ranges, in data units, as the networks were trained with."""
        return np.asarray(self.assembled.problems.normaliser.y_std[0], dtype=float)


def prepare(study: Study) -> Fitted:
    """Choose the training transitions of every seed and assemble the problems."""
    settings, measurements = study.settings, study.measurements
    source, stack = study.system.source, measurements.stack_actions
    recorded = study.recording.train
    pairs = transitions(recorded, stack) if recorded else no_transitions(source, len(study.recording.outputs), stack)
    training = [
        test_arrays(
            select(pairs, measurements.n_train, measurements.choice, measurements.seed_or(seed)), study.system.encoding
        )
        for seed in settings.all_seeds
    ]
    # one normaliser for all seeds and all n_train: results stay comparable
    normaliser = normaliser_of(study.system, stream(0, "normaliser"))
    assembled = assemble(
        study.system,
        normaliser,
        study.prior,
        study.score,
        training,
        study.recording.noise_std,
        study.measurements.noise_std,
        noise=study.method.noise,
        pool=study.method.pool,
        keys=[stream(seed, "prior") for seed in settings.all_seeds],
        precision=settings.precision,
    )
    keys = jnp.stack([stream(seed, "train") for seed in settings.all_seeds])
    return Fitted(assembled, _bound(study.method, assembled.setting), keys, training, len(pairs.row), normaliser)


def _bound(method: Method, setting: Setting) -> Callable[[Problem], Inference]:
    def bind(problem: Problem) -> Inference:
        return method.bind(setting, problem)

    return bind


def posteriors(study: Study, fitted: Fitted, state: Any) -> list[Posterior]:
    """Return the posterior of every seed as functions of arrays in data units."""
    bind, assembled = fitted.bind, fitted.assembled
    predict = jax.jit(lambda problem, state, x: bind(problem).predict(state, x))
    members = jax.jit(lambda problem, state, x: bind(problem).members(state, x))
    dtype = assembled.problems.x.dtype

    def of_seed(i: int) -> Posterior:
        problem, own = jax.tree.map(lambda a: a[i], (assembled.problems, state))
        return Posterior(
            predict=lambda x: predict(problem, own, jnp.asarray(x, dtype)),
            members=lambda x: members(problem, own, jnp.asarray(x, dtype)),
            particles=study.method.particles,
        )

    return [of_seed(i) for i in range(study.settings.seeds)]
