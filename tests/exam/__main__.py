"""The blind exam: `python -m tests.exam --sets 600 --seed 1 --out /somewhere`.

Every set is written, given to `simpel discover` as a user would, and scored against a truth that the tool cannot reach.
`--out` of an earlier exam goes on with it; `--score-only` scores anew what was run there.
"""

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pandas as pd

from tests.exam import rivals, tool
from tests.exam.campaign import keep, neighbours, run, score_file
from tests.exam.draw import draw
from tests.exam.examine import examine, places
from tests.exam.table import report
from tests.exam.write import write

MOST_WORKERS = 2
TUNING, TUNING_SEED = 40, 1_000_003  # sets on which the rival's threshold is tuned; no set of the exam is among them


def main() -> None:
    """Run the exam."""
    parser = argparse.ArgumentParser(prog="tests.exam", description=__doc__)
    parser.add_argument("--sets", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--workers", type=int, default=2, choices=range(1, MOST_WORKERS + 1))
    parser.add_argument("--score-only", type=Path, metavar="DIR", help="score the runs of an earlier exam anew")
    options = parser.parse_args()
    if (options.out is None) == (options.score_only is None):
        parser.error("give either --out DIR or --score-only DIR")
    out = (options.out or options.score_only).resolve()
    if options.score_only:
        finish(out, [again(path, out) for path in sorted((out / "scores").glob("*.json"))])
        return
    out.mkdir(parents=True, exist_ok=True)
    told = {"seed": options.seed}
    plan = out / "exam.json"
    if plan.exists() and json.loads(plan.read_text())["seed"] != options.seed:
        parser.error(f"{out} holds the exam with seed {json.loads(plan.read_text())['seed']}")
    plan.write_text(json.dumps(told | {"sets": options.sets, "thresholds": tuned(out)}))
    thresholds = json.loads(plan.read_text())["thresholds"]
    sets = [draw(i, options.seed) for i in range(options.sets)]
    waiting = sorted((d for d in sets if not score_file(out, d.index).exists()), key=neighbours)
    run(waiting, out, thresholds, options.workers)
    finish(out, [json.loads(score_file(out, i).read_text()) for i in range(options.sets)])


def again(path: Path, out: Path) -> dict[str, Any]:
    """Score anew; what was not run stays as it was."""
    old = json.loads(path.read_text())
    drawn = draw(old["index"], json.loads((out / "exam.json").read_text())["seed"])
    if not (places(out, drawn.index)[0] / "run" / "verdict.json").exists():
        return old
    row = examine(drawn, out, json.loads((out / "exam.json").read_text())["thresholds"]) | {"wall": old["wall"]}
    keep(out, row)
    return row


def tuned(out: Path) -> dict[str, float]:
    """Return the threshold with which PySINDy is right most often on sets that are not of the exam."""
    if not rivals.installed():
        return {}
    if (out / "exam.json").exists():
        return json.loads((out / "exam.json").read_text()).get("thresholds") or {}
    right: Counter[float] = Counter()
    for index in range(TUNING):
        drawn = draw(index, TUNING_SEED)
        folder, file = places(out / "tuning", index)
        write(drawn, folder, file)
        truth = json.loads(file.read_text())
        made = rivals.problem(folder, drawn.system, truth["measured"])
        for threshold in rivals.THRESHOLDS if made else ():
            right[threshold] += rivals.graded(truth, rivals.sparse(made, threshold)) == "right"
    tool.clear(out / "tuning")
    return {rivals.SINDY: max(rivals.THRESHOLDS, key=lambda t: right[t])}


def finish(out: Path, rows: list[dict[str, Any]]) -> None:
    """Write and print the table."""
    scores = pd.DataFrame(rows).sort_values("index")
    for name in ("evidence", "names", "message"):
        if name not in scores:
            scores[name] = None
    scores.to_parquet(out / "scores.parquet")
    text = report(scores)
    (out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
