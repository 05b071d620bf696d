"""Errors of the score estimators against exact scores: `python -m tests.benchmarks.scores`.

Root mean square error over that of the score itself, at 50 draws of the law; median, smallest and largest of 5 seeds. There is
no gap process, so all of the law has to be told from its draws: with one, every estimator knows that part.
"""

import argparse
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from simpel_cli.inference.protocols import ScoreEstimator
from simpel_cli.runs.files import write_table
from simpel_cli.runs.settings import Settings, configure
from simpel_cli.scores.gaussian import Gaussian
from simpel_cli.scores.kde import KDE
from simpel_cli.scores.nu_method import NuMethod
from simpel_cli.scores.ssge import SSGE
from tests.score_targets import target

SEEDS, POINTS, WHITE = 5, 50, 1e-6
LAWS = ("gaussian", "skewed", "mixture")
ESTIMATORS: dict[str, ScoreEstimator] = {
    "gaussian": Gaussian(),
    "gaussian, ledoit_wolf": Gaussian(shrinkage="ledoit_wolf"),
    "kde": KDE(),
    "kde, scott": KDE("scott"),
    "ssge": SSGE(),
    "ssge, no baseline": SSGE(baseline="none"),
    "nu_method": NuMethod(),
    "nu_method, tikhonov": NuMethod(regularisation="tikhonov"),
    "nu_method, no baseline": NuMethod(baseline="none"),
}


@cache
def compiled(name: str) -> jax.stages.Wrapped:
    """Return an estimator's program."""
    return jax.jit(lambda h, samples, covariance: ESTIMATORS[name](h, samples, covariance))


def error(name: str, law: str, m: int, n: int, seed: int) -> float:
    """Return the relative error of one estimate."""
    draw, score = target(law, m, seed)
    samples, h = draw(n), draw(POINTS)
    found = compiled(name)(*(jnp.asarray(a, jnp.float32) for a in (h, samples, WHITE * np.eye(m))))
    exact = score(h)
    return float(np.sqrt(np.mean((np.asarray(found) - exact) ** 2) / np.mean(exact**2)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.scores", description=__doc__)
    parser.add_argument("--out", type=Path, help="a Parquet file")
    parser.add_argument("--only", nargs="+", choices=list(ESTIMATORS), default=list(ESTIMATORS))
    options = parser.parse_args()
    configure(Settings())
    sizes = [(m, n) for m in (2, 10, 40) for n in (128, 1028)]
    print("| law | estimator | " + " | ".join(f"M {m}, N {n}" for m, n in sizes) + " |")
    print("|---|---|" + "---|" * len(sizes))
    rows: dict[str, list] = {k: [] for k in ("law", "estimator", "m", "n", "seed", "error")}
    for law in LAWS:
        for name in options.only:
            cells = []
            for m, n in sizes:
                errors = [error(name, law, m, n, seed) for seed in range(SEEDS)]
                cells.append(f"{np.median(errors):.2f} ({min(errors):.2f}..{max(errors):.2f})")
                for seed, value in enumerate(errors):
                    for column, entry in zip(rows, (law, name, m, n, seed, value), strict=True):
                        rows[column].append(entry)
            print(f"| {law} | {name} | " + " | ".join(cells) + " |", flush=True)
    if options.out:
        write_table(options.out, rows)


if __name__ == "__main__":
    main()
