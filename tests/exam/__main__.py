"""The blind exam: `python -m tests.exam --sets 600 --seed 1 --out /somewhere`.

Every set is written, given to `simpel discover` as a user would, and scored against a truth that the tool cannot reach.
`--out` of an earlier exam goes on with it; `--known FILE` begins with the scores of one, which it left as `scores.parquet`;
`--only` leaves the other systems to other runs on the same `--out`, now or later; `--score-only` scores anew what was run
there. The table is of all sets in that folder. `--second` is the second exam, whose measurements have the nuisances of real
rigs. Exams that are not complete are kept in `data/exam/`.
"""

import argparse
import json
import os
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from tests.exam import rivals, score
from tests.exam.campaign import keep, neighbours, put, run, score_file
from tests.exam.draw import OUTSIDE, draw, draw_second
from tests.exam.examine import examine, places
from tests.exam.plants import SYSTEMS
from tests.exam.table import report
from tests.exam.write import write

PLAN = "exam.json"
MOST_WORKERS = os.cpu_count() or 2
TUNING, TUNING_SEED = 450, 1_000_003  # sets on which the rival's threshold is tuned; no set of the exam is among them
STRONG = 0.25  # exponent of strengths: of two decades it leaves the upper half one


def main() -> None:
    """Run the exam."""
    parser = argparse.ArgumentParser(prog="tests.exam", description=__doc__)
    parser.add_argument("--sets", type=int, default=600)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--only", nargs="+", choices=SYSTEMS, default=list(SYSTEMS), metavar="SYSTEM", help=str([*SYSTEMS])
    )
    parser.add_argument("--second", action="store_true", help="with nuisances of real rigs")
    parser.add_argument(
        "--workers",
        type=int,
        default=2,
        choices=range(1, MOST_WORKERS + 1),
        metavar="N",
        help="processes, each on a core",
    )
    parser.add_argument("--known", type=Path, metavar="FILE", help="scores.parquet of the same exam, begun elsewhere")
    parser.add_argument("--score-only", type=Path, metavar="DIR", help="score the runs of an earlier exam anew")
    options = parser.parse_args()
    if (options.out is None) == (options.score_only is None):
        parser.error("give either --out DIR or --score-only DIR")
    if options.known and options.score_only:
        parser.error("--known goes with --out DIR")
    out = (options.out or options.score_only).resolve()
    earlier = plan(out)
    if options.score_only:
        if "seed" not in earlier:
            parser.error(f"{out} holds no exam")
        told = earlier | {"tuned": earlier.get("tuned") or tuned()}
        put(out / PLAN, told)
        for path in sorted((out / "scores").glob("*.json")):
            again(path, out, told)
        finish(out)
        return
    if earlier.get("seed", options.seed) != options.seed:
        parser.error(f"{out} holds the exam with seed {earlier['seed']}")
    if "seed" in earlier and earlier.get("second", False) != options.second:
        parser.error(f"{out} holds the {'second' if earlier.get('second') else 'first'} exam")
    told = {
        "seed": options.seed, "sets": options.sets, "second": options.second,
        "tuned": {} if options.second else earlier.get("tuned") or tuned(),
    }  # fmt: skip
    if options.known:
        begin_with(options.known, out, told)
    put(out / PLAN, told)
    drawn_by = draw_second if options.second else draw
    sets = [d for d in (drawn_by(i, options.seed) for i in range(options.sets)) if d.system in options.only]
    waiting = [d for d in sets if not score_file(out, d.index).exists()]
    run(sorted(waiting, key=neighbours), out, told["tuned"], options.workers)
    finish(out)


def plan(out: Path) -> dict[str, Any]:
    """Return what an earlier run has told of the exam in a folder."""
    return json.loads((out / PLAN).read_text()) if (out / PLAN).exists() else {}


def begin_with(known: Path, out: Path, told: Mapping[str, Any]) -> None:
    """Put the scores of sets that were examined elsewhere where their exam goes on.

    Raises:
        SystemExit: they are of another exam.
    """
    rows = pd.read_parquet(known).to_dict("records")
    drawn_by = draw_second if told["second"] else draw
    for row in rows:
        drawn = drawn_by(int(row["index"]), told["seed"])
        if (drawn.system, drawn.kind, drawn.noise, drawn.condition) != tuple(
            row[name] for name in ("system", "kind", "noise", "condition")
        ):
            raise SystemExit(f"--known {known}: set {row['index']} is none of the exam with seed {told['seed']}")
    for row in rows:
        if not score_file(out, int(row["index"])).exists():
            keep(out, {name: value for name, value in row.items() if not pd.isna(value)})


def again(path: Path, out: Path, told: Mapping[str, Any]) -> None:
    """Score anew; what was not run stays as it was."""
    old = json.loads(path.read_text())
    drawn = (draw_second if told.get("second") else draw)(old["index"], told["seed"])
    if (places(out, drawn.index)[0] / "run" / "verdict.json").exists():
        keep(out, examine(drawn, out, told["tuned"]) | {"wall": old["wall"], "memory_mb": old.get("memory_mb")})


def tuned() -> dict[str, tuple[float, str]]:
    """Return, per rig and noise, the options with which PySINDy is right most often on sets that are not of the exam.

    What is planted there is strong: among the exam's own strengths a threshold that never names anything is often the best.
    """
    if not rivals.installed():
        return {}
    right: dict[str, Counter[tuple[float, str]]] = {}
    with tempfile.TemporaryDirectory() as name:
        for index in range(TUNING):
            drawn = draw(index, TUNING_SEED)
            drawn = drawn._replace(strength=tuple(s**STRONG for s in drawn.strength))
            if drawn.kind == OUTSIDE:  # no threshold helps: a rival that claims anything is wrong
                continue
            folder, file = places(Path(name), index)
            write(drawn, folder, file)
            truth = json.loads(file.read_text())
            made = rivals.problem(folder, drawn.system, truth["measured"])
            count = right.setdefault(rivals.alike(drawn.system, drawn.noise), Counter())
            for option in rivals.OPTIONS if made else ():
                count[option] += rivals.graded(truth, rivals.sparse(made, *option)) == score.RIGHT
    return {key: max(rivals.OPTIONS, key=lambda o: count[o]) for key, count in right.items()}


def finish(out: Path) -> None:
    """Write and print the table of all sets that have a score."""
    rows = [json.loads(path.read_text()) for path in (out / "scores").glob("*.json")]
    if not rows:
        return
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
