"""Time and memory of a verdict: `python -m tests.benchmarks.verdicts [--only hidden_pendulum ...]`.

Every search runs as a user would run it, twice: with an empty cache of compiled programs, and with the one that it left.
The recordings need SIMPEL_SHARED; here they are searched in fewer rows than `tests.benchmarks.real` takes.
"""

import argparse
import tempfile
from pathlib import Path

from tests.benchmarks.cost import searched

SEARCHES = {
    "hidden_pendulum": ("2 states, 8 x 121 rows", ()),
    "hidden_cart": ("2 states, 8 x 301 rows", ()),
    "rc_car_bicycle": ("4 states, 600 rows", ("effect=[vehicle]", "discovery.rows=600")),
    "rc_car": ("6 states, 600 rows", ("discovery.rows=600",)),
}


def main() -> None:
    """Run the searches and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.verdicts", description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(SEARCHES), choices=SEARCHES)
    options = parser.parse_args()
    print(
        "| search | size | programs | seconds | CPU seconds | memory MiB | candidates |\n|---|---|---|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.only:
            size, words = SEARCHES[name]
            for programs in ("compiled anew", "cached"):
                cache = {"XDG_CACHE_HOME": str(Path(scratch) / "cache" / name)}
                directory = Path(scratch) / name / programs.split()[0]
                found = searched([f"experiment={name}", "close=false", *words], directory, cache)
                cost = found["cost"]
                print(
                    f"| {name} | {size} | {programs} | {found['seconds']:.0f} | {cost['cpu_seconds']:.0f} "
                    f"| {cost['memory_mib']:.0f} | {found['candidates_tried']} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
