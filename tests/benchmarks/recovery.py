"""What parameters come to where measurements are what they are: `python -m tests.benchmarks.recovery [--only held ...]`.

A cart with friction and a drive, dv/dt = b u - a v, is simulated with one property of real measurements planted, and calibrated
by `simpel discover` with the description that fits it. `--before FOLDER` is the checkout of another version, which gets the
same data in the words that it knows. A row of the table: error of a and b in percent of the truth (mean over seeds +- 95 %
interval, Student's t), the share of 90 % intervals that hold the truth, the searches that named an effect (there is none), and
those that ended with an error.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import t as student

TRUTH = {"a": 0.7, "b": 1.3}
SIM = """name: cart
dt: 0.05
substeps: 4
states: {s: {unit: m, range: [-5, 5]}, v: {unit: m/s, range: [-3, 3]}}
inputs: {u: {unit: V, range: [-3, 3]}}
parameters: {a: {unit: 1/s, range: [0.3, 1.3]}, b: {unit: m/s^2/V, range: [0.6, 2.0]}}
dynamics: {s: v, v: b*u - a*v}
"""
TARGETS = {"sim": "simulators.model.Declared", "data": "simpel_cli.data.Measurements"}  # older versions ask for them


class Case(NamedTuple):
    """One property: keys of the simulation, words that describe it, and what is planted in words."""

    planted: str
    simulation: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    episodes: int = 8
    gaussian: bool = True


CASES = {
    "held": Case("inputs are held; nothing is said"),
    "linear": Case("inputs go straight from row to row; nothing is said", ("simulation.between_rows={u: linear}",)),
    "student_t": Case(
        "noise of v has 3 degrees of freedom", ("simulation.noise={v: {law: student_t, degrees_of_freedom: 3}}",)
    ),
    "missing": Case("4 % of the cells are missing", ("simulation.missing={s: 0.04, v: 0.04}",)),
    "rates": Case("v is measured in every fourth row", ("simulation.rates={v: 0.2}",)),
    "latency": Case(
        "s is late by 1.3 rows, as the data say", ("simulation.latency={s: 0.065}",), ("data.latency={s: 0.065}",)
    ),
    "jitter": Case("stamps stray by a fifth of a row", ("simulation.jitter=0.2",)),
    "groups": Case(
        "12 groups of 5 episodes, b differs by 20 %",
        ("simulation.groups={rig: {count: 12, parameters: {b: {law: normal, std: 0.26}}}}", "simulation.steps=40"),
        ("+sim.parameters.b.per=rig",),
        60,
    ),
}  # fmt: skip


def main() -> None:
    """Simulate, search and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.recovery", description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=CASES)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--before", type=Path, help="checkout of another version")
    options = parser.parse_args()
    here = Path(__file__).resolve().parents[2]
    print(
        "| planted | version | error of a, % | error of b, % | 90 % intervals of a, b | effect named | ended with an error |"
    )
    print("|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.only:
            case, folders = CASES[name], {}
            for seed in range(options.seeds):
                folders[seed] = _simulated(here, Path(scratch) / f"{name}{seed}", case, seed)
            for version in [here, *([options.before] if options.before else [])]:
                words = case.words if version == here else ()
                found = [_searched(version, folder, words, version == here) for folder in folders.values()]
                label = "now" if version == here else "before"
                print(f"| {case.planted} | {label} | {' | '.join(_row(found))} |", flush=True)


def _simpel(version: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(version), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import sys; from simpel_cli.main import main; sys.exit(main())", *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def _simulated(here: Path, folder: Path, case: Case, seed: int) -> Path:
    for group, text in (
        ("sim", SIM),
        ("data", "path: ../../made/measurements.parquet\ntime: t\nepisode: episode\nsplit: {column: split}\n"),
    ):
        for words, own in (("my", text), ("older", f"_target_: {TARGETS[group]}\n{text}")):
            file = folder / words / group / "cart.yaml"
            file.parent.mkdir(parents=True)
            file.write_text(own)
    truth = ", ".join(f"{k}: {v}" for k, v in TRUTH.items())
    made = _simpel(
        here, folder, "simulate", "--config-dir", "my", "sim=cart", f"simulation.episodes={case.episodes}",
        "simulation.steps=120", f"simulation.seed={seed}", "simulation.noise_std={s: 0.005, v: 0.01}",
        f"simulation.truth={{{truth}}}", "simulation.initial={s: [-0.2, 0.2], v: [-1, 1]}", *case.simulation, "out=made",
    )  # fmt: skip
    if made.returncode:
        raise SystemExit(made.stderr)
    return folder


def _searched(version: Path, folder: Path, words: tuple[str, ...], now: bool) -> dict[str, Any] | None:
    out = folder / ("now" if now else "before")
    done = _simpel(
        version, folder, "discover", "--config-dir", "my" if now else "older", "sim=cart", "data=cart",
        "effect=[coulomb_friction]", "close=false", "discovery.pairs=false", f"hydra.run.dir={out}", "run.quiet=true", *words,
    )  # fmt: skip
    if done.returncode:
        print(
            f"<!-- {folder.name} {out.name}: {done.stderr.strip().splitlines()[-1][:200] if done.stderr.strip() else ''} -->"
        )
        return None
    verdict = json.loads((out / "verdict.json").read_text())
    table = pd.read_parquet(out / "parameters.parquet")
    return {"verdict": verdict["verdict"], "table": table}


def _row(found: list[dict[str, Any] | None]) -> list[str]:
    good = [f for f in found if f is not None]
    errors: dict[str, list[float]] = {name: [] for name in TRUTH}
    inside: list[bool] = []
    for each in good:
        table = each["table"]
        for name, true in TRUTH.items():
            row = table[(table["parameter"] == name) & table["effect"].isin(["", None])].iloc[-1]  # after the search
            errors[name].append(100 * (row["value"] / true - 1))
            inside.append(bool(row["low"] <= true <= row["high"]))
    cells = [_interval(e) for e in errors.values()]
    named = sum(each["verdict"] in ("effect", "ambiguous") for each in good)
    return [
        *cells,
        f"{np.mean(inside):.2f}" if inside else "-",
        f"{named} of {len(good)}",
        f"{len(found) - len(good)} of {len(found)}",
    ]


def _interval(errors: list[float]) -> str:
    if len(errors) < 2:
        return "-"
    half = student.ppf(0.975, len(errors) - 1) * np.std(errors, ddof=1) / np.sqrt(len(errors))
    return f"{np.mean(errors):+.2f} ± {half:.2f}"


if __name__ == "__main__":
    main()
