"""What one iteration of four fits costs: `python -m tests.benchmarks.fits [--only hidden_pendulum rc_car]`.

The program of a search with its whole catalogue, as `simpel discover experiment=NAME` compiles it; the simulator and one
effect move. The recordings need SIMPEL_SHARED.
"""

import argparse
import statistics
import tempfile
import time
from functools import partial
from typing import Any

import jax

from simpel_cli.config.compose import Job, launch
from simpel_cli.discovery import searched
from simpel_cli.discovery.search.calibration import prepared
from simpel_cli.discovery.search.smaller import fitter_of
from simpel_cli.discovery.search.trials import Search
from simpel_cli.filtering.likelihood.fit import Hypothesis
from simpel_cli.filtering.setup import members, terms_of
from simpel_cli.runs.console import Terminal
from simpel_cli.studies.declared import declare, resolved
from simpel_cli.studies.open import open_study

SEARCHES = ("hidden_pendulum", "rc_car")


def timed(name: str, rounds: int, job: Job) -> None:
    """Print the median and the best of some iterations."""
    config = resolved(job)
    with jax.enable_x64(True):
        declared = declare(config | {"run": {**(config.get("run") or {}), "precision": "float64"}})
        study, terminal = open_study(declared, job.data_folder, whole=False), Terminal(quiet=True)
        effects: list[Any] = declared.groups["effect"]
        ground = searched.ground_of(study, len(effects), terminal)
        attach, options = ground.attach(effects), ground.options
        terms = terms_of(ground.model, ground.clean.recording, effects, pairs=options.pairs)
        plan = prepared(attach, ground.model, terms, options, terminal)[0]
        fitter = fitter_of(plan, options.lanes, options.room + members(plan))
        search = Search(plan, fitter)
        start = plan.start if plan.optimum is None else plan.optimum
        named = [t for t, term in enumerate(search.terms) if not term.depends_on and search.fits((t,))]
        hypotheses = [Hypothesis(start, search.free((t,)), search.ones) for t in named[: options.lanes]]
        seconds = []
        for _ in range(rounds + 1):
            began = time.perf_counter()
            fitter(hypotheses, 1)
            seconds.append(time.perf_counter() - began)
    first, *rest = seconds
    windows, rows, _ = plan.windows.y.shape
    print(
        f"| {name} | {len(plan.augmented.model.states)} | {windows} x {rows} | {len(plan.augmented.params)} "
        f"| {1e3 * statistics.median(rest):.1f} | {1e3 * min(rest):.1f} | {first:.0f} |",
        flush=True,
    )


def main() -> None:
    """Time the programs and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.fits", description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(SEARCHES), choices=SEARCHES)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    print("| search | states | rows | unknowns | ms, median | best | first, s |\n|---|---|---|---|---|---|---|")
    for name in options.only:
        with tempfile.TemporaryDirectory() as folder:
            words = [f"experiment={name}", "close=false", f"hydra.run.dir='{folder}/run'"]
            launch("discover", partial(timed, name, options.rounds), words, config_dir=None)


if __name__ == "__main__":
    main()
