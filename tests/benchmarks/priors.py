"""The corrected simulator against the old one as prior: `python -m tests.benchmarks.priors RUN ...`.

RUN is the directory of a `simpel discover` run. SimPEL is fitted with both simulators on 20 and on 50 transitions, five
seeds each, and tested on the test episodes, as the verb does unless `close=false`. A run that has this is not repeated.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import yaml

from simpel_cli.runs.console import Terminal
from simpel_cli.studies.close_loop import close
from simpel_cli.studies.declared import declare

KEPT = "as_prior.json"


def compared(run: Path) -> dict[str, Any]:
    """Return medians and extremes over seeds by simulator, transitions and metric (see `close`)."""
    kept = run / KEPT
    if not kept.exists():
        config, verdict = (yaml.safe_load((run / name).read_text()) for name in ("config.yaml", "verdict.json"))
        if not verdict["corrected_sim"]:
            raise SystemExit(f"{run}: verdict {verdict['verdict']}, no corrected simulator")
        (data,) = (run / "conf" / "data").glob("*.yaml")
        declared = declare(config | {"data": yaml.safe_load(data.read_text())}).without("effect", "discovery")
        corrected = declared.changed(sim=yaml.safe_load((run / verdict["corrected_sim"]).read_text()))
        kept.write_text(json.dumps(close(declared, corrected, run, run, Terminal(quiet=True))))
    found: dict[str, Any] = json.loads(kept.read_text())
    return found


def rows(name: str, found: dict[str, Any]) -> list[str]:
    """Return the table's rows: NLL, and errors of free runs at the longest horizon."""
    lines = []
    for size, old in found["before"].items():
        new = found["after"][size]
        runs = [metric for metric in old if metric.startswith("free_run_rmse@")]
        longest = max((_seconds(m) for m in runs), default=0.0)
        for metric in ("nll", *(m for m in runs if _seconds(m) == longest)):
            if metric not in new:
                continue
            cells = ["{:.3g} ({:.3g}..{:.3g})".format(*values[metric]) for values in (old, new)]
            worse = "overlap" if new[metric][1] <= old[metric][2] else "worse"
            word = "better" if new[metric][0] <= old[metric][0] else worse
            lines.append(
                f"| {name} | {size} | {metric.replace('free_run_rmse@', 'free run, ')} | {cells[0]} | {cells[1]} | {word} |"
            )
    return lines


def _seconds(metric: str) -> float:
    return float(metric.split("@")[1].split("s ")[0])


def main() -> None:
    """Fit and print the table."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.priors", description=__doc__)
    parser.add_argument("run", type=Path, nargs="+")
    print("| recording | transitions | error | declared | corrected | |\n|---|---|---|---|---|---|")
    for run in parser.parse_args().run:
        print("\n".join(rows(run.name, compared(run.resolve()))), flush=True)


if __name__ == "__main__":
    main()
