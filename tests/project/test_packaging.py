"""What is shipped: the lock, the files in git, `make help`, the wheel and an installation of it in a fresh environment."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from command_line import ROOT, TINY, environment

HOSTS = {"pypi.org", "files.pythonhosted.org"}
MACHINE = re.compile(r"(?<![\w.$}/-])/(?:tmp|work|root|home)/[a-z]")


def git(*words: str) -> list[str]:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git checkout")
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()


def uv() -> str:
    found = shutil.which("uv") or next((str(p) for p in [ROOT / ".uv" / "bin" / "uv"] if p.exists()), None)
    if found is None:
        pytest.skip("uv is neither on PATH nor in .uv/bin (make install brings it along)")
    return found


def test_the_lock_names_the_public_index_only() -> None:
    hosts = set(re.findall(r"https?://([^/\"]+)", (ROOT / "uv.lock").read_text()))
    assert hosts == HOSTS


def test_the_lock_is_of_this_project() -> None:
    lock = tomllib.loads((ROOT / "uv.lock").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    own = next(p for p in lock["package"] if p["name"] == "simpel")
    assert own["version"] == project["version"]
    required = {re.split(r"[<>=\[ ]", d)[0] for d in project["dependencies"]}
    assert {d["name"] for d in own["dependencies"]} == required


@pytest.mark.parametrize("text", ["{}tmp/x", "see {}home/ann/runs", "'{}root/x'", "({}work/x)"])
def test_the_search_finds_paths(text: str) -> None:
    assert MACHINE.search(text.format("/"))
    assert not MACHINE.search(text.format("sub/"))


def test_no_path_of_a_developers_machine_in_git() -> None:
    found = []
    for name in git("ls-files"):
        path = ROOT / name
        if not path.is_file():
            continue
        try:
            text = path.read_text()
        except UnicodeDecodeError:
            text = path.read_bytes().decode("latin-1")  # Parquet and figures carry metadata
        found += [f"{name}:{i}: {line[:120]}" for i, line in enumerate(text.splitlines(), 1) if MACHINE.search(line)]
    assert not found, "\n".join(found)


def test_nothing_that_is_made_is_in_git() -> None:
    made = [n for n in git("ls-files") if re.search(r"^(runs|dist|build)/|(^|/)(__pycache__|\.venv|\.uv)/|\.pyc$", n)]
    assert made == []


def test_make_help_lists_every_target() -> None:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    rules = set(re.findall(r"^([a-z][a-z_-]*):(?!=)", (ROOT / "Makefile").read_text(), re.M))
    shown = subprocess.run(
        ["make", "-s", "--no-print-directory", "help"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    plain = re.sub(r"\x1b\[\d*m", "", shown)
    listed = {line.split()[0] for line in plain.splitlines() if line.strip()}
    assert listed == rules
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.M)
    assert phony is not None
    assert set(phony[1].split()) == rules


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy of the files in git and of those that are about to be."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in git("ls-files", "--cached", "--others", "--exclude-standard"):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    words = [uv(), "build", "--wheel", "--quiet", "--out-dir", str(folder), str(source)]
    built = subprocess.run(words, capture_output=True, text=True, check=False)
    if built.returncode and re.search(r"dns|network|connect|fetch", built.stderr, re.I):
        pytest.skip(f"no index to get hatchling from: {built.stderr.splitlines()[-1]}")
    assert built.returncode == 0, built.stderr
    return next(folder.glob("*.whl"))


def test_the_wheel_holds_what_a_run_needs(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    conf = {f"simpel_cli/conf/{p.relative_to(ROOT / 'conf')}" for p in (ROOT / "conf").rglob("*.yaml")}
    data = {f"simpel_cli/example_data/{n.removeprefix('data/')}" for n in git("ls-files", "data")}
    code = {n for n in git("ls-files", "simpel_cli", "simulators") if (ROOT / n).is_file()}
    assert conf <= names
    assert data
    assert data <= names
    assert code <= names
    assert "simulators/worlds/pendulum.xml" in names
    assert not [n for n in names if n.startswith(("tests/", "docs/"))]


@pytest.mark.slow
def test_an_installed_wheel_runs_from_an_empty_directory(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", symlinks=True, with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([uv(), "pip", "install", "--quiet", "--python", str(python), str(wheel)], check=True)
    empty = tmp_path / "empty"
    empty.mkdir()
    clean = {k: v for k, v in environment().items() if not k.startswith("PYTHON")}
    words = [str(tmp_path / "venv" / "bin" / "simpel"), "fit", "experiment=pendulum", *TINY[:-1]]
    result = subprocess.run(words, cwd=empty, env=clean, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert str(tmp_path / "venv") in result.stdout.splitlines()[1]  # the measurements came with the wheel
    assert list(empty.glob("runs/fit/pendulum/*/report.html"))
    assert os.listdir(empty) == ["runs"]
    assert sys.prefix not in result.stdout
