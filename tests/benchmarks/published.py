"""Published benchmarks by their own protocol: `python -m tests.benchmarks.published --out DIR [--only NAME ...]`.

Free simulation of the whole test record from a state that the first rows tell (as many as the protocol allows:
`discovery.first_rows` of the experiment), root mean square of the error of the rows behind. `calibrated` is the simulator with
the parameters that suit it best, `discover` what the search made of it by itself, `by hand` a model whose structure was given
(`tests.benchmarks.specialists`), `published` what others report. A run that DIR holds already is not repeated.

EMPS and the free swing are searched in rows resampled from 1 kHz, whose filter reaches 40 and 200 samples further than
a row; the model by hand sees the samples themselves. So there the two do not begin with quite the same.
"""

import argparse
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from tests.benchmarks.cost import searched
from tests.benchmarks.specialists import RIGS, specialist

PIGA = "Forgione and Piga 2021, table of others' figures"
CHAMPNEYS = "MDCHAMP/nonlinear_baselines"
NEAR = 1.3  # times the error of the model by hand


class Figure(NamedTuple):
    """An error that somebody published."""

    method: str
    value: float
    source: str


class Benchmark(NamedTuple):
    """A part of a recording on which a free run is judged.

    Args:
        experiment: that is searched.
        part: of the test, as `specialists` calls it; `all`.
        published: by others, in the unit of `specialists`.
    """

    experiment: str
    part: str
    published: tuple[Figure, ...] = ()


WORDS = {"silverbox": ("data.split.test=[test_multisine,test_arrow]",)}  # the experiment tests on the multisine alone
TANKS = (
    Figure("best linear approximation", 0.75, PIGA),
    Figure("Volterra", 0.54, PIGA),
    Figure("LSTM", 0.490, CHAMPNEYS),
    Figure("GP state space", 0.45, PIGA),
    Figure("polynomial NARX", 0.413, CHAMPNEYS),
    Figure("GRU", 0.396, CHAMPNEYS),
    Figure("NLSS2", 0.34, PIGA),
    Figure("neural state space", 0.33, PIGA),
    Figure("grey box with overflow", 0.18, "Rogers et al. 2017"),
)
BENCHMARKS = (
    Benchmark("cascaded_tanks", "all", published=TANKS),
    Benchmark("silverbox", "test_multisine",
              (Figure("GRU", 1.49, CHAMPNEYS), Figure("LSTM", 1.51, CHAMPNEYS))),
    Benchmark("silverbox", "test_arrow",
              (Figure("GRU", 2.80, CHAMPNEYS), Figure("LSTM", 2.38, CHAMPNEYS))),
    Benchmark("silverbox", "test_arrow, its first 32000 rows",
              (Figure("GRU", 0.95, CHAMPNEYS), Figure("LSTM", 1.08, CHAMPNEYS))),
    Benchmark("emps", "all"),
    Benchmark("tclab", "all"),
    Benchmark("ball_drops", "all"),
    Benchmark("free_pendulum", "all"),
)  # fmt: skip


def free_run(run: Path, output: str, span: tuple[float, float], model: str) -> float:
    """Return the root mean square of the error of a free run, in the unit of the data; inf where it ran away.

    Args:
        run: directory of a search.
        output: that was measured.
        span: times of the test that count, s.
        model: `before` or `after`.
    """
    table = pd.read_parquet(run / "trajectories.parquet")
    inside = (table["time"] >= span[0]) & (table["time"] <= span[1])
    table = table[(table["output"] == output) & table["free"] & inside & table["measured"].notna()]
    if table.empty:
        raise SystemExit(
            f"{run}: no test rows of {output} in {span[0]:g}..{span[1]:g} s; remove it, or choose another --out"
        )
    error = (table["measured"] - table[model]).to_numpy()
    return float(np.sqrt(np.mean(error**2))) if np.isfinite(error).all() else np.inf


def row(benchmark: Benchmark, run: Path, hand: np.ndarray, verdict: str, cost: str) -> list[str]:
    """Return the table's rows of a benchmark, one per output."""
    rig = RIGS[benchmark.experiment](Path(os.environ["SIMPEL_SHARED"]))
    whole = benchmark.part == "all"
    time = np.array([-np.inf, np.inf]) if whole else rig.test[benchmark.part].time
    lines = []
    for j, output in enumerate(rig.outputs):
        before, after = (
            rig.scale[0] * free_run(run, output, (time[0], time[-1]), model) for model in ("before", "after")
        )
        near = "yes" if after <= NEAR * hand[j] else "no"
        others = "; ".join(f"{f.method} {f.value:g}" for f in benchmark.published) or "-"
        part = "" if whole else f", {benchmark.part}"
        lines.append(
            f"| {benchmark.experiment}{part}, {output} | {rig.first} | {rig.scale[1]} | {before:.3g} | {after:.3g} "
            f"| {hand[j]:.3g} | {near} | {others} | {verdict} | {cost} |"
        )
    return lines


def main() -> None:
    """Search, fit by hand, and print the table."""
    names = list(dict.fromkeys(b.experiment for b in BENCHMARKS))
    parser = argparse.ArgumentParser(prog="tests.benchmarks.published", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=names, choices=names)
    options = parser.parse_args()
    if "SIMPEL_SHARED" not in os.environ:
        raise SystemExit("SIMPEL_SHARED is not set: the folder with the recordings (export SIMPEL_SHARED=FOLDER)")
    out = options.out.resolve()
    lines = [
        f"| recording | rows for the state | unit | calibrated | discover | by hand | within {NEAR} of it | published "
        "| verdict | cost |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in options.only:
        found = searched([f"experiment={name}", "close=false", *WORDS.get(name, ())], out / name)
        hand = specialist(name, Path(os.environ["SIMPEL_SHARED"]))
        cost = f"{found['seconds']:.0f} s, {found['cost']['memory_mib']:.0f} MiB"
        for benchmark in BENCHMARKS:
            if benchmark.experiment == name:
                lines += row(benchmark, out / name, hand[benchmark.part], found["verdict"], cost)
        (out / "table.md").write_text("\n".join(lines) + "\n")
    sources = sorted({f"{f.method}: {f.source}" for b in BENCHMARKS for f in b.published})
    print("\n".join([*lines, "", *(f"* {source}" for source in sources)]))


if __name__ == "__main__":
    main()
