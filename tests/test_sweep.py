"""Sweeps with tiny settings: what fails, dies or is stopped costs itself only."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import FIT, PATIENCE, TINY, process, rows, simpel, start


class TestSweep:
    def test_a_job_that_fails_costs_itself_only(self, tmp_path: Path) -> None:
        words = ("experiment=pendulum", *TINY, "method.learning_rate=0.001,-1", "run.seed=1", "hydra.sweep.dir=sweep")
        result = process(tmp_path, "sweep", *words)
        assert result.code == 2
        assert "1 of 2 jobs failed, the others are collected" in result.err
        assert "method.learning_rate: got -1.0; it must be positive" in result.err
        table = pq.read_table(tmp_path / "sweep" / "sweep.parquet").to_pylist()
        assert {(row["run"], row["seed"], row["split"]) for row in table} == {("method.learning_rate=0.001", 1, "test")}
        status = [json.loads((tmp_path / "sweep" / str(i) / "manifest.json").read_text())["status"] for i in range(2)]
        assert status == ["done", "failed"]
        assert (tmp_path / "sweep" / "0" / "report.html").exists()
        assert not list((tmp_path / "sweep" / "0").glob("*.png"))  # run.figures=false
        single = simpel(tmp_path, *FIT, "method.learning_rate=0.001", "run.seed=1", "hydra.run.dir=single")
        assert single.code == 0
        assert [r["value"] for r in table] == [r["value"] for r in rows(tmp_path / "single", split="test")]

    def test_a_worker_that_is_killed_costs_one_job(self, tmp_path: Path) -> None:
        """`fit -m` is the same as `sweep`."""
        words = ("experiment=pendulum", *TINY, "run.seed=0,1,2", "hydra.sweep.dir=sweep")
        with start(tmp_path, "fit", "-m", *words) as child:
            wait_for(tmp_path / "sweep" / "1" / "manifest.json", child)
            os.kill(worker_of(child.pid), signal.SIGKILL)
            _, err = child.communicate(timeout=PATIENCE)
        assert child.returncode == 1
        assert "1 of 3 jobs failed" in err
        assert "1: the worker process died (out of memory, or killed)" in err
        table = pq.read_table(tmp_path / "sweep" / "sweep.parquet").to_pylist()
        assert {row["seed"] for row in table} == {0, 2}

    def test_ctrl_c_stops_it_and_keeps_what_is_done(self, tmp_path: Path) -> None:
        words = ("experiment=pendulum", *TINY, "run.seed=range(9)", "hydra.sweep.dir=sweep")
        with start(tmp_path, "sweep", *words, start_new_session=True) as child:
            wait_for(tmp_path / "sweep" / "1" / "manifest.json", child)
            os.killpg(child.pid, signal.SIGINT)  # as a terminal does
            _, err = child.communicate(timeout=PATIENCE)
        assert child.returncode == 130
        assert "stopped: the sweep was stopped; finished jobs are kept." in err
        assert "Traceback" not in err
        assert not (tmp_path / "sweep" / "3").exists()
        assert 0 in {row["seed"] for row in pq.read_table(tmp_path / "sweep" / "sweep.parquet").to_pylist()}

    def test_its_worker_ends_with_it(self, tmp_path: Path) -> None:
        words = ("experiment=pendulum", *TINY, "run.seed=range(9)", "hydra.sweep.dir=sweep")
        with start(tmp_path, "sweep", *words) as child:
            wait_for(tmp_path / "sweep" / "1" / "manifest.json", child)
            worker = worker_of(child.pid)
            child.kill()
            child.communicate(timeout=PATIENCE)
        end = time.monotonic() + PATIENCE
        while is_running(worker):
            assert time.monotonic() < end, "the worker goes on"
            time.sleep(0.05)
        assert not (tmp_path / "sweep" / "3").exists()


def is_running(pid: int) -> bool:
    """Return whether a process runs (one that ended and was not waited for does not)."""
    state = Path(f"/proc/{pid}/stat")
    try:
        return state.read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for(path: Path, child: subprocess.Popen[str], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert child.poll() is None, child.communicate()[1]
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.02)


def worker_of(parent: int) -> int:
    """Return the process of a sweep that works (not multiprocessing's resource tracker)."""
    children = Path(f"/proc/{parent}/task/{parent}/children")
    if not children.exists():
        pytest.skip("no /proc: cannot find the worker process")
    for pid in children.read_text().split():
        if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
            return int(pid)
    raise AssertionError("no worker process")
