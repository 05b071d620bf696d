"""What `simpel discover` finds between the low- and the high-fidelity simulators of the paper's systems.

    python -m tests.benchmarks.differences --out runs/differences [--only pendulum racecar] [--seeds 3]

Data are trajectories of the high-fidelity simulator with parameters drawn from its prior, a draw per seed, with the noise of
SYSTEMS.md, which the search is told; it is given the low-fidelity simulator and every effect of the catalogue. What differs is
known.
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from simpel_cli.runs.files import write_table, write_text
from tests.benchmarks.cost import searched


class Difference(NamedTuple):
    """A pair of simulators, of low and of high fidelity.

    Args:
        search: words of `simpel discover`.
        differs: what the high fidelity has and the low has not.
        named: effects of the catalogue that say it, `effect on state`; empty: the catalogue has none.
        both: words that make both smaller.
    """

    search: tuple[str, ...]
    differs: str
    named: tuple[str, ...] = ()
    both: tuple[str, ...] = ()


CONF = Path(__file__).parent / "conf"  # conf/simulation/low_high_*.yaml
DIFFERENCES = {
    "pendulum": Difference(
        (), "viscous and quadratic drag of the bob", ("viscous_friction on omega", "quadratic_drag on omega")
    ),
    "racecar": Difference(
        ("discovery.rows=500", "discovery.horizon=15"), "slip of the tyres", ("tyre_slip on vx, vy, omega",)
    ),
    "greenhouse": Difference(
        ("discovery.rows=200", "discovery.beginnings=0"),
        "heating pipe (T_p with T_h and T_g), humidity (V with V_o; transpiration, condensation), latent heat (T_g)",
        ("input_exchange on T_p", "thermal_coupling on T_p", "input_exchange on V"),
    ),
    "sergio": Difference(
        ("discovery.rows=300", "discovery.horizon=10"),
        "regulation of genes by each other, quadratic Hill function",
        both=("sim.genes=3",),
    ),
}


def noise_of(name: str) -> str:
    """Return the noise of the sensors as Hydra reads it: whoever has a rig knows it."""
    declared = yaml.safe_load((CONF / "simulation" / f"low_high_{name}.yaml").read_text())["noise_std"]
    return "{" + ",".join(f"{key}:{value}" for key, value in declared.items()) + "}"


def simulated(name: str, seed: int, out: Path) -> Path:
    """Make the data of a pair and seed, once."""
    where = out / "data" / f"{name}_{seed}"
    path = where / "measurements.parquet"
    if not path.exists():
        pair = DIFFERENCES[name]
        sims = [f"sim={name}_high_fidelity", f"simulation=low_high_{name}", "--config-dir", str(CONF)]
        words = [*sims, *pair.both, f"simulation.seed={seed}", f"out={where}", "run.quiet=true"]
        command = [sys.executable, "-m", "simpel_cli.main", "simulate", *words, f"hydra.run.dir={where}/run"]
        subprocess.run(command, check=True)
    return path


def judged(pair: Difference, effects: list[str]) -> str:
    """Return whether exactly what differs was named."""
    if not pair.named:
        return "the catalogue has no name for it"
    there = [e for e in pair.named if e in effects]
    more = [e for e in effects if e not in pair.named]
    if len(there) == len(pair.named):
        return "yes" if not more else f"yes, and {len(more)} more"
    return f"{len(there)} of {len(pair.named)}, and {len(more)} others" if there else "no"


def remainder(found: dict[str, Any]) -> str:
    """Return what is left unexplained, if nothing was named."""
    left = found.get("remainder")
    return f"unnamed, in {left['acts_on']} of {', '.join(left['depends_on'])}" if left else "-"


def errors(found: dict[str, Any]) -> str:
    """Return the errors at the horizon of the three quantities that gained most."""
    before, after = (found["error"][key]["horizon"] for key in ("before", "after"))
    gained = sorted(before, key=lambda q: after[q] / max(before[q], 1e-300))[:3]
    return "; ".join(f"{q} {before[q]:.3g} -> {after[q]:.3g}" for q in gained)


def main() -> None:
    """Search and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.differences", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(DIFFERENCES), choices=DIFFERENCES)
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    rows = []
    for name in options.only:
        pair = DIFFERENCES[name]
        for seed in range(options.seeds):
            path = simulated(name, seed, options.out).resolve()
            found = searched(
                [f"sim={name}", "data=low_high", "--config-dir", str(CONF), f"data.path={path}", f"run.name={name}",
                 f"data.noise_std={noise_of(name)}", "close=false", *pair.search, *pair.both],
                options.out / f"{name}_{seed}",
            )  # fmt: skip
            effects = [f"{e['name']} on {e['acts_on']}" for e in found["effects"]]
            rows.append({
                "system": name, "seed": seed, "differs": pair.differs, "verdict": found["verdict"],
                "found": "; ".join(effects) or remainder(found), "right": judged(pair, effects), "error": errors(found),
                "seconds": found["seconds"], "memory_mib": found["cost"]["memory_mib"],
            })  # fmt: skip
            print(rows[-1], flush=True)
    write_table(options.out / "differences.parquet", {key: [row[key] for row in rows] for key in rows[0]})
    head = ("system, seed", "differs in", "verdict", "found", "named rightly", "error ahead, before -> after", "s")
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    lines += [
        f"| {r['system']}, {r['seed']} | {r['differs']} | {r['verdict']} | {r['found']} | {r['right']} | {r['error']} "
        f"| {r['seconds']:.0f} |"
        for r in rows
    ]
    text = "\n".join(lines) + "\n"
    write_text(options.out / "differences.md", text)
    print(text)


if __name__ == "__main__":
    main()
