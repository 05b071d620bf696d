"""The README's walk-through, read from the README: its YAML, its CSV header and its commands, in an empty directory."""

import re
import shlex
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import ROOT, TINY, process
from scipy.integrate import solve_ivp

README = (ROOT / "README.md").read_text()
SMALL = tuple(w for w in TINY if not w.startswith("run.quiet"))


def blocks(language: str) -> list[str]:
    found = re.findall(r"^```(\w*)\n(.*?)^```", README, re.M | re.S)
    return [text for name, text in found if name == language]


def commands(verb: str) -> list[str]:
    """Commands of the walk-through, those with `--config-dir my` or on its run, without comments."""
    lines = [line.split("  #")[0].strip() for block in blocks("") for line in block.splitlines()]
    lines += [line for line in re.findall(r"`(simpel [^`]+)`", README) if "--config-dir my" in line]
    return [line for line in lines if re.match(rf"simpel {verb} (.*--config-dir my|RUN_DIR$)", line)]


def words(command: str, **replaced: str) -> list[str]:
    for old, new in replaced.items():
        command = command.replace(old, new)
    return shlex.split(command)[1:]


def measured(header: str) -> str:
    """Rows under the README's header: a cart on a spring (m 1.1 kg, k 23 N/m, c 2 N/V, friction 0.4 N s/m), noisy."""
    random = np.random.default_rng(1)
    lines = [header]
    for run in range(9):
        volts = random.uniform(-2, 2, 41)

        def rate(t: float, x: np.ndarray, volts: np.ndarray = volts) -> list[float]:
            return [x[1], (2.0 * volts[min(int(t / 0.05), 40)] - 23.0 * x[0] - 0.4 * x[1]) / 1.1]

        t = 0.05 * np.arange(41)
        x = solve_ivp(rate, (0, 2), random.uniform([-0.2, -0.5], [0.2, 0.5]), t_eval=t, max_step=0.01).y
        noisy = x + random.normal(size=x.shape) * [[0.0005], [0.005]]
        lines += [f"{run},{a:.2f},{b:.5f},{c:.5f},{d:.4f}" for a, b, c, d in zip(t, *noisy, volts, strict=True)]
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    for text in blocks("yaml"):
        named = re.match(r"# (my/\S+\.yaml)\n", text)
        assert named is not None, "the first line of a YAML block names its file"
        path = folder / named[1]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (table,) = blocks("csv")
    header = table.splitlines()[0]
    assert header == "run,t,pos,vel,volts"
    (folder / "my" / "run.csv").write_text(measured(header))
    return folder


def succeed(folder: Path, argv: list[str]) -> str:
    result = process(folder, *argv)
    assert result.code == 0, result.err
    assert result.err == ""
    return result.out


def metrics(run: Path) -> list[dict[str, object]]:
    return pq.read_table(run / "metrics.parquet").to_pylist()


@pytest.fixture(scope="module")
def fitted(folder: Path) -> tuple[Path, str]:
    (command,) = commands("fit")
    out = succeed(folder, [*words(command), *SMALL])
    report = re.search(r"^report\s+(.*report\.html)$", out, re.M)
    assert report is not None
    return Path(report[1]).parent, out


def test_fit_says_what_it_understood_and_what_comes_next(folder: Path, fitted: tuple[Path, str]) -> None:
    run, out = fitted
    assert run.is_relative_to(folder)
    assert "run.csv   7 train / 2 test episodes, 30 transitions used, dt 0.05 s" in out
    assert "cart   uncertain parameters: m k" in out
    assert re.search(r"^next +simpel evaluate ", out, re.M)
    found = metrics(run)
    assert {row["n_train"] for row in found} == {30}
    assert {row["output"] for row in found if row["metric"] == "rmse"} == {"s", "v", "joint"}
    units = {row["output"]: row["unit"] for row in found if row["metric"] == "rmse"}
    assert (units["s"], units["v"]) == ("m", "m/s")


def test_evaluate(folder: Path, fitted: tuple[Path, str]) -> None:
    (command,) = commands("evaluate")
    succeed(folder, [*words(command, RUN_DIR=str(fitted[0])), "hydra.run.dir=judged"])
    before, after = ([r["value"] for r in metrics(d) if r["split"] == "test"] for d in (fitted[0], folder / "judged"))
    assert after == before  # the same measurements, the same split


@pytest.mark.slow  # tests/sweeps/test_sweep.py tests sweeps
def test_sweep(folder: Path) -> None:
    (command,) = commands("sweep")
    argv = words(command, **{"range(3)": "range(1)"})
    small = [w for w in TINY if not w.startswith("prior.draws")]  # a GP prior has no draws
    succeed(folder, [*argv, *small, "hydra.sweep.dir=swept"])
    table = pq.read_table(folder / "swept" / "sweep.parquet").to_pylist()
    assert {(row["method"], row["n_train"]) for row in table} == {
        (m, n) for m in ("simpel", "fsvgd") for n in (10, 30)
    }  # fmt: skip
    assert list((folder / "swept").glob("*.png"))


def test_simulate(folder: Path) -> None:
    (command,) = commands("simulate")
    succeed(folder, words(command))
    table = pq.read_table(folder / "my" / "made" / "measurements.parquet")
    assert table.column_names == ["episode", "t", "s", "v", "u", "split"]
    assert (folder / "my" / "made" / "card.yaml").exists()


@pytest.mark.slow  # tests/data/test_data_smoother.py tests the estimate
def test_velocity_not_measured(folder: Path) -> None:
    """`v: null`, as the comment in the README's data YAML says."""
    path = folder / "my" / "data" / "rig.yaml"
    assert "v: null" in path.read_text()
    text = path.read_text().replace("v: vel", "v: null")
    (path.parent / "hidden.yaml").write_text(text)
    (command,) = commands("fit")
    out = succeed(folder, [*words(command, **{"data=rig": "data=hidden"}), *SMALL, "hydra.run.dir=hidden"])
    assert "not measured, estimated from the position: v" in out
    assert {r["output"] for r in metrics(folder / "hidden") if r["metric"] == "rmse"} == {"s", "v", "joint"}
