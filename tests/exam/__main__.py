"""The blind exam: `python -m tests.exam --sets 600 --seed 1 --out /somewhere` (first version: the pendulum, one effect).

Every set is written, given to `simpel discover` as a user would, and scored against a truth that the tool cannot reach.
"""

import argparse
import json
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
from scipy.stats import beta

from tests.exam.generate import draw, write


def examine(index: int, seed: int, out: Path) -> dict:
    drawn, folder = draw(index, seed), out / "sets" / f"{index}"
    truth = out / "truth" / f"{index}.json"
    write(drawn, folder, truth)
    words = ["--config-dir", folder, "sim=pendulum", "data=exam", "close=false", f"hydra.run.dir={folder / 'run'}"]
    argv = [sys.executable, "-m", "simpel_cli.main", "discover", *map(str, words), "run.quiet=true"]
    ended = subprocess.run(argv, capture_output=True, text=True, check=False)
    row = drawn._asdict() | {"index": index, "code": ended.returncode}
    if ended.returncode:
        return row | {"outcome": "error", "message": ended.stderr.strip()[-300:]}
    found = json.loads((folder / "run" / "verdict.json").read_text())
    names = [name for effect in found["effects"] for name in effect["class"]]
    tried = pd.read_parquet(folder / "run" / "candidates.parquet")
    own = tried[(tried.effect == drawn.effect) & (tried.step == 1)].log_evidence_gain
    return row | {
        "outcome": _outcome(drawn.effect, found, names), "verdict": found["verdict"], "names": names,
        "evidence": float(own.max()) if len(own) else 0.0, "seconds": found["seconds"],
    }  # fmt: skip


def _outcome(planted: str, found: dict, names: list[str]) -> str:
    if not names:
        return "nothing" if planted or found["verdict"] == "unexplained" else "right"
    if not planted:
        return "false effect"
    if names == [planted]:
        return "right"
    return "tie" if planted in names else "wrong"


def interval(k: int, n: int) -> str:
    """Clopper and Pearson (1934), 95 %."""
    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{k}/{n} = {k / max(n, 1):.0%} ({low:.0%}..{high:.0%})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    rows = []
    with ThreadPoolExecutor(options.workers) as pool:
        for row in pool.map(lambda i: examine(i, options.seed, options.out), range(options.sets)):
            rows.append(row)
            print({k: row.get(k) for k in ("index", "effect", "strength", "noise", "measured", "outcome", "names", "evidence", "seconds")}, flush=True)  # fmt: skip  # noqa: E501
    table = pd.DataFrame(rows)
    table.to_parquet(options.out / "scores.parquet")
    planted = table[table.effect != ""]
    clear = planted[planted.evidence >= 10]
    count = Counter(clear.outcome)
    print("named exactly or in a tie, evidence >= 10:", interval(count["right"] + count["tie"], len(clear)))
    print("named exactly, evidence >= 10:", interval(count["right"], len(clear)))
    print("wrong name, all:", interval(int((planted.outcome == "wrong").sum()), len(planted)))
    none = table[table.effect == ""]
    print("false effect where there is none:", interval(int((none.outcome == "false effect").sum()), len(none)))
    print(
        "errors:", int((table.outcome == "error").sum()), "median seconds:", table.get("seconds", pd.Series()).median()
    )


if __name__ == "__main__":
    main()
