"""Running `simpel` from tests: in this process (fast) or as a process of its own, in a directory of the test's."""

import contextlib
import io
import logging
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import yaml

ROOT = Path(__file__).parents[1]
KEPT = (
    ROOT / ".pytest_cache" if os.access(ROOT, os.W_OK) else Path(tempfile.gettempdir()) / f"simpel-tests-{os.getuid()}"
)
CACHE = KEPT / "cache"  # compiled programs are shared by all tests and their processes
PATIENCE = 1800.0  # s for a process that hangs; a loaded machine is no failure
TINY = (
    "method.steps=100", "method.particles=4", "method.network.hidden=[16,16]", "method.pool=64", "method.sets=16",
    "prior.draws=64",
    "run.figures=false", "run.quiet=true",
)  # fmt: skip
FIT = ("fit", "experiment=pendulum", *TINY)

CART = """\
_target_: simulators.model.Declared
name: cart
dt: 0.05
states:
  s: {unit: m,   range: [-0.5, 0.5]}
  v: {unit: m/s, range: [-2, 2]}
inputs:
  u: {unit: V, range: [-3, 3]}
parameters:
  m: {unit: kg,  range: [0.5, 2.0]}
  k: {unit: N/m, range: [5, 50]}
  c: 2.0
dynamics:
  s: v
  v: (c*u - k*s)/m
"""
LINE = """\
_target_: simulators.model.Declared
name: line
dt: 1.0
inputs: {x: {unit: "", range: [0, 4]}}
parameters: {a: {range: [0.5, 3.5]}}
outputs: {y: a*x}
"""
RIG = """\
path: ../run.csv
time: t
episode: run
columns: {s: pos, v: vel, u: volts}
split: {test_fraction: 0.25, by: episode}
"""


class Result(NamedTuple):
    code: int
    out: str
    err: str


def environment() -> dict[str, str]:
    return os.environ | {"XDG_CACHE_HOME": str(CACHE), "PYTHONWARNINGS": "default"}


def simpel(cwd: Path, *words: object) -> Result:
    """Run the command in this process, as the console script would."""
    from simpel_cli.main import main

    out, err = io.StringIO(), io.StringIO()
    before = sys.argv, Path.cwd(), os.environ.get("XDG_CACHE_HOME")
    sys.argv = ["simpel", *map(str, words)]
    os.environ["XDG_CACHE_HOME"] = str(CACHE)
    os.chdir(cwd)
    code = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main()
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    finally:
        sys.argv = before[0]
        os.chdir(before[1])
        if before[2] is None:
            del os.environ["XDG_CACHE_HOME"]
        else:
            os.environ["XDG_CACHE_HOME"] = before[2]
        log = logging.getLogger("simpel")
        for handler in list(log.handlers):
            handler.close()
            log.removeHandler(handler)
    return Result(code, out.getvalue(), err.getvalue())


def start(cwd: Path, *words: object, **options: object) -> subprocess.Popen[str]:
    """Start the command as a process of its own."""
    argv = [sys.executable, "-m", "simpel_cli.main", *map(str, words)]
    return subprocess.Popen(
        argv, cwd=cwd, env=environment(), text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options
    )


def process(cwd: Path, *words: object, timeout: float = PATIENCE) -> Result:
    """Run the command as a process of its own."""
    with start(cwd, *words) as child:
        out, err = child.communicate(timeout=timeout)
    return Result(child.returncode, out, err)


def swing(episodes: int = 6, rows: int = 30, dt: float = 0.05, substeps: int = 10) -> list[list[float]]:
    """Rows (run, t, pos, vel, volts) of a damped cart on a spring, by so many Euler steps per row."""
    random = np.random.default_rng(0)
    table = []
    for run in range(episodes):
        s, v = random.uniform(-0.3, 0.3), 0.0
        for i in range(rows):
            u = float(np.sin(0.3 * i + run))
            table.append([run, round(i * dt, 4), s + 1e-4 * random.normal(), v + 1e-3 * random.normal(), u])
            for _ in range(substeps):
                v += (2 * u - 20 * s - 0.5 * v) / 1.2 * dt / substeps
                s += v * dt / substeps
    return table


def csv(table: list[list[object]], head: str = "run,t,pos,vel,volts") -> str:
    return head + "\n" + "".join(",".join(map(str, row)) + "\n" for row in table)


def rig(folder: Path, *, cart: str = CART, data: str = RIG, measurements: str | bytes | None = None) -> Path:
    """Write the folder `my` of a user: a simulator, a data YAML and measurements."""
    my = folder / "my"
    (my / "sim").mkdir(parents=True)
    (my / "data").mkdir()
    (my / "sim" / "cart.yaml").write_text(cart)
    (my / "data" / "rig.yaml").write_text(data)
    content = csv(swing()) if measurements is None else measurements
    if isinstance(content, str):
        content = content.encode()
    if content != b"absent":
        (my / "run.csv").write_bytes(content)
    return my


def line(folder: Path, x: np.ndarray, y: np.ndarray, train: int, declared: dict[str, dict[str, object]]) -> None:
    """Write the folder `my` of a user with the simulator `line`, of whose rows the first train it, and data YAMLs by name."""
    for part in ("sim", "data"):
        (folder / "my" / part).mkdir(parents=True)
    (folder / "my" / "sim" / "line.yaml").write_text(LINE)
    split = np.where(np.arange(len(x)) < train, "train", "test")
    pd.DataFrame({"x": x, "y": y, "split": split}).to_csv(folder / "my" / "line.csv", index=False)
    for name, said in declared.items():
        data = {"path": "../line.csv", "split": {"column": "split"}} | said
        (folder / "my" / "data" / f"{name}.yaml").write_text(yaml.safe_dump(data))


def rows(path: Path, *leave_out: str, split: str | None = None) -> list[dict[str, object]]:
    """Metric rows, without the columns that name the run."""
    table = pq.read_table(path / "metrics.parquet").to_pylist()
    kept = [row for row in table if split is None or row["split"] == split]
    return [{k: v for k, v in row.items() if k not in ("run", *leave_out)} for row in kept]
