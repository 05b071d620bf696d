"""A run that is killed or interrupted goes on bit for bit: processes of their own, real signals."""

import hashlib
import json
import random
import shutil
import signal
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import PATIENCE, process, simpel, start

from simpel_cli.config.resolved import dump, load

FIT = (
    "fit", "experiment=pendulum", "method.steps=6000", "method.particles=6", "method.network.hidden=[32,32]",
    "method.pool=64", "method.sets=16", "prior.draws=64", "run.figures=false",
)  # fmt: skip


def state(run: Path) -> bytes:
    return (run / "checkpoint" / "state.safetensors").read_bytes()


def metrics(run: Path) -> list[dict[str, object]]:
    return [{k: v for k, v in r.items() if k != "run"} for r in pq.read_table(run / "metrics.parquet").to_pylist()]


def status(run: Path) -> str:
    return str(json.loads((run / "manifest.json").read_text())["status"])


def stop(folder: Path, run: Path, words: tuple[object, ...], number: int, delay: float) -> tuple[int, str]:
    """Start, wait for a new checkpoint and `delay` seconds more, send a signal; return exit code and stderr."""
    checkpoint = run / "checkpoint" / "state.safetensors"
    before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else None
    with start(folder, *words) as child:
        end = time.monotonic() + 120
        while not checkpoint.exists() or checkpoint.stat().st_mtime_ns == before:
            assert time.monotonic() < end
            if child.poll() is not None:
                break
            time.sleep(0.005)
        time.sleep(delay)
        child.send_signal(number)
        _, err = child.communicate(timeout=PATIENCE)
    return child.returncode, err


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("uninterrupted")
    result = process(folder, *FIT, "hydra.run.dir=run")
    assert result.code == 0, result.err
    return folder / "run"


@pytest.mark.parametrize("times", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_killed_at_random_moments(times: int, uninterrupted: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    moments = random.Random(0)
    words: tuple[object, ...] = (*FIT, "hydra.run.dir=run")
    killed = 0
    for _ in range(times):
        code, err = stop(tmp_path, run, words, signal.SIGKILL, moments.uniform(0, 0.4))
        assert "Traceback" not in err
        killed += code == -signal.SIGKILL
        words = ("fit", "--resume", "run")
        if code == 0:
            break
        assert status(run) == "running"
    assert killed > times / 2
    if status(run) != "done":
        result = process(tmp_path, *words)
        assert result.code == 0, result.err
    assert status(run) == "done"
    assert state(run) == state(uninterrupted)
    assert metrics(run) == metrics(uninterrupted)
    assert not list(run.rglob(".*.tmp"))
    assert not (run / "metrics.jsonl").exists()


def test_killed_before_the_first_checkpoint(uninterrupted: Path, tmp_path: Path) -> None:
    """What such a run has: a configuration and a manifest; it starts over."""
    run = tmp_path / "run"
    run.mkdir()
    for name in ("config.yaml", "manifest.json"):
        shutil.copy(uninterrupted / name, run / name)
    record = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(record | {"status": "running"}))
    result = simpel(tmp_path, "fit", "--resume", run)
    assert result.code == 0, result.err
    assert metrics(run) == metrics(uninterrupted)
    assert state(run) == state(uninterrupted)


@pytest.mark.parametrize(("before", "code", "after"), [("done", 0, "done"), ("interrupted", 2, "failed")])
def test_a_run_whose_plug_in_is_missing(
    uninterrupted: Path, tmp_path: Path, before: str, code: int, after: str
) -> None:
    """A complete run is complete in any case; what stops another one is noted in its manifest."""
    run = tmp_path / "run"
    shutil.copytree(uninterrupted, run)
    config = load(run / "config.yaml")
    config["run"]["plugins"], config["method"]["_target_"] = ["gone"], "gone.Method"
    (run / "config.yaml").write_text(dump(config))
    record = json.loads((run / "manifest.json").read_text())
    digest = hashlib.sha256((run / "config.yaml").read_bytes()).hexdigest()
    (run / "manifest.json").write_text(json.dumps(record | {"status": before, "config_sha256": digest}))
    result = simpel(tmp_path, "fit", "--resume", run)
    assert result.code == code, result.err
    assert status(run) == after
    if code:
        assert "cannot import gone" in json.loads((run / "manifest.json").read_text())["error"]


def test_interrupted_while_the_report_is_written(uninterrupted: Path, tmp_path: Path) -> None:
    """All steps are done and the metric table is written: nothing of it is lost."""
    run = tmp_path / "run"
    shutil.copytree(uninterrupted, run)
    record = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(record | {"status": "interrupted"}))
    (run / "report.html").unlink()
    result = simpel(tmp_path, "fit", "--resume", run)
    assert result.code == 0, result.err
    assert metrics(run) == metrics(uninterrupted)
    assert state(run) == state(uninterrupted)
    assert (run / "report.html").exists()
    assert json.loads((run / "manifest.json").read_text())["wall_seconds"] > record["wall_seconds"]  # of both


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_interrupted(number: signal.Signals, uninterrupted: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    code, err = stop(tmp_path, run, (*FIT, "hydra.run.dir=run"), number, 0.0)
    assert code == 130
    assert err.startswith("stopped: stopped at step ") or "the state is saved" in err
    assert "Traceback" not in err
    assert status(run) == "interrupted"
    result = simpel(tmp_path, "fit", "--resume", "run")
    assert result.code == 0, result.err
    assert state(run) == state(uninterrupted)
    assert metrics(run) == metrics(uninterrupted)


def test_a_finished_run_is_left_alone(uninterrupted: Path) -> None:
    def contents() -> dict[str, tuple[bytes, int]]:
        return {str(p): (p.read_bytes(), p.stat().st_mtime_ns) for p in uninterrupted.rglob("*") if p.is_file()}

    before = contents()
    result = process(uninterrupted.parent, "fit", "--resume", uninterrupted)
    assert result.code == 0
    assert contents() == before
    assert "run is complete; nothing to do." in result.out
