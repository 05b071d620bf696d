"""Fits of a function of one input to a few exact values, as the paper's two illustrations have it."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from simpel_cli import loop
from simpel_cli.commands.study import STRETCH
from simpel_cli.config import conf_dir
from simpel_cli.inference import Method, NoiseModel, Normaliser, ScoreEstimator
from simpel_cli.nodes import build
from simpel_cli.prior import GPPrior, SimulatorPrior
from simpel_cli.problem import System, assemble, system_of
from simpel_cli.run import Settings, configure, stream

SEEDS = 5
DRAWS = 256
EXACT = NoiseModel(learn=False, least_init=0.05)  # normalised; the data carry no noise


class Fitted(NamedTuple):
    """Particles of every seed on a grid.

    Args:
        particles: (seeds, L, n).
        ms_per_step: of one seed, median over stretches.
        compile_seconds: of the program.
        seconds: of all seeds together.
    """

    particles: np.ndarray
    ms_per_step: float
    compile_seconds: float
    seconds: float


class Task(NamedTuple):
    """A static system with its training points.

    Args:
        system: the simulator.
        normaliser: published constants.
        x, y: (m,) training inputs and exact values.
        grid: (n,) where particles are looked at.
    """

    system: System
    normaliser: Normaliser
    x: np.ndarray
    y: np.ndarray
    grid: np.ndarray


def task(sim: str, x_std: float, y_std: float, x: Sequence[float], y: np.ndarray, grid: np.ndarray) -> Task:
    """Return the task of a simulator in conf/sim."""
    node = yaml.safe_load((conf_dir() / "sim" / f"{sim}.yaml").read_text())
    normaliser = Normaliser(*(np.array([v]) for v in (0.0, x_std, 0.0, y_std)))
    return Task(system_of(build(node, "sim").model(), tuple(node["outputs"]), 0), normaliser, np.array(x), y, grid)


def fit(
    given: Task, prior: SimulatorPrior | GPPrior, score: ScoreEstimator, rule: Method, seeds: int = SEEDS
) -> Fitted:
    """Fit a rule from several seeds in one program."""
    configure(Settings())
    pair = (given.x[:, None], given.y[:, None])
    assembled = assemble(
        given.system, given.normaliser, prior, score, [pair] * seeds, {}, {},
        noise=rule.noise, pool=rule.pool, keys=[stream(s, "prior") for s in range(seeds)], precision="float32",
    )  # fmt: skip
    keys = jnp.stack([stream(s, "train") for s in range(seeds)])

    def bind(problem: Any) -> Any:
        return rule.bind(assembled.setting, problem)

    began = time.perf_counter()
    program = loop.compiled(bind, assembled.problems, keys, STRETCH)
    laps, state = [time.perf_counter()], None
    for stretch in loop.train(program, rule.steps):
        state = stretch.state
        laps.append(time.perf_counter())
    x = jnp.asarray(given.grid[:, None], jnp.float32)
    at = jax.jit(jax.vmap(lambda problem, state: bind(problem).predict(state, x).particles[:, :, 0]))
    particles = np.asarray(at(assembled.problems, state))
    per_step = float(np.median(np.diff(laps))) / min(STRETCH, rule.steps) * 1e3 / seeds
    return Fitted(particles, per_step, program.compile_seconds, time.perf_counter() - began)


def draws(given: Task, count: int, seed: int = 0) -> np.ndarray:
    """Return draws of the simulator on the grid, (count, n)."""
    return given.system.simulate(stream(seed, "shown"), given.grid[:, None], count)[:, :, 0]


def folder(out: Path | None, name: str) -> Path:
    """Make the folder that results go to."""
    where = out or Path("runs") / "reproduce" / name
    where.mkdir(parents=True, exist_ok=True)
    return where


def spread(values: Sequence[float], digits: int = 3) -> str:
    """Return median, smallest and largest in words."""
    return f"{np.median(values):.{digits}g} ({min(values):.{digits}g}..{max(values):.{digits}g})"
