"""Sweeps with tiny settings: what fails, dies or is stopped costs itself only, and is gone on with."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import FIT, PATIENCE, TINY, environment, rows, simpel, start

from simpel_cli.config.compose import Job
from simpel_cli.errors import ConfigError
from simpel_cli.runs.directory import RESUMED
from simpel_cli.runs.lock import is_locked, locked
from simpel_cli.sweeps.job import _begun
from simpel_cli.sweeps.verbs import RESUMES
from simpel_cli.sweeps.workers import Options

# long enough to be killed amid it; the same job several times, so that each says what the others should have come to
LONG = ("experiment=pendulum", *TINY, "method.steps=3000", "run.quiet=false")
SAME = (*LONG, "run.name=a,b", "hydra.sweep.dir=sweep", "hydra.launcher.workers=1")


def values(run: Path) -> list[object]:
    return [(r["metric"], r["output"], r["step"], r["value"]) for r in rows(run)]


def statuses(sweep: Path, jobs: int, below: str = "") -> list[str]:
    return [json.loads((sweep / str(i) / below / "manifest.json").read_text())["status"] for i in range(jobs)]


def test_a_job_that_fails_costs_itself_only(tmp_path: Path) -> None:
    words = ("experiment=pendulum", *TINY, "method.learning_rate=0.001,-1", "run.seed=1", "hydra.launcher.workers=1")
    words = (*words, "hydra.sweep.subdir='${hydra.job.num}/fit'")  # directories may have one name
    first = simpel(tmp_path, "sweep", *words)  # into a directory of its own
    (folder,) = (tmp_path / "runs" / "sweep" / "pendulum").iterdir()
    folder.rename(tmp_path / "sweep")
    words = (*words, "hydra.sweep.dir=sweep")
    assert first.code == 2
    assert "1 of 2 jobs failed, the others are collected" in first.err
    assert "1/fit: method.learning_rate: got -1.0; it must be positive" in first.err
    table = pq.read_table(tmp_path / "sweep" / "sweep.parquet").to_pylist()
    assert {(row["run"], row["seed"], row["split"]) for row in table} == {("method.learning_rate=0.001", 1, "test")}
    assert statuses(tmp_path / "sweep", 2, "fit") == ["done", "failed"]
    assert (tmp_path / "sweep" / "0" / "fit" / "report.html").exists()
    assert not list((tmp_path / "sweep" / "0" / "fit").glob("*.png"))  # run.figures=false
    single = simpel(tmp_path, *FIT, "method.learning_rate=0.001", "run.seed=1", "hydra.run.dir=single")
    assert single.code == 0
    assert [r["value"] for r in table] == [r["value"] for r in rows(tmp_path / "single", split="test")]
    # a second sweep there is refused; going on runs what failed, with what it left set aside
    again = simpel(tmp_path, "sweep", *words)
    assert (again.code, "sweep holds a sweep already. Go on with `simpel sweep --resume sweep`" in again.err) == (
        2,
        True,
    )
    before = (tmp_path / "sweep" / "0" / "fit" / "manifest.json").read_bytes()
    resumed = simpel(tmp_path, "sweep", "--resume", "sweep", "run.quiet=false")
    assert resumed.code == 2
    assert "1 of 2 jobs failed" in resumed.err
    assert "done before" in resumed.out
    assert (tmp_path / "sweep" / "0" / "fit" / "manifest.json").read_bytes() == before
    assert (tmp_path / "sweep" / "1" / "fit.failed-1" / "config.yaml").exists()


def test_a_killed_worker_costs_one_retry_and_resume_goes_on_after_ctrl_c(tmp_path: Path) -> None:
    """`fit -m` is the same as `sweep`."""
    state = tmp_path / "sweep" / "1" / "checkpoint" / "state.safetensors"
    with start(tmp_path, "fit", "-m", *SAME, start_new_session=True) as child:
        wait_for(state, child)
        os.kill(workers_of(child.pid)[0], signal.SIGKILL)
        killed = state.stat().st_mtime_ns
        wait_for(state, child, newer=killed)  # the retry has gone on
        os.killpg(child.pid, signal.SIGINT)  # as a terminal does
        out, err = child.communicate(timeout=PATIENCE)
    assert child.returncode == 130
    assert "stopped: the sweep was stopped; finished jobs are kept. `simpel sweep --resume" in err
    assert "not done: 1" in out
    assert "Traceback" not in out + err
    assert statuses(tmp_path / "sweep", 2) == ["done", "interrupted"]
    assert {row["run"] for row in pq.read_table(tmp_path / "sweep" / "sweep.parquet").to_pylist()} == {"run.name=a"}
    result = simpel(tmp_path, "sweep", "--resume", "sweep")
    assert result.code == 0, result.err
    assert statuses(tmp_path / "sweep", 2) == ["done"] * 2
    assert values(tmp_path / "sweep" / "0") == values(tmp_path / "sweep" / "1")


def test_its_workers_end_with_it(tmp_path: Path) -> None:
    with start(tmp_path, "sweep", *SAME) as child:
        wait_for(tmp_path / "sweep" / "0" / "manifest.json", child)
        (worker,) = workers_of(child.pid)
        child.kill()
        child.communicate(timeout=PATIENCE)
    end = time.monotonic() + PATIENCE
    while is_running(worker):
        assert time.monotonic() < end, "the worker goes on"
        time.sleep(0.05)
    assert not (tmp_path / "sweep" / "1" / "manifest.json").exists()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and two workers, each a process of its own, as somebody else has started them."""
    dask = [sys.executable, "-m", "dask"]
    file = tmp_path / "scheduler.json"
    options = {"env": environment(), "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    own = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    processes = [subprocess.Popen([*dask, *own], **options)]
    work = ["worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard", "--no-nanny"]
    processes += [subprocess.Popen([*dask, *work], **options) for _ in range(2)]
    try:
        wait_for(file, processes[0])
        yield json.loads(file.read_text())["address"], processes[1:]
    finally:
        for each in processes:
            each.kill()
            each.wait()


@pytest.mark.slow  # the retry is tested on this machine's own workers
def test_a_cluster_that_runs_already_and_loses_a_worker(
    tmp_path: Path, cluster: tuple[str, list[subprocess.Popen[bytes]]]
) -> None:
    address, workers = cluster
    with start(tmp_path, "sweep", *SAME[:-1], f"hydra.launcher.address={address}") as child:
        for number in (0, 1):
            wait_for(tmp_path / "sweep" / str(number) / "checkpoint" / "state.safetensors", child)
        workers[0].kill()
        out, err = child.communicate(timeout=PATIENCE)
    assert child.returncode == 0, err
    assert f"at {address}" in out
    assert out.count("since its worker died") == 1
    assert statuses(tmp_path / "sweep", 2) == ["done"] * 2
    assert values(tmp_path / "sweep" / "0") == values(tmp_path / "sweep" / "1")
    assert workers[1].poll() is None  # it is not ours to end
    assert not list((tmp_path / "sweep").glob(".seen*"))


@pytest.mark.slow  # as test_another_launcher_that_fails_by_itself, with real jobs
def test_another_launcher_of_hydra_runs_the_same_jobs(tmp_path: Path) -> None:
    words = ["experiment=pendulum", *TINY, "run.quiet=false", "hydra.sweep.dir=sweep", "method.learning_rate=0.001,-1"]
    result = simpel(tmp_path, "sweep", *words, "hydra/launcher=basic")
    assert "not done: 1; `simpel sweep --resume" in result.out
    assert (result.code, "1 of 2 jobs are not done" in result.err) == (1, True)
    assert statuses(tmp_path / "sweep", 2) == ["done", "failed"]
    table = pq.read_table(tmp_path / "sweep" / "sweep.parquet").to_pylist()
    assert {row["run"] for row in table} == {"method.learning_rate=0.001"}
    # a job is silent, its run is not: it can be looked at later
    assert simpel(tmp_path, "fit", "--resume", "sweep/0").out.endswith("is complete; nothing to do.\n")
    assert "NLL" in simpel(tmp_path, "evaluate", "sweep/0").out
    # what was done with one configuration is not taken for the outcome of another
    record = json.loads((tmp_path / "sweep" / "sweep.json").read_text())
    record["words"] = [*words[:-1], "method.learning_rate=0.002,0.003"]
    (tmp_path / "sweep" / "sweep.json").write_text(json.dumps(record))
    changed = simpel(tmp_path, "sweep", "--resume", "sweep", "hydra.launcher.workers=1")
    assert "0: done before with another configuration (method.learning_rate: 0.001, now 0.002)" in changed.err
    assert statuses(tmp_path / "sweep", 2) == ["done", "done"]


def test_another_launcher_that_fails_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def launch(*_: object, **__: object) -> None:
        raise OSError("no such partition")

    monkeypatch.setattr("simpel_cli.sweeps.sweep.launch", launch)
    result = simpel(tmp_path, "sweep", "experiment=pendulum", *TINY, "run.seed=0,1", "hydra/launcher=basic")
    assert result.code == 1
    assert "error: hydra/launcher=basic: OSError: no such partition" in result.err


@pytest.mark.parametrize(("name", "extra"), [("submitit_slurm", "slurm"), ("slurm", "slurm"), ("ray", "ray")])
def test_a_launcher_that_is_an_extra(tmp_path: Path, name: str, extra: str) -> None:
    if any(metadata.distributions(name=f"hydra-{extra.replace('slurm', 'submitit')}-launcher")):
        pytest.skip(f"{extra} is installed")
    result = simpel(tmp_path, "sweep", "experiment=pendulum", "run.seed=0,1", f"hydra/launcher={name}")
    assert f"no option '{name}'" in result.err
    assert f"pip install 'simpel[{extra}]'" in result.err


def test_two_sweeps_in_one_directory(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    sweep.mkdir()
    with locked(sweep):
        assert is_locked(sweep)
        result = simpel(tmp_path, "sweep", "experiment=pendulum", *TINY, "run.seed=0,1", f"hydra.sweep.dir={sweep}")
        assert result.code == 2
        assert f"{sweep}: process {os.getpid()} on" in result.err
        assert "is at work there. Wait until it ends, or stop it; nothing was changed." in result.err
    assert not is_locked(sweep)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "",
            "hydra.sweep.dir: . holds other runs (fits/a), which the sweep would take for its own. Choose another directory",
        ),
        ("fits", "hydra.sweep.dir: fits holds other runs (fits/a)"),
        ("file", "hydra.sweep.dir: file is a file. Choose another directory"),
    ],
)
def test_a_directory_that_will_not_do(tmp_path: Path, given: str, message: str) -> None:
    (tmp_path / "fits" / "a").mkdir(parents=True)
    (tmp_path / "fits" / "a" / "metrics.parquet").touch()
    (tmp_path / "file").touch()
    result = simpel(tmp_path, "sweep", "experiment=pendulum", *TINY, "run.seed=0,1", f"hydra.sweep.dir='{given}'")
    assert (result.code, message in result.err) == (2, True), result.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "fits"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"workers": 0}, "hydra.launcher.workers: got 0; allowed are 1 to 1000, and null."),
        ({"address": "cluster"}, "hydra.launcher.address: got cluster; it looks like tcp://HOST:PORT."),
        ({"worker": 2}, "hydra.launcher.worker: no such key. Did you mean workers?"),
        ({"memory": "much"}, "hydra.launcher.memory: got much; it looks like 4GB, or is `auto`."),
        ({"dashboard": "yes"}, "hydra.launcher.dashboard: got yes; it is a port, or null."),
    ],
)
def test_wrong_options(given: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        Options.of(given)
    assert message in str(error.value)


def test_nobody_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simpel_cli.sweeps.workers.PATIENCE", 0.5)
    words = ("experiment=pendulum", *TINY, "run.seed=0,1", "hydra.sweep.dir=sweep")
    result = simpel(tmp_path, "sweep", *words, "hydra.launcher.address=tcp://127.0.0.1:9")
    assert result.code == 2
    assert "hydra.launcher.address: no scheduler answers at tcp://127.0.0.1:9 within" in result.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--resume", "nowhere"), "nowhere: not the directory of a sweep (it has no sweep.json)"),
        (("--resume", "."), "sweep.json: not readable"),
        (("--resume", ".", "method.steps=2"), "--resume: method.steps=2 is not of the launcher"),
    ],
)
def test_wrong_resumes(tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    good = '{"verb": "fit", "words": [], "config_dir": null, "jobs": 1}'
    (tmp_path / "sweep.json").write_text(good if len(words) > 2 else "{}")
    result = simpel(tmp_path, "sweep", *words)
    assert result.code == 2
    assert message in result.err


def is_running(pid: int) -> bool:
    """Return whether a process runs (one that ended and was not waited for does not)."""
    state = Path(f"/proc/{pid}/stat")
    try:
        return state.read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for(
    path: Path, child: subprocess.Popen[str] | subprocess.Popen[bytes], seconds: float = 120, newer: int = 0
) -> None:
    """Wait until a file is there that was changed after `newer`, ns since the epoch."""
    end = time.monotonic() + seconds
    while not path.exists() or path.stat().st_mtime_ns <= newer:
        assert child.poll() is None, child.communicate()
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.02)


def workers_of(parent: int) -> list[int]:
    """Return the processes of a sweep that work (not multiprocessing's resource tracker)."""
    children = Path(f"/proc/{parent}/task/{parent}/children")
    if not children.exists():
        pytest.skip("no /proc: cannot find the worker process")
    found = []
    for task in Path(f"/proc/{parent}/task").iterdir():  # a process is the child of the thread that started it
        pids = (task / "children").read_text().split()
        found += [int(pid) for pid in pids if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert found, "no worker process"
    return found


def test_messages_name_the_verbs_that_are_resumed() -> None:
    assert set(RESUMES) == set(RESUMED)


@pytest.mark.parametrize("status", ["running", "interrupted", "failed"])
def test_a_job_of_another_version_is_set_aside(tmp_path: Path, status: str) -> None:
    run = tmp_path / "0"
    run.mkdir()
    (run / "config.yaml").write_text("prior: {_target_: simpel_cli.prior.SimulatorPrior}\n")
    (run / "manifest.json").write_text(json.dumps({"command": "fit", "status": status}))  # its format is 1
    assert not _begun(Job({}, run, tmp_path))
    assert not (run / "manifest.json").exists()
    assert (tmp_path / "0.failed-1" / "config.yaml").exists()
