"""Fits of a function of one input to a few exact values, as the paper's two illustrations have it."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from simpel_cli.config.build import build
from simpel_cli.config.folders import conf_dir
from simpel_cli.inference import loop
from simpel_cli.inference.assemble import assemble
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Method, Normaliser, ScoreEstimator, Training
from simpel_cli.inference.system import System, system_of
from simpel_cli.priors.function_prior import GPPrior, SimulatorPrior
from simpel_cli.runs.files import write_table, write_text
from simpel_cli.runs.settings import Settings, configure, stream
from simpel_cli.studies.prepare import STRETCH

SEEDS = 5
DRAWS = 256
Told = dict[str, dict[str, list[float]]]  # method or estimator -> figure -> one value per seed
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
    pair = Training(given.x[:, None], given.y[:, None])
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


def publish(
    where: Path, name: str, told: Told, found: dict[str, Fitted], titles: dict[str, str], checks: dict[str, bool],
    *, note: str,
) -> None:  # fmt: skip
    """Write `name`.parquet and `name`.md: every figure of every seed, the table, the claims one by one.

    Args:
        where: folder.
        name: of the figure.
        told: figures of every method.
        found: fits of every method.
        titles: figure -> head of its column.
        checks: claim -> whether it holds.
        note: what the reader should know of the claims.
    """
    rows = [(method, seed) for method in told for seed in range(SEEDS)]
    write_table(
        where / f"{name}.parquet",
        {"method": [m for m, _ in rows], "seed": [s for _, s in rows]}
        | {key: [told[m][key][s] for m, s in rows] for key in titles}
        | {"ms_per_step": [found[m].ms_per_step for m, _ in rows]},
    )
    lines = [
        f"Median, smallest and largest of {SEEDS} seeds.\n",
        f"| | {' | '.join(titles.values())} | ms a step | compile, s | s, {SEEDS} seeds |",
        "|---" * (len(titles) + 4) + "|",
        *(
            f"| {m} | {' | '.join(spread(figures[key]) for key in titles)} | {found[m].ms_per_step:.2f} "
            f"| {found[m].compile_seconds:.1f} | {found[m].seconds:.0f} |"
            for m, figures in told.items()
        ),
        "",
        *(f"* {'holds' if good else 'DOES NOT HOLD'}: {claim}" for claim, good in checks.items()),
        f"* {note}",
    ]
    text = "\n".join(lines) + "\n"
    write_text(where / f"{name}.md", text)
    print(f"\n{text}\n{where / f'{name}.png'}")
