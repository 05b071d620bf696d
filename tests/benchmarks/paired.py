"""Time and memory of `fit` and `discover` beside another version: `python -m tests.benchmarks.paired --before CHECKOUT`.

Data of the project: complete, Gaussian, inputs held. Versions take turns, the first turn of each fills the cache of programs
and does not count. Prints medians, and the median of the ratios of neighbouring runs.
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.cost import of_process

HERE = Path(__file__).resolve().parents[2]
HELD = "data.between_rows={u: held}"  # older versions take it so without being told
CASES = {
    "fit": (("fit", "experiment=pendulum"), ()),
    "discover": (("discover", "experiment=hidden_pendulum", "close=false"), ()),
    "discover, inputs said": (("discover", "experiment=hidden_pendulum", "close=false"), (HELD,)),
}


def cost(words: tuple[str, ...], version: Path, directory: Path) -> tuple[float, float, float]:
    """Return seconds, seconds of processors and MiB of one run of the command line.

    Raises:
        SystemExit: it failed.
    """
    command = [sys.executable, "-m", "simpel_cli.main", *words, f"hydra.run.dir='{directory}'"]
    began = time.perf_counter()
    found = of_process(command, {"PYTHONPATH": str(version)}, version)
    if found is None:
        raise SystemExit(f"simpel {' '.join(words)} failed in {version}")
    return time.perf_counter() - began, found["cpu_seconds"], found["memory_mib"]


def main() -> None:
    """Run the pairs and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.paired", description=__doc__)
    parser.add_argument("--before", type=Path, required=True, help="checkout of another version")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=CASES)
    options = parser.parse_args()
    print("| what | s now, before, ratio | s of processors, ratio | MiB now, before, ratio |\n|---|---|---|---|")
    for name in options.only:
        words, new = CASES[name]
        versions = ((HERE, (*words, *new)), (options.before.resolve(), words))
        turns = []
        with tempfile.TemporaryDirectory() as folder:
            for turn in range(options.turns + 1):
                order = versions if turn % 2 else versions[::-1]
                found = {
                    version: cost(own, version, Path(folder) / f"{turn}_{version == HERE}") for version, own in order
                }
                if turn:
                    turns.append(tuple(found[version] for version, _ in versions))
        cells = []
        for k in range(3):
            now, before = ([turn[i][k] for turn in turns] for i in (0, 1))
            ratio = statistics.median(a / b for a, b in zip(now, before, strict=True))
            cells.append(f"{statistics.median(now):.1f}, {statistics.median(before):.1f}, **{ratio:.2f}**")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
