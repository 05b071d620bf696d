"""`simpel discover` on the recordings: `python -m tests.benchmarks.real --out DIR [--only emps ...]` (needs SIMPEL_SHARED).

Every verdict as a row of a table, and the errors after each accepted effect. `--before FOLDER` is the checkout of another
version, which searches the same recordings in the words that it knows.
"""

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from tests.benchmarks.cost import searched

HERE = Path(__file__).resolve().parents[2]
EXPERIMENTS = (
    "free_pendulum",
    "cascaded_tanks",
    "ball_drops",
    "emps",
    "silverbox",
    "tclab",
    "rc_car_bicycle",
    "rc_car",
)
CLOSED = ("free_pendulum", "emps", "rc_car_bicycle")  # SimPEL with the old and the corrected simulator, too
WORDS = {"rc_car_bicycle": ("effect=[vehicle]",)}
DESCRIBED = {"ball_drops": ("effect.quadratic_drag.per=ball",)}  # in words that older versions lack
TARGETS = {"sim": "simulators.model.Declared", "data": "simpel_cli.data.Measurements"}  # older versions ask for them
TEST_PARTS = re.compile(r"split: \{column: split, test: \[(\w+)\]\}")
NEW_KEYS = re.compile(r",? *between_rows: \w+")


def run(name: str, out: Path, *, close: bool = True) -> dict[str, Any]:
    """Search one recording, unless that was done, and return its verdict."""
    closed = close and name in CLOSED
    words = [f"experiment={name}", f"close={str(closed).lower()}", *WORDS.get(name, ()), *DESCRIBED.get(name, ())]
    return searched(words, out / name)


def run_before(name: str, version: Path, out: Path) -> dict[str, Any]:
    """Search one recording in another version; experiments that it lacks are written for it from those of this one."""
    written: Sequence[str] = ()
    if not (version / "conf" / "experiment" / f"{name}.yaml").exists():
        folder = out / "conf"
        for group in ("sim", "data", "experiment"):
            text = NEW_KEYS.sub("", (HERE / "conf" / group / f"{name}.yaml").read_text())
            if found := TEST_PARTS.search(text):
                text = TEST_PARTS.sub("split: {column: split}", text).replace(*_relabelled(name, found[1], out))
            file = folder / group / f"{name}.yaml"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(f"_target_: {TARGETS[group]}\n{text}" if group in TARGETS else text)
        written = ("--config-dir", str(folder))
    words = [*written, f"experiment={name}", "close=false", *WORDS.get(name, ())]
    return searched(words, out / f"{name}_before", {"PYTHONPATH": str(version)}, version)


def _relabelled(name: str, part: str, out: Path) -> tuple[str, str]:
    """Write a recording whose test is called `test`, and return how its data YAML names it, and the new file."""
    file = f"data/{name}/measurements.parquet"
    table = pd.read_parquet(Path(os.environ["SIMPEL_SHARED"]) / file)
    table["split"] = table["split"].replace({part: "test"})
    copy = out / f"{name}.parquet"
    table.to_parquet(copy)
    return "${simpel_shared:}/" + file, str(copy)


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
    parser.add_argument("--before", type=Path, help="checkout of another version; nothing is closed then")
    options = parser.parse_args()
    out = options.out.resolve()
    lines = [
        "| recording | verdict | effects | one step | 20 rows ahead | free run | seconds | MiB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    sentences = []
    for name in options.only:
        verdicts = {name: run(name, out, close=options.before is None)}
        if options.before:
            verdicts[f"{name} (before)"] = run_before(name, options.before.resolve(), out)
        for label, found in verdicts.items():
            lines.append(row(label, found))
            sentences += [f"* {label}: {found['summary']}", *steps(label, found)]
        (out / "table.md").write_text("\n".join([*lines, "", *sentences]) + "\n")
    print((out / "table.md").read_text())


if __name__ == "__main__":
    main()
