"""Wall time of one sweep, in five ways, each with an empty cache of compiled programs.

    python -m tests.benchmarks.sweep --out runs/bench-sweep [WORD ...]

* serial: `simpel fit`, one process after another, as a shell script would;
* local: `simpel sweep`, workers of this machine (`--workers`);
* cluster: the same on a Dask scheduler and workers that run already, of which one is killed with SIGKILL after a third of
  the jobs (nothing starts it again);
* killed: `simpel sweep` killed with SIGKILL, itself and its workers, after a third of the jobs, and `--resume`;
* again: `--resume` of what is complete.

The words are those of the sweep; left out: 48 fits of the pendulum. At the end a table: seconds, jobs, and in how many of
them a metric differs from the serial fit's.
"""

import argparse
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

WORDS = (
    "experiment=pendulum",
    "method=simpel,fsvgd",
    "data.n_train=10,20,40,80",
    "run.seed=0,1,2,3,4,5",
    "method.steps=1000",
    "run.figures=false",
)
SIMPEL = (sys.executable, "-m", "simpel_cli.main")
DASK = (sys.executable, "-m", "dask")


def main() -> None:
    """Run what was asked for, and say what it took."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.sweep", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=tuple(WAYS), default=tuple(WAYS))
    parser.add_argument("words", nargs="*", default=list(WORDS))
    asked = parser.parse_args()
    out = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    jobs = combinations(asked.words)
    lines = ["| way | seconds | jobs done | with another metric than serial |", "|---|---|---|---|"]
    for way in asked.only:
        if way != "again":
            os.environ["XDG_CACHE_HOME"] = str(out / f"cache-{way}")
        took = WAYS[way](out, asked.words, jobs, asked.workers)
        folder = out / ("killed" if way == "again" else way)
        done = [i for i in range(len(jobs)) if status(folder / str(i)) == "done"]
        other = [i for i in done if metrics(folder / str(i)) != metrics(out / "serial" / str(i))]
        lines.append(f"| {way} | {took:.0f} | {len(done)} of {len(jobs)} | {len(other)} |")
        print(lines[-1], flush=True)
    print("\n".join(lines))
    (out / "sweep.md").write_text("\n".join(lines) + "\n")


def combinations(words: Sequence[str]) -> list[list[str]]:
    """Return the words of every job, in Hydra's order."""
    parts = [[f"{key}={value}" for value in values.split(",")] for key, _, values in (w.partition("=") for w in words)]
    return [list(job) for job in itertools.product(*parts)]


def serial(out: Path, words: Sequence[str], jobs: Sequence[Sequence[str]], workers: int) -> float:
    """Run one process after another."""
    fresh(out / "serial")
    began = time.monotonic()
    for i, job in enumerate(jobs):
        run("fit", *job, f"hydra.run.dir={out / 'serial' / str(i)}")
    return time.monotonic() - began


def local(out: Path, words: Sequence[str], jobs: Sequence[Sequence[str]], workers: int) -> float:
    """Run the sweep with workers of this machine."""
    fresh(out / "local")
    began = time.monotonic()
    run("sweep", *words, f"hydra.sweep.dir={out / 'local'}", f"hydra.launcher.workers={workers}")
    return time.monotonic() - began


def cluster(out: Path, words: Sequence[str], jobs: Sequence[Sequence[str]], workers: int) -> float:
    """Run the sweep on a scheduler and workers of their own, and kill one of them."""
    folder = fresh(out / "cluster")
    file = out / "scheduler.json"
    file.unlink(missing_ok=True)
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    others = [
        subprocess.Popen(
            [*DASK, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)],
            **quiet,
        )
    ]
    work = [*DASK, "worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard", "--no-nanny"]
    others += [subprocess.Popen(work, **quiet) for _ in range(workers)]
    try:
        wait(file.exists)
        address = json.loads(file.read_text())["address"]
        began = time.monotonic()
        with start("sweep", *words, f"hydra.sweep.dir={folder}", f"hydra.launcher.address={address}") as child:
            wait(lambda: finished(folder) >= len(jobs) // 3)
            others[1].kill()
            ended(child)
        return time.monotonic() - began
    finally:
        for each in others:
            each.kill()
            each.wait()


def killed(out: Path, words: Sequence[str], jobs: Sequence[Sequence[str]], workers: int) -> float:
    """Kill the sweep and its workers, and go on."""
    folder = fresh(out / "killed")
    began = time.monotonic()
    with start(
        "sweep", *words, f"hydra.sweep.dir={folder}", f"hydra.launcher.workers={workers}", start_new_session=True
    ) as child:
        wait(lambda: finished(folder) >= len(jobs) // 3)
        os.killpg(child.pid, signal.SIGKILL)
        child.wait()
    print(f"killed with {finished(folder)} of {len(jobs)} done", flush=True)
    run("sweep", "--resume", str(folder))
    return time.monotonic() - began


def again(out: Path, words: Sequence[str], jobs: Sequence[Sequence[str]], workers: int) -> float:
    """Go on with what is complete."""
    began = time.monotonic()
    run("sweep", "--resume", str(out / "killed"))
    return time.monotonic() - began


WAYS: dict[str, Callable[[Path, Sequence[str], Sequence[Sequence[str]], int], float]] = {
    "serial": serial,
    "local": local,
    "cluster": cluster,
    "killed": killed,
    "again": again,
}


def start(*words: str, **options: Any) -> subprocess.Popen[bytes]:
    """Start `simpel`."""
    return subprocess.Popen(
        [*SIMPEL, *words, "run.quiet=true"] if "--resume" not in words else [*SIMPEL, *words], **options
    )


def run(*words: str) -> None:
    """Run `simpel`."""
    with start(*words, stdout=subprocess.DEVNULL) as child:
        ended(child)


def ended(child: subprocess.Popen[bytes]) -> None:
    """Wait for a process that has to end well."""
    if child.wait() != 0:
        sys.exit(f"{child.args!r}: exit code {child.returncode}")


def wait(until: Callable[[], bool]) -> None:
    """Wait for something."""
    while not until():
        time.sleep(0.1)


def fresh(folder: Path) -> Path:
    """Return a folder that is not there."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def status(run_dir: Path) -> str:
    """Return how a job ended."""
    path = run_dir / "manifest.json"
    return str(json.loads(path.read_text())["status"]) if path.exists() else ""


def finished(folder: Path) -> int:
    """Return how many jobs are done."""
    return sum(status(path) == "done" for path in folder.glob("[0-9]*"))


def metrics(run_dir: Path) -> list[tuple[object, ...]]:
    """Return what a fit was measured at, without the time it took."""
    rows = pq.read_table(run_dir / "metrics.parquet").to_pylist()
    return sorted((r["split"], r["metric"], r["output"] or "", r["step"] or 0, repr(r["value"])) for r in rows)


if __name__ == "__main__":
    main()
