"""One set from its draw to its row of the table of scores."""

import json
import resource
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from tests.exam import score
from tests.exam.draw import Set
from tests.exam.nuisances import named
from tests.exam.plants import SYSTEMS
from tests.exam.rivals import rivals
from tests.exam.tool import discover
from tests.exam.write import write

RUN, ORACLE = "run", "oracle"


def examine(drawn: Set, out: Path, tuned: Mapping[str, Sequence[Any]] | None = None) -> dict[str, Any]:
    """Write the files of a set, have it searched, and score the answer; what was done before is not done again."""
    folder, file = places(out, drawn.index)
    if not file.exists() or not (folder / "data" / "run.parquet").exists():
        write(drawn, folder, file)
    truth = json.loads(file.read_text())
    answer = discover(folder, RUN)
    row = {n: truth[n] for n in ("index", "system", "kind", "noise", "condition", "world")} | {
        "planted": "+".join(f"{e['name']}@{e['acts_on']}" for e in truth["effects"] + truth["absorbed"]),
        "strength": min((e["strength"] for e in truth["effects"]), default=0.0),
        "wall": answer.wall, "memory_mb": _memory(), "message": answer.error,
    }  # fmt: skip
    if not truth.get("nuisances"):  # the rivals take whole rows only
        row |= rivals(folder, truth, tuned or {})
    if answer.error:
        return row | {"outcome": score.ERROR}
    return row | _scored(truth, folder)


def places(out: Path, index: int) -> tuple[Path, Path]:
    """Return the folder of a set and the file of its truth."""
    return out / "sets" / str(index), out / "truth" / f"{index}.json"


def _memory() -> float:
    """Most memory that this process has had so far, MB: of all the sets that it has searched."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (2**20 if sys.platform == "darwin" else 2**10)


def _scored(truth: dict[str, Any], folder: Path) -> dict[str, Any]:
    found = json.loads((folder / RUN / "verdict.json").read_text())
    tried = pd.read_parquet(folder / RUN / "candidates.parquet")
    tried = tried[(tried.step == 1) & (tried.depends_on == "")]
    gains = {(e, p): float(g) for e, p, g in zip(tried.effect, tried.acts_on, tried.log_evidence_gain, strict=True)}
    graded = score.outcome(truth, found, gains)
    oracle = None
    if score.needs_oracle(truth, graded, gains):
        asked = discover(folder, ORACLE, score.names(truth))
        oracle = None if asked.error else json.loads((asked.directory / "verdict.json").read_text())
    inside, counted = score.covered(truth, graded, found)
    return {
        "outcome": graded, "verdict": found["verdict"], "names": "+".join(score.answered(found)),
        "remainder": bool(found["remainder"]),
        "evidence": score.evidence(truth, graded, found, gains, oracle),
        "of_oracle": score.error_ratio(found, oracle) if truth["effects"] and (oracle or graded == score.RIGHT) else None,
        "of_before": score.error_ratio(found, found, "before"), "covered": inside, "intervals": counted,
        "nuisances": "+".join(truth.get("nuisances", ())),
        "named": json.dumps(named(tuple(truth.get("nuisances", ())), SYSTEMS[truth["system"]], found)),
        "shows": json.dumps(truth.get("shows", {})),
        "grown": ",".join(found["error"].get("grows", ())),
        "seconds": found["seconds"], "candidates": found["candidates_tried"], "summary": found["summary"],
    }  # fmt: skip
