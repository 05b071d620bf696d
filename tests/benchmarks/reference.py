"""Scores of every method on the published reference's own arrays: `python -m tests.benchmarks.reference --out DIR`.

    python -m tests.benchmarks.reference --sets pendulum_n20_s0 --methods simpel --seeds 1

All methods take the same networks, noise treatment, prior weight, data and steps (`tests.benchmarks.arrays`). The scale of
the gap is chosen by marginal likelihood unless --gap-scale says otherwise; its lengthscale is the published one for every
method, unless --lengthscale is auto, null or another number. Intervals: 95 %, Student's t over seeds.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import t

from simpel_cli.data.config import LAWS
from simpel_cli.evaluation import Posterior, one_step
from simpel_cli.inference import loop
from simpel_cli.runs.files import write_table
from simpel_cli.runs.settings import Settings, configure
from simpel_cli.studies.prepare import STRETCH
from tests.benchmarks.arrays import METHODS, SCORES, Case, case, folder, sets

KEYS = ("nll", "rmse", "crps", "coverage_90")


def scale_of(word: str) -> str | float:
    """Return what a word on the command line says of the gap's scale."""
    return word if word in ("declared", "auto") else float(word)


def lengthscale_of(word: str) -> str | float | None:
    """Return what a word on the command line says of the gap's lengthscale."""
    return {"null": None, "auto": "auto"}[word] if word in ("null", "auto") else float(word)


def scored(given: Case) -> dict[str, Any]:
    """Fit all seeds in one program and judge each on the test rows."""
    began = time.perf_counter()
    program = loop.compiled(given.bind, given.assembled.problems, given.keys, STRETCH)
    *_, last = loop.train(program, given.rule.steps)
    predict = jax.jit(lambda problem, state, x: given.bind(problem).predict(state, x))
    found: dict[str, list[float]] = {key: [] for key in KEYS}
    x, y = (np.asarray(given.arrays[k], float) for k in ("x_test", "y_test_diff"))
    for i in range(len(given.keys)):
        problem, state = jax.tree.map(lambda a, i=i: a[i], (given.assembled.problems, last.state))
        posterior = Posterior(
            lambda x, p=problem, s=state: predict(p, s, jnp.asarray(x, jnp.float32)), None, given.rule.particles
        )
        result = one_step(posterior, x, y)
        found["nll"].append(float(result.nll[:, -1].mean()))
        found["rmse"].append(float(np.sqrt(result.squared[:, -1].mean())))
        found["crps"].append(float(result.crps[:, -1].mean()))
        found["coverage_90"].append(float(result.inside[:, :-1].mean()))
    noise = np.asarray(last.info.noise_std[:, -1].mean(0) * given.normaliser.y_std)
    kappa = given.assembled.gap_scale
    return found | {
        "seconds": time.perf_counter() - began,
        "kappa": [] if kappa is None else kappa.tolist(),
        "noise_std": noise.tolist(),
    }


def interval(values: list[float]) -> str:
    """Return the mean of seeds with its interval in words."""
    half = t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5 if len(values) > 1 else np.nan
    return f"{np.mean(values):.3f} ± {half:.2g}"


def main() -> None:
    """Fit, judge and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.reference", description=__doc__)
    parser.add_argument("--sets", nargs="+", default=sets())
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--score", choices=SCORES, default="gaussian")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--gap-scale", default="auto", type=scale_of, help="declared, auto or a number")
    parser.add_argument(
        "--lengthscale", default=10.0, type=lengthscale_of, help="of the gap: auto, null, or a number in data units"
    )
    parser.add_argument("--law", choices=LAWS, default="auto", help="of the noise")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=JSON", help="fields of the method")
    parser.add_argument("--out", type=Path, help="a Parquet file, one row per set, method and seed")
    options = parser.parse_args()
    configure(Settings())
    published = json.loads((folder() / "scores.json").read_text())
    fields = {k: json.loads(v) for k, v in (word.split("=", 1) for word in options.set)}
    print(
        "| set | method | NLL | RMSE | CRPS | coverage 90 % | s, all seeds | reference NLL / RMSE |\n"
        + "|---" * 8
        + "|"
    )
    table: dict[str, list[Any]] = {k: [] for k in ("set", "method", "score", "seed", *KEYS, "kappa", "noise_std")}
    for name in options.sets:
        for method in options.methods:
            given = case(
                name,
                method,
                options.score,
                seeds=options.seeds,
                scale=options.gap_scale,
                lengthscale=options.lengthscale,
                fields=fields,
                law=options.law,
            )
            found = scored(given)
            reference = published[name].get(method)
            theirs = f"{reference['nll']:.2f} / {reference['rmse']:.3f}" if reference else "-"
            cells = " | ".join(interval(found[key]) for key in KEYS)
            print(f"| {name} | {method} | {cells} | {found['seconds']:.0f} | {theirs} |", flush=True)
            for seed in range(options.seeds):
                row = {"set": name, "method": method, "score": options.score, "seed": seed}
                row |= {"kappa": found["kappa"], "noise_std": found["noise_std"]}  # of the first seed, mean of seeds
                for key, value in (row | {k: found[k][seed] for k in KEYS}).items():
                    table[key].append(value)
            if options.out:  # what is there, should the rest not come
                write_table(options.out, table)


if __name__ == "__main__":
    main()
