"""A run is gone on with only on the files that it began with: the same, none more, none fewer."""

from pathlib import Path

import pytest

from simpel_cli.errors import DataError
from simpel_cli.runs.manifest import sha256
from simpel_cli.studies.fit import refuse_changed_inputs


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, ...]:
    paths = tuple(tmp_path / f"run{i}.csv" for i in range(3))
    for path in paths:
        path.write_text(path.name)
    return paths


def digests(files: tuple[Path, ...]) -> dict[str, str]:
    return {str(file): sha256(file) for file in files}


def test_the_same_files(files: tuple[Path, ...], tmp_path: Path) -> None:
    refuse_changed_inputs(digests(files), files, {})
    refuse_changed_inputs({}, files, {})
    moved = tuple((tmp_path / file.stem).with_suffix(".moved") for file in files)
    for old, new in zip(files, moved, strict=True):
        new.write_text(old.read_text())
    refuse_changed_inputs(digests(files), moved, {})  # the folder of the data is another one
    (tmp_path / "card.yaml").write_text("columns: {}")
    refuse_changed_inputs(digests(files), (*files, tmp_path / "card.yaml"), {})


def test_a_file_that_has_changed(files: tuple[Path, ...]) -> None:
    before = digests(files)
    files[1].write_text("other")
    with pytest.raises(DataError, match=r"run1\.csv has changed since the run was started"):
        refuse_changed_inputs(before, files, {})


def test_a_file_more_and_a_file_fewer(files: tuple[Path, ...]) -> None:
    with pytest.raises(
        DataError, match=r"run2\.csv is new since the run was started\. Have the same files in data\.path"
    ):
        refuse_changed_inputs(digests(files[:2]), files, {})
    before = digests(files)
    files[2].unlink()
    with pytest.raises(DataError, match=r"run2\.csv is gone since the run was started"):
        refuse_changed_inputs(before, files[:2], {})


def test_a_table_that_is_gone(files: tuple[Path, ...], tmp_path: Path) -> None:
    """Its numbers are in the configuration of the run."""
    table = tmp_path / "spring.csv"
    table.write_text("s,F\n0,0\n1,1\n")
    before = digests((*files, table))
    origin = {"file": str(table), "sha256": sha256(table)}
    table.unlink()
    kept = {"axes": [[0.0, 1.0]], "values": [0.0, 1.0], "read_from": origin}
    refuse_changed_inputs(before, files, {"sim": {"tables": {"spring": kept}}})
    with pytest.raises(DataError, match=r"spring\.csv is gone"):
        refuse_changed_inputs(before, files, {"sim": {}})
