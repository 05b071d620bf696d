"""`simpel import` from end to end: what it prints and writes, that `simpel fit` composes and reads it, what is refused."""

from pathlib import Path

import pytest
import yaml
from command_line import csv, rig, simpel, swing

from simpel_cli.config.build import build, build_source
from simpel_cli.data import Measurements, read

HEAD = "run,t,s,v,u"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rig(tmp_path, measurements=csv(swing(), HEAD))
    return tmp_path


def test_what_it_writes_composes_and_reads(folder: Path) -> None:
    words = ("import", "my/run.csv", "sim=cart", "--config-dir", "my", "--out", "my/data/new.yaml")
    result = simpel(folder, *words)
    assert result.code == 0, result.err
    assert "episodes  6, named by run" in result.out
    assert "reads     4 train / 2 test episodes" in result.out
    assert "next      simpel fit --config-dir my sim=cart data=new" in result.out
    shown = simpel(folder, "fit", "--config-dir", "my", "sim=cart", "data=new", "--cfg", "job")
    assert shown.code == 0, shown.err
    config = yaml.safe_load(shown.out)
    assert config["data"] == {
        "path": "../run.csv", "time": "t", "episode": "run", "split": {"test_fraction": 0.25, "by": "episode"}
    }  # fmt: skip
    model = build_source(config["sim"], "sim")
    recording = read(build(config["data"], "data", default=Measurements), model, folder / "my" / "data", 0)
    assert (len(recording.train), len(recording.test)) == (4, 2)


def test_standard_output_is_the_yaml_and_nothing_else(folder: Path) -> None:
    result = simpel(folder / "my", "import", "run.csv")
    assert result.code == 0, result.err
    assert yaml.safe_load(result.out)["path"] == "run.csv"
    assert result.err == ""
    assert str(folder) not in result.out


def test_a_pattern_and_several_files(folder: Path) -> None:
    for run in range(6):
        (folder / f"drive{run}_m{run}.csv").write_text(csv([row[1:] for row in swing() if row[0] == run], "t,s,v,u"))
    words = ("drive*_m{mass}.csv", "--sim", "cart", "--config-dir", "my", "--out", "my/data/new.yaml")
    assert simpel(folder, "import", *words).code == 0
    assert yaml.safe_load((folder / "my/data/new.yaml").read_text())["path"] == "../../drive*_m{mass}.csv"
    shown = simpel(folder, "fit", "--config-dir", "my", "sim=cart", "data=new", "--cfg", "job")
    node = yaml.safe_load(shown.out)["data"]
    model = build_source(yaml.safe_load(shown.out)["sim"], "sim")
    assert len(read(build(node, "data", default=Measurements), model, folder / "my" / "data", 0).files) == 6
    result = simpel(folder, "import", "drive0_m0.csv", "drive1_m1.csv")
    assert yaml.safe_load(result.out)["path"] == ["drive0_m0.csv", "drive1_m1.csv"]


def test_an_existing_file_stays_unless_forced(folder: Path) -> None:
    before = (folder / "my/data/rig.yaml").read_text()
    words = ("import", "my/run.csv", "--out", "my/data/rig.yaml")
    result = simpel(folder, *words)
    assert result.code == 2
    assert "--out: my/data/rig.yaml is there already; nothing was changed." in result.err
    assert "--force" in result.err
    assert (folder / "my/data/rig.yaml").read_text() == before
    assert simpel(folder, *words, "--force").code == 0
    assert (folder / "my/data/rig.yaml").read_text() != before


def test_questions_are_shown(folder: Path) -> None:
    (folder / "other.csv").write_text(csv(swing()))
    result = simpel(folder, "import", "other.csv", "sim=cart", "--config-dir", "my", "--out", "new.yaml")
    assert result.code == 0, result.err
    assert "question  Which column is s [m]? Is it one of pos, vel?" in result.out
    assert "matched   u: volts   by its unit alone: check it" in result.out
    assert "reads     not yet: column 's' is missing in other.csv" in result.out


BAD = {
    "run.mat": (b"no MATLAB file" * 20, "run.mat is damaged, cut off or no MATLAB file"),
    "run.h5": (b"no HDF5 file" * 20, "run.h5 is damaged, cut off or no HDF5 file"),
    "run.mcap": (b"no MCAP file" * 20, "run.mcap is damaged, cut off or no MCAP file"),
    "run.db3": (b"no database" * 20, "run.db3 is damaged, cut off or no rosbag2"),
    "empty.csv": (b"", "empty.csv is empty (0 bytes)"),
    "words.csv": (b"name,place\na,b\nc,d\n", "words.csv: none of its columns holds numbers"),
    "twice.csv": (b"t,s,s\n0,1,2\n", "twice.csv has more than one column named s"),
    "units.csv": (b"t,s [m]\ns,mm\n0,1\n1,2\n", "units.csv: the header 's [m]' gives the unit m, the row below it mm"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_files_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    for library in ("h5py", "mcap", "mcap_ros2", "rosbags"):
        pytest.importorskip(library)
    content, message = BAD[name]
    (tmp_path / name).write_bytes(content)
    result = simpel(tmp_path, "import", name)
    assert (result.code, result.out) == (3, "")
    assert message in result.err
    assert "Traceback" not in result.err


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("nowhere.csv",), 3, "data.path: 'nowhere.csv' was not found"),
        (("no/*.csv",), 3, "no file matches 'no/*.csv'"),
        (("my/sim/cart.yaml",), 3, "cart.yaml ends in '.yaml', only .parquet, .csv, .mat"),
        (("my/run.csv", "sim=cartt", "--config-dir", "my"), 2, "there is no sim of that name. Did you mean cart?"),
        (("my/run.csv", "sim=cart", "--sim", "pendulum"), 2, "sim: got cart and pendulum"),
        (("sim=cart",), 2, "import: no file is named"),
        (("my/run.csv", "--out", "rig.txt"), 2, "--out: got rig.txt; a data YAML is named NAME.yaml"),
        ((), 2, "Missing argument"),
    ],
)  # fmt: skip
def test_what_is_refused(folder: Path, words: tuple[str, ...], code: int, message: str) -> None:
    result = simpel(folder, "import", *words)
    assert result.code == code
    assert message in result.err
    assert result.out == ""
