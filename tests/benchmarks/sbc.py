"""Simulation-based calibration of an experiment: `python -m tests.benchmarks.sbc experiment=pendulum --replicas 40 --out DIR`.

Functions are drawn from the experiment's own prior (simulator and gap GP, kappa as the real data choose it), measured at its
own training inputs with noise at its initial value, and fitted. In the posterior of a right inference the truth has every rank
among the particles equally often, and z = (truth - mean)/std has standard deviation 1.

Reference: Talts, Betancourt, Simpson, Vehtari and Gelman (2018), Validating Bayesian inference algorithms with simulation-based
calibration; Cook, Gelman and Rubin (2006).
"""

import argparse
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from simpel_cli.config.compose import Job, launch
from simpel_cli.data import transitions
from simpel_cli.evaluation import test_arrays
from simpel_cli.inference import loop
from simpel_cli.inference.assemble import assemble
from simpel_cli.reporting.figures.canvas import COLOURS, new_figure, save
from simpel_cli.runs.files import write_table
from simpel_cli.runs.settings import stream
from simpel_cli.studies.declared import declare, resolved
from simpel_cli.studies.open import Study, open_study
from simpel_cli.studies.prepare import STRETCH, Fitted, prepare

MOST_TESTED = 64  # inputs at which the posterior is looked at


class Drawn(NamedTuple):
    """Functions of the prior at training and test inputs, data units.

    Args:
        x: (M, dx) training inputs first.
        f: (R, M, dy).
        noise_std: (dy,) of a measurement.
    """

    x: np.ndarray
    f: np.ndarray
    noise_std: np.ndarray


def drawn(study: Study, fitted: Fitted, replicas: int) -> Drawn:
    """Draw functions from the prior of a study."""
    problem = jax.tree.map(lambda a: np.asarray(a[0], float), fitted.assembled.problems._replace(bank=None))
    pairs = transitions(study.recording.test, study.measurements.stack_actions)
    x_test, _ = test_arrays(pairs, study.system.encoding)
    rows = np.unique(np.linspace(0, len(x_test) - 1, MOST_TESTED).round().astype(int))
    x = np.concatenate([fitted.training[0][0], x_test[rows]])
    scale = problem.normaliser
    at = jnp.asarray((x - scale.x_mean) / scale.x_std)
    known = np.asarray(fitted.assembled.setting.prior.covariance(at, problem.gap_scale, problem.gap_relevance), float)
    factor = np.linalg.cholesky(known + 1e-10 * np.eye(len(x)))
    normal = np.random.default_rng(0).normal(size=(replicas, len(x), len(known)))
    gap = np.einsum("dij,rjd->rid", factor, normal) * scale.y_std
    simulated = study.system.simulate(stream(0, "sbc"), x, replicas)
    return Drawn(x, simulated + gap, problem.noise_init * scale.y_std)


def particles(study: Study, fitted: Fitted, given: Drawn) -> np.ndarray:
    """Fit every replica, all in one program, and return its particles at the test inputs, (R, L, n, dy)."""
    m, replicas = len(fitted.training[0][0]), len(given.f)
    noise = np.random.default_rng(1).normal(size=given.f[:, :m].shape) * given.noise_std
    training = [(given.x[:m], y) for y in given.f[:, :m] + noise]
    assembled = assemble(
        study.system, fitted.normaliser, study.prior, study.score, training, study.recording.noise_std,
        study.measurements.noise_std, noise=study.method.noise, pool=study.method.pool,
        keys=[stream(r, "prior") for r in range(replicas)], precision=study.settings.precision,
    )  # fmt: skip
    own = fitted.assembled.problems
    scale, relevance = (
        None if a is None else jnp.repeat(a[:1], replicas, axis=0) for a in (own.gap_scale, own.gap_relevance)
    )
    problems = assembled.problems._replace(gap_scale=scale, gap_relevance=relevance)
    bind = partial(study.method.bind, assembled.setting)
    program = loop.compiled(bind, problems, jnp.stack([stream(r, "train") for r in range(replicas)]), STRETCH)
    *_, last = loop.train(program, study.method.steps)
    x = jnp.asarray(given.x[m:], problems.x.dtype)
    return np.asarray(jax.vmap(lambda p, s: bind(p).predict(s, x).particles)(problems, last.state), float)


def told(h: np.ndarray, truth: np.ndarray, names: tuple[str, ...], out: Path | None) -> None:
    """Print coverage and the spread of z per output, and draw the ranks.

    Args:
        h: (R, L, n, dy) particles.
        truth: (R, n, dy).
        names: of the outputs.
        out: folder for the table and the figure.
    """
    count, number = h.shape[:2]
    rank = (h < truth[:, None]).sum(axis=1)  # (R, n, dy), 0..L
    z = (truth - h.mean(axis=1)) / h.std(axis=1, ddof=1)
    print(
        "| output | inside the particles' central 50 % | 90 % | standard deviation of z | mean of z |\n|---|---|---|---|---|"
    )
    random = np.random.default_rng(2)
    for i, name in enumerate(names):
        cells = []
        for level in (0.5, 0.9):
            edge = (1 - level) / 2 * (number + 1)
            cells.append(((rank[:, :, i] >= edge) & (rank[:, :, i] <= number - edge)).mean(axis=1))
        cells += [(z[:, :, i] ** 2).mean(axis=1), z[:, :, i].mean(axis=1)]
        shown = []
        for k, each in enumerate(cells):  # 95 % by resampling replicas
            means = each[random.integers(0, count, (2000, count))].mean(axis=1)
            ends = [each.mean(), *np.quantile(means, [0.025, 0.975])]
            middle, low, high = np.sqrt(ends) if k == 2 else ends
            shown.append(f"{middle:.2f} ({low:.2f}..{high:.2f})")
        print(f"| {name} | {' | '.join(shown)} |", flush=True)
    if out is None:
        return
    out.mkdir(parents=True, exist_ok=True)
    replica, row, output = (a.ravel() for a in np.indices(rank.shape))
    columns = {"replica": replica, "row": row, "output": np.array(names)[output], "rank": rank.ravel(), "z": z.ravel()}
    write_table(out / "sbc.parquet", columns)
    figure, axes = new_figure(len(names))
    for i, (axis, name) in enumerate(zip(axes, names, strict=True)):
        axis.hist(rank[:, :, i].ravel(), bins=np.arange(number + 2) - 0.5, density=True, color=COLOURS[0])
        axis.axhline(1 / (number + 1), color=COLOURS[1], linestyle="--")
        axis.set(title=name, xlabel="rank of the truth among the particles", ylabel="share")
    save(figure, out / "sbc.png")


def main() -> None:
    """Run the calibration."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.sbc", description=__doc__)
    parser.add_argument("words", nargs="+", help="of `simpel fit`, e.g. experiment=pendulum method=fsvgd")
    parser.add_argument("--replicas", type=int, default=40)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()

    def task(job: Job) -> None:
        study = open_study(declare(resolved(job)), job.data_folder)
        fitted = prepare(study)
        given = drawn(study, fitted, options.replicas)
        h = particles(study, fitted, given)
        told(h, given.f[:, len(fitted.training[0][0]) :], study.system.encoding.y_names, options.out)

    launch("fit", task, [*options.words, "hydra.run.dir='.'"], config_dir=None, flags=[])


if __name__ == "__main__":
    main()
