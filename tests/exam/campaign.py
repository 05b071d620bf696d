"""Many sets in few processes: programs are compiled once per kind of set, and what fails takes nothing else with it."""

import json
import multiprocessing
import os
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from tests.exam.draw import Set
from tests.exam.examine import examine
from tests.exam.plants import SYSTEMS

SETS_PER_PROCESS = 40  # then a fresh one: compiled programs take memory


def neighbours(drawn: Set) -> tuple[int, str, tuple[str, ...], int]:
    """Sets that share compiled programs are next to each other, small systems first."""
    return len(SYSTEMS[drawn.system].states), drawn.system, drawn.measured, drawn.index


def run(waiting: list[Set], out: Path, tuned: Mapping[str, Sequence[Any]], workers: int) -> None:
    """Examine sets in few processes, each on a core of its own; one that dies loses the sets that it was at, and no others."""
    everything = waiting
    while everything:  # fresh processes now and then; `max_tasks_per_child` can hang (CPython issue 115634)
        waiting, everything = everything[: SETS_PER_PROCESS * workers], everything[SETS_PER_PROCESS * workers :]
        _batch(waiting, out, tuned, workers)


def _batch(waiting: list[Set], out: Path, tuned: Mapping[str, Sequence[Any]], workers: int) -> None:
    while waiting:
        context = multiprocessing.get_context("spawn")
        begun = {d.index: out / "begun" / str(d.index) for d in waiting}
        for mark in begun.values():  # of an exam that was interrupted
            mark.unlink(missing_ok=True)
        cores: Any = context.Queue()
        for worker in range(workers):
            cores.put(worker)
        with ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(os.getpid(), cores)) as pool:
            futures = {pool.submit(one, d, out, tuned): d for d in waiting}
            for future in as_completed(futures):
                try:
                    told(future.result())
                except BrokenProcessPool:
                    break
                except Exception as error:
                    told(lost(futures[future], out, f"{type(error).__name__}: {error}"))
        left = [d for d in waiting if not score_file(out, d.index).exists()]
        died = [d for d in left if begun[d.index].exists()]
        for d in died:
            told(lost(d, out, "the process died"))
        if left and not died and len(left) == len(waiting):
            raise RuntimeError("no process could be started: see the messages above")
        waiting = [d for d in left if d not in died]


def _begin(parent: int, cores: Any) -> None:
    """Keep this process to one core, and end it soon after its parent: a worker of an exam that was killed would go on."""
    if hasattr(os, "sched_setaffinity"):
        mine = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {mine[cores.get() % len(mine)]})

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def one(drawn: Set, out: Path, tuned: Mapping[str, Sequence[Any]]) -> dict[str, Any]:
    """Examine one set and keep its score."""
    mark = out / "begun" / str(drawn.index)
    mark.parent.mkdir(exist_ok=True)
    mark.touch()
    row = examine(drawn, out, tuned)
    keep(out, row)
    mark.unlink()
    return row


def lost(drawn: Set, out: Path, message: str) -> dict[str, Any]:
    """Keep the row of a set whose process failed outside the tool's own errors."""
    row = {n: v for n, v in drawn._asdict().items() if n not in ("planted", "strength", "seed", "nuisances")} | {
        "planted": "+".join(drawn.planted), "nuisances": "+".join(drawn.nuisances),
        "outcome": "error", "message": message, "wall": None,
    }  # fmt: skip
    keep(out, row)
    return row


def keep(out: Path, row: dict[str, Any]) -> None:
    """Write the score of a set."""
    put(score_file(out, row["index"]), row)


def put(path: Path, content: Any) -> None:
    """Write JSON in one step, since others may read it meanwhile."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_suffix(f".{os.getpid()}")
    new.write_text(json.dumps(content))
    new.replace(path)


def score_file(out: Path, index: int) -> Path:
    """Where the score of a set is kept."""
    return out / "scores" / f"{index}.json"


def told(row: dict[str, Any]) -> None:
    """Print one line."""
    shown = ("index", "system", "condition", "noise", "planted", "outcome", "names", "evidence", "wall", "message")
    print(
        " · ".join(f"{row.get(n):.3g}" if isinstance(row.get(n), float) else str(row.get(n, "")) for n in shown),
        flush=True,
    )
