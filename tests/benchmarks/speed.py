"""Time and memory of training on one core: `python -m tests.benchmarks.speed estimators|methods|growth --out FILE.parquet`.

Every case runs in a process of its own, pinned to one core, several rounds of all cases in turn; the first round finds no
compiled programs, the later ones do. Printed: medians over rounds, and the ratio to the first case of the same round. The
limit is that of the networks' arithmetic, forward and backward, at the speed at which this core multiplies such matrices.
"""

import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

CORE = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1", "OMP_NUM_THREADS": "1"}
PENDULUM, CAR = "pendulum_n20_s0", "rc_car_n50_s0"
ESTIMATORS = {
    f"{'pendulum' if name == PENDULUM else 'car'}, {score}, N {draws}": {"name": name, "score": score, "draws": draws}
    for name in (PENDULUM, CAR)
    for score in ("gaussian", "kde", "ssge", "nu_method")
    for draws in (128, 256, 1028)
}
METHODS = {
    f"{'pendulum' if name == PENDULUM else 'car'}, {method}": {"name": name, "method": method}
    for name in (PENDULUM, CAR)
    for method in ("simpel", "simpel_only_sim", "map", "repulsive", "fsvgd", "ensemble", "svgd", "greybox")
}
GROWTH = {
    "L 20, 24 + 16 points, N 1028, m 20": {"name": PENDULUM},
    **{f"N {n}": {"name": PENDULUM, "draws": n} for n in (128, 4112)},
    **{f"24 + {m} points": {"name": PENDULUM, "fields": {"fresh_points": m}} for m in (8, 64)},
    **{f"L {n}": {"name": PENDULUM, "fields": {"particles": n}} for n in (5, 80)},
    **{f"m {m}": {"name": PENDULUM, "rows": m} for m in (320, 5120)},
}
GROUPS = {"estimators": ESTIMATORS, "methods": METHODS, "growth": GROWTH}
KEYS = ("ms_per_step", "share_of_limit", "start_s", "prepare_s", "compile_s", "fit_s", "memory_mib")


def limit(particles: int, points: int, sizes: list[int]) -> float:
    """Return the milliseconds that the networks' arithmetic of one step takes on this core at best."""
    import jax
    import jax.numpy as jnp

    repeats, width = 50, max(sizes[1:-1])
    a = jnp.ones((particles, points, width), jnp.float32)
    w = jnp.full((particles, width, width), 1 / width, jnp.float32)
    many = jax.jit(lambda a, w: jax.lax.fori_loop(0, repeats, lambda _, a: jnp.einsum("lkd,lde->lke", a, w), a))
    many(a, w).block_until_ready()
    laps = []
    for _ in range(20):
        began = time.perf_counter()
        many(a, w).block_until_ready()
        laps.append(time.perf_counter() - began)
    per_flop = min(laps) / (repeats * 2 * particles * points * width**2)
    flop = 3 * 2 * particles * points * sum(i * o for i, o in itertools.pairwise(sizes))
    return flop * per_flop * 1e3


def measured(given: dict[str, Any], stretches: int, started: float) -> dict[str, float]:
    """Train a few stretches of a case and return what it cost.

    Args:
        given: arguments of `arrays.case`.
        stretches: to train.
        started: when the process began, seconds of the epoch.
    """
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    from simpel_cli.inference import loop
    from simpel_cli.runs.settings import Settings, configure
    from simpel_cli.studies.prepare import STRETCH
    from tests.benchmarks.arrays import case

    configure(Settings())
    start = time.time() - started
    began = time.perf_counter()
    prepared = case(**given)
    prepare = time.perf_counter() - began
    program = loop.compiled(prepared.bind, prepared.assembled.problems, prepared.keys, STRETCH)
    laps = [time.perf_counter(), *(time.perf_counter() for _ in loop.train(program, stretches * STRETCH))]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    per_step = float(np.median(np.diff(laps)[1:])) / STRETCH * 1e3
    rule = prepared.rule
    trained = getattr(rule, "residual", rule)  # GreyBox trains those of its residual
    shape = prepared.assembled.problems.x.shape
    points = min(trained.batch, shape[1]) + getattr(trained, "fresh_points", 0)
    sizes = [shape[2], *trained.network.hidden, prepared.assembled.setting.prior.dim_y]
    best = limit(trained.particles, points, sizes)
    return {
        "ms_per_step": per_step,
        "share_of_limit": best / per_step,
        "start_s": start,
        "prepare_s": prepare,
        "compile_s": program.compile_seconds,
        "fit_s": start + prepare + program.compile_seconds + per_step * rule.steps / 1e3,
        "memory_mib": memory,
    }


def run(given: dict[str, Any], stretches: int, cache: Path) -> dict[str, float]:
    """Measure a case in a process of its own."""
    words = ["--case", json.dumps(given), "--stretches", str(stretches), "--started", str(time.time())]
    found = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.speed", "estimators", *words],
        env=os.environ | CORE | {"XDG_CACHE_HOME": str(cache)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if found.returncode:
        raise SystemExit(found.stderr)
    return json.loads(found.stdout.splitlines()[-1])


def main() -> None:
    """Run all cases of a group in turn and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.speed", description=__doc__)
    parser.add_argument("group", choices=GROUPS)
    parser.add_argument("--only", nargs="*", help="cases whose name holds one of these words")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--stretches", type=int, default=4)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--case", help=argparse.SUPPRESS)
    parser.add_argument("--started", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        print(json.dumps(measured(json.loads(options.case), options.stretches, options.started)))
        return
    from simpel_cli.runs.files import write_table

    cases = {k: v for k, v in GROUPS[options.group].items() if not options.only or any(w in k for w in options.only)}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in cases}
    with tempfile.TemporaryDirectory() as cache:
        for number in range(options.rounds):
            for name, given in cases.items():
                found[name].append(run(given, options.stretches, Path(cache)))
                print(
                    f"round {number + 1}: {name}: {found[name][-1]['ms_per_step']:.2f} ms", file=sys.stderr, flush=True
                )
    first = next(iter(found.values()))
    print("| case | ms a step | ratio | limit, share | start s | prepare s | compile s, anew / cached | fit s | MiB |")
    print("|---" * 9 + "|")
    for name, rounds in found.items():
        middle = {k: float(np.median([r[k] for r in rounds])) for k in KEYS}
        ratio = float(np.median([r["ms_per_step"] / f["ms_per_step"] for r, f in zip(rounds, first, strict=True)]))
        later = float(np.median([r["compile_s"] for r in rounds[1:]])) if len(rounds) > 1 else float("nan")
        print(
            f"| {name} | {middle['ms_per_step']:.2f} | {ratio:.2f} | {100 * middle['share_of_limit']:.0f} % "
            f"| {middle['start_s']:.1f} | {middle['prepare_s']:.1f} | {rounds[0]['compile_s']:.1f} / {later:.1f} "
            f"| {middle['fit_s']:.1f} | {middle['memory_mib']:.0f} |",
            flush=True,
        )
    if options.out:
        rows = [(name, number, r) for name, rounds in found.items() for number, r in enumerate(rounds)]
        columns = {"case": [n for n, _, _ in rows], "round": [k for _, k, _ in rows]}
        write_table(options.out, columns | {k: [r[k] for _, _, r in rows] for k in KEYS})


if __name__ == "__main__":
    main()
