"""`simpel discover` on the recordings: `python -m tests.benchmarks.real --out DIR [--only emps ...]` (needs SIMPEL_SHARED).

Every verdict as a row of a table, and the errors after each accepted effect.
"""

import argparse
from pathlib import Path
from typing import Any

from tests.benchmarks.cost import searched

EXPERIMENTS = ("free_pendulum", "cascaded_tanks", "ball_drops", "emps", "rc_car_bicycle", "rc_car")
CLOSED = ("free_pendulum", "emps", "rc_car_bicycle")  # SimPEL with the old and the corrected simulator, too
WORDS = {"rc_car_bicycle": ("effect=[vehicle]",)}


def run(name: str, out: Path) -> dict[str, Any]:
    """Search one recording, unless that was done, and return its verdict."""
    words = [f"experiment={name}", f"close={str(name in CLOSED).lower()}", *WORDS.get(name, ())]
    return searched(words, out / name)


def row(name: str, found: dict[str, Any]) -> str:
    """Return the table's row of one recording: errors of every measured quantity before and after."""
    before, after = found["error"]["before"], found["error"]["after"]
    cells = []
    for kind in ("one_step", "horizon", "free_run"):
        pairs = [f"{q} {_short(before[kind][q])} -> {_short(after[kind][q])}" for q in before[kind]]
        cells.append("<br>".join(pairs))
    effects = ", ".join(f"{e['name']} on {e['acts_on']}" for e in found["effects"]) or "-"
    rest = f"; left: depends on {', '.join(found['remainder']['depends_on'])}" if found["remainder"] else ""
    return (
        f"| {name} | {found['verdict']} | {effects}{rest} | "
        + " | ".join(cells)
        + f" | {found['seconds']:.0f} | {found['cost']['memory_mib']:.0f} |"
    )


def steps(name: str, found: dict[str, Any]) -> list[str]:
    """Return the errors some rows ahead after each accepted effect, a line each."""
    ahead = found["error"]["horizon_steps"]
    lines = []
    for step in found["steps"]:
        errors = ", ".join(f"{q} {_short(value)}" for q, value in step["error"]["horizon"].items())
        lines.append(f"* {name}, {ahead} rows ahead, {' and '.join(step['added']) or 'calibrated'}: {errors}")
    return lines


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def main() -> None:
    """Run the recordings and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.real", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(EXPERIMENTS), choices=EXPERIMENTS)
    options = parser.parse_args()
    out = options.out.resolve()
    lines = [
        "| recording | verdict | effects | one step | 20 rows ahead | free run | seconds | MiB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    sentences = []
    for name in options.only:
        found = run(name, out)
        lines.append(row(name, found))
        sentences += [f"* {name}: {found['summary']}", *steps(name, found)]
    text = "\n".join([*lines, "", *sentences])
    (out / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
