"""Scores and times on the published reference's own pendulum arrays (SIMPEL_SHARED/reference).

    python -m tests.benchmarks.reference                  # every set and method, 5 seeds
    python -m tests.benchmarks.reference --sets pendulum_n20_s0 --methods simpel --seeds 1

Settings: simulator pendulum_published, gap GP l = 10 raw, N = 1028, L = 20, 3 x 64, 32 + 8 points, the reference's number
of steps (5000 at 20 transitions, 7000 at 320). The scale of the gap is chosen by marginal likelihood unless --gap-scale
says otherwise.
"""

import argparse
import json
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from simpel_cli import loop
from simpel_cli.commands.study import STRETCH
from simpel_cli.config import conf_dir
from simpel_cli.evaluation import Posterior, one_step
from simpel_cli.inference import Method
from simpel_cli.nodes import build
from simpel_cli.prior import GapGP, GPPrior, SimulatorPrior
from simpel_cli.problem import assemble, normaliser_of, system_of
from simpel_cli.run import Settings, configure, stream

SETS = {"pendulum_n20_s0": 5000, "pendulum_n20_s1": 5000, "pendulum_n320_s0": 7000, "pendulum_n320_s1": 7000}
METHODS = (
    "simpel", "simpel_only_sim", "map", "repulsive", "fsvgd", "ensemble", "svgd", "greybox", "sysid", "gp",
)  # fmt: skip
SCORES = ("gaussian", "kde", "ssge", "nu_method")
NOISE = {"phi": 0.02, "omega": 0.02}  # of the arrays, per output component


def node(group: str, name: str) -> dict:
    return {
        k: v for k, v in yaml.safe_load((conf_dir() / group / f"{name}.yaml").read_text()).items() if k != "defaults"
    }


def scale_of(word: str) -> str | float:
    """Return what a word on the command line says of the gap's scale."""
    return word if word in ("declared", "auto") else float(word)


def prior_of(method: str, scale: str | float) -> SimulatorPrior | GPPrior:
    """Return the prior that the method's YAML chooses, with the published gap."""
    chosen = yaml.safe_load((conf_dir() / "method" / f"{method}.yaml").read_text())["defaults"][0]
    (name,) = chosen.values()
    if name == "gp":
        return build(node("prior", "gp"), "prior")
    gap = GapGP(lengthscale=10.0, lengthscale_units="raw", scale=scale) if name == "simulator" else None
    return SimulatorPrior(gap=gap)


def rule_of(method: str, steps: int, overrides: dict) -> Method:
    """Return the method of its YAML; those that train networks take the reference's number of steps."""
    given = node("method", method)
    if "residual" in given:
        given["residual"] |= {"steps": steps}
    elif "network" in given:
        given |= {"steps": steps}
    return build(given | overrides, "method")


def fit(arrays: dict, method: str, score: str, steps: int, seeds: int, scale: str | float, overrides: dict) -> dict:
    began = time.perf_counter()
    declared = build(node("sim", "pendulum_published"), "sim").model()
    system = system_of(declared, (), 0)
    normaliser = normaliser_of(system, stream(0, "normaliser"))
    rule = rule_of(method, steps, overrides)
    pair = (np.asarray(arrays["x_train"], float), np.asarray(arrays["y_train_diff"], float))
    assembled = assemble(
        system, normaliser, prior_of(method, scale), build(node("score", score), "score"), [pair] * seeds, NOISE, NOISE,
        noise=rule.noise, pool=rule.pool, keys=[stream(s, "prior") for s in range(seeds)], precision="float32",
    )  # fmt: skip
    keys = jnp.stack([stream(s, "train") for s in range(seeds)])
    bind = lambda problem: rule.bind(assembled.setting, problem)  # noqa: E731
    program = loop.compiled(bind, assembled.problems, keys, STRETCH)
    laps = [time.perf_counter()]
    state = None
    for stretch in loop.train(program, rule.steps):
        state = stretch.state
        laps.append(time.perf_counter())
    predict = jax.jit(lambda problem, state, x: bind(problem).predict(state, x))
    nll, rmse, crps, inside = [], [], [], []
    for i in range(seeds):
        problem, own = jax.tree.map(lambda a, i=i: a[i], (assembled.problems, state))
        posterior = Posterior(
            lambda x, p=problem, s=own: predict(p, s, jnp.asarray(x, jnp.float32)), None, rule.particles
        )
        result = one_step(posterior, np.asarray(arrays["x_test"], float), np.asarray(arrays["y_test_diff"], float))
        nll.append(result.nll[:, -1].mean())
        rmse.append(np.sqrt(result.squared[:, -1].mean()))
        crps.append(result.crps[:, -1].mean())
        inside.append(result.inside[:, :-1].mean())
    per_step = float(np.median(np.diff(laps))) / min(STRETCH, rule.steps) * 1e3
    return {
        "nll": nll, "rmse": rmse, "crps": crps, "coverage_90": inside, "ms_per_step": per_step / seeds,
        "compile_s": program.compile_seconds, "fit_s": time.perf_counter() - began,
        "kappa": None if assembled.gap_scale is None else assembled.gap_scale.tolist(),
        "noise_std": np.asarray(stretch.info.noise_std[:, -1].mean(0) * normaliser.y_std).tolist(),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=list(SETS))
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--score", choices=SCORES, default="gaussian")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--gap-scale", default="auto", type=scale_of, help="declared, auto or a number")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=JSON", help="fields of the method")
    options = parser.parse_args()
    configure(Settings())
    folder = Path(os.environ.get("SIMPEL_SHARED", "../shared")) / "reference"
    published = json.loads((folder / "scores.json").read_text())
    overrides = {k: json.loads(v) for k, v in (word.split("=", 1) for word in options.set)}
    print(
        "| set | method | NLL | RMSE | CRPS | coverage 90 % | ms/step/seed | compile s | whole s | reference NLL / RMSE |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in options.sets:
        arrays = dict(np.load(folder / f"{name}.npz"))
        for method in options.methods:
            r = fit(arrays, method, options.score, SETS[name], options.seeds, options.gap_scale, overrides)
            spread = {k: f"{np.mean(r[k]):.3f} ± {np.std(r[k]):.3f}" for k in ("nll", "rmse", "crps", "coverage_90")}
            reference = published[name].get(method)
            theirs = f"{reference['nll']:.2f} / {reference['rmse']:.3f}" if reference else "-"
            print(
                f"| {name} | {method} | {spread['nll']} | {spread['rmse']} | {spread['crps']} | {spread['coverage_90']} "
                f"| {r['ms_per_step']:.2f} | {r['compile_s']:.1f} | {r['fit_s']:.1f} "
                f"| {theirs} |  kappa {r['kappa']} noise {r['noise_std']}",
                flush=True,
            )


if __name__ == "__main__":
    main()
