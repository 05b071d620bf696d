"""What the simulators of conf/sim cost: `python -m tests.benchmarks.simulators [--only racecar ...]`.

For every simulator in symbols: seconds until its one-step map is there (conversion and comparison with CasADi), seconds that
XLA takes to compile it over a batch, seconds of a million transitions in float32 and memory of the process, each in a process
of its own; median of the repetitions.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SIMS = Path(__file__).parents[2] / "conf" / "sim"
POINTS, DRAWS = 64, 256
REPEATS = 5


def measured(name: str) -> dict[str, float]:
    """Measure one simulator in this process."""
    import jax
    import jax.numpy as jnp
    import yaml

    from simpel_cli.config.build import build
    from simpel_cli.inference.system import system_of
    from simpel_cli.priors.function_prior import SimulatorPrior
    from simpel_cli.runs.settings import Settings, configure

    configure(Settings(cache=False))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    model = build(yaml.safe_load((SIMS / f"{name}.yaml").read_text()), "sim").model()
    began = time.perf_counter()
    system = system_of(model, tuple(q.name for q in model.outputs), model.past())
    ready = time.perf_counter() - began
    prior = SimulatorPrior(gap=None).bind(system.transition, *system.dims, np.ones(system.encoding.dim_x))
    x = system.domain.sample(jax.random.key(0), POINTS, jnp.float32)
    began = time.perf_counter()
    program = jax.jit(lambda key: prior.simulate(key, x, DRAWS)).lower(jax.random.key(0)).compile()
    compiled = time.perf_counter() - began
    seconds = []
    for k in range(REPEATS + 1):
        began = time.perf_counter()
        program(jax.random.key(k)).block_until_ready()
        seconds.append(time.perf_counter() - began)
    million = float(np.median(seconds[1:])) / (POINTS * DRAWS) * 1e6
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    instructions = model.flow().rhs.n_instructions()
    return {
        "states": len(model.states), "parameters": len(model.params), "instructions": instructions, "ready": ready,
        "compile": compiled, "million": million, "memory": memory, "before": before,
    }  # fmt: skip


def main() -> None:
    """Measure every simulator in a process of its own and print the table."""
    every = sorted(p.stem for p in SIMS.glob("*.yaml") if "_target_: simulators.worlds" not in p.read_text())
    parser = argparse.ArgumentParser(prog="tests.benchmarks.simulators", description=__doc__)
    parser.add_argument("--only", nargs="*", default=every, choices=every)
    parser.add_argument("--here", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        print(json.dumps(measured(options.here)))
        return
    head = (
        "simulator",
        "states",
        "parameters",
        "instructions",
        "ready, s",
        "compile, s",
        "10^6 transitions, s",
        "memory, MiB",
    )
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    for name in options.only:
        command = [sys.executable, "-m", "tests.benchmarks.simulators", "--here", name]
        told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
        found = json.loads(told)
        print(
            f"| {name} | {found['states']} | {found['parameters']} | {found['instructions']} | {found['ready']:.1f} "
            f"| {found['compile']:.1f} | {found['million']:.2f} | {found['memory']:.0f} (of which {found['before']:.0f} JAX) |",
            flush=True,
        )


if __name__ == "__main__":
    main()
