"""`simpel example`: the folder that a user begins with does what its README says."""

import json
import re
import shlex
from pathlib import Path

import pytest
from command_line import TINY, simpel

from simpel_cli.reporting.example import SOURCE
from simpel_cli.runs.metrics import read_metrics


@pytest.fixture
def my(tmp_path: Path) -> Path:
    result = simpel(tmp_path, "example", "my")
    assert (result.code, result.err) == (0, "")
    return tmp_path / "my"


def test_it_is_whole_and_nothing_is_overwritten(my: Path) -> None:
    files = {p.relative_to(SOURCE) for p in SOURCE.rglob("*") if p.is_file()}
    assert {p.relative_to(my) for p in my.rglob("*") if p.is_file()} == files
    (my / "sim" / "cart.yaml").write_text("mine")
    again = simpel(my.parent, "example", "my")
    assert (again.code, "my: exists and is not empty" in again.err) == (2, True)
    assert (my / "sim" / "cart.yaml").read_text() == "mine"


def test_what_comes_next_can_be_pasted(tmp_path: Path) -> None:
    result = simpel(tmp_path, "example", "my rig")
    next_ = [line.split("simpel ")[1].partition("#")[0] for line in result.out.splitlines() if "simpel " in line]
    assert len(next_) == 3
    assert all(shlex.split(words)[2 if "sims" in words else 1 :][:2] == ["--config-dir", "my rig"] for words in next_)


def test_every_command_of_its_readme_composes(my: Path) -> None:
    commands = re.findall(r"^    simpel (\S+ .*?)(?:  +#.*)?$", (my / "README.md").read_text(), re.MULTILINE)
    assert len(commands) == 7
    for command in commands:
        words = shlex.split(command)
        result = simpel(my, *words, *(() if words[0] == "sims" else ("--cfg", "job")))
        assert (result.code, result.err) == (0, ""), command


def test_fit_with_a_method_of_its_own(my: Path) -> None:
    small = [word for word in TINY if not word.startswith("method.particles")]
    result = simpel(my, "fit", "--config-dir", ".", "experiment=cart", "method=quick", *small, "hydra.run.dir=run")
    assert result.code == 0, result.err
    config = (my / "run" / "config.yaml").read_text()
    assert "particles: 10" in config  # of quick
    assert "warn" not in result.out + result.err


def test_launcher_of_its_own(my: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simpel_cli.sweeps.workers.PATIENCE", 0.5)
    words = ("sweep", "--config-dir", ".", "experiment=cart", "run.seed=0,1", "hydra/launcher=cluster")
    result = simpel(my, *words, "hydra.launcher.address=tcp://127.0.0.1:9")
    assert (result.code, "no scheduler answers at tcp://127.0.0.1:9" in result.err) == (2, True)
    assert "address: tcp://127.0.0.1:8786" in (my / "hydra" / "launcher" / "cluster.yaml").read_text()


@pytest.mark.slow
def test_the_friction_is_found(my: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simpel_cli.studies.close_loop.SIZES", (20, 10**6))  # there are not as many
    small = [word for word in TINY if word.startswith("method.")]
    result = simpel(my, "discover", "--config-dir", ".", "experiment=cart", *small, "hydra.run.dir=found")
    assert result.code == 0, result.err
    verdict = json.loads((my / "found" / "verdict.json").read_text())
    assert (verdict["verdict"], [effect["name"] for effect in verdict["effects"]]) == ("effect", ["coulomb_friction"])
    # of sim/cart_true.yaml: 1 N on 1.2 kg
    assert verdict["effects"][0]["parameters"]["tau_c"]["value"] == pytest.approx(1 / 1.2, rel=0.02)
    assert verdict["parameters"]["m"]["after"]["value"] == pytest.approx(1.2, rel=0.01)
    assert ("20 transitions, 5 seeds: NLL" in result.out, "1000000 transitions" in result.out) == (True, False)
    assert {row["n_train"] for row in read_metrics(my / "found" / "metrics.parquet")} == {20}
    # and what is printed to go on with does, though the measurements are those of another folder
    command = next(line for line in result.out.splitlines() if line.startswith("next ")).partition("simpel ")[2]
    fitted = simpel(my, *shlex.split(command), *TINY, "hydra.run.dir=with_it")
    assert fitted.code == 0, fitted.err
