"""MATLAB and HDF5 files: vectors and fields of structs as columns, units, and what is no column, with its cure."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_matrix
from systems import CART

from simpel_cli.data import Measurements, Recording, read
from simpel_cli.data.tables.formats import optional
from simpel_cli.data.tables.formats.mat_cures import cure
from simpel_cli.data.tables.read_file import read_sheet
from simpel_cli.errors import DataError

T = 0.1 * np.arange(40)
COLUMNS = {"t": T, "s": np.sin(T), "v": np.cos(T), "u": np.sign(np.sin(3 * T))}
EPISODE = np.repeat([0, 1, 2, 3], 10)


def read_file(folder: Path, name: str, **keys: Any) -> Recording:
    return read(Measurements(name, **({"time": "t", "episode": "run"} | keys)), CART, folder, 0)


def states(recording: Recording) -> np.ndarray:
    return np.concatenate([e.states for e in sorted((*recording.train, *recording.test), key=lambda e: e.time[0])])


def said(recording: Recording, name: str) -> str:
    return "".join(check.detail for check in recording.checks if check.name == name)


WANTED = np.stack([COLUMNS["s"], COLUMNS["v"]], axis=1)


def save_73(path: Path, content: dict[str, Any]) -> None:
    """Write what MATLAB's save -v7.3 would: arrays transposed, their class as an attribute, a header of 512 bytes."""
    h5py = pytest.importorskip("h5py")

    def put(group: Any, name: str, value: Any) -> None:
        if isinstance(value, dict):
            inner = group.create_group(name)
            inner.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, item in value.items():
                put(inner, key, item)
        elif isinstance(value, str):
            group[name] = np.array([[ord(c)] for c in value], np.uint16)
            group[name].attrs["MATLAB_class"] = np.bytes_("char")
        elif isinstance(value, tuple):  # class, and what MATLAB keeps of it
            group[name] = np.zeros((1, 6), np.uint32)
            group[name].attrs["MATLAB_class"] = np.bytes_(value[0])
            group[name].attrs["MATLAB_object_decode"] = 3
        elif isinstance(value, list):
            refs = group.file.require_group("#refs#")
            for item in value:
                refs[f"{name}{len(refs)}"] = np.asarray(item, float)
            group.create_dataset(name, data=[[refs[k].ref] for k in refs], dtype=h5py.ref_dtype)
            group[name].attrs["MATLAB_class"] = np.bytes_("cell")
        else:
            group[name] = np.atleast_2d(np.asarray(value).T)
            group[name].attrs["MATLAB_class"] = np.bytes_("logical" if np.asarray(value).dtype == bool else "double")

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in content.items():
            put(file, name, value)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))


def save(path: Path, content: dict[str, Any], version: str) -> None:
    if version == "7.3":
        save_73(path, content)
    else:
        savemat(path, content, format="4" if version == "4" else "5", do_compression=version == "7", oned_as="column")


@pytest.mark.parametrize("version", ["4", "5", "7", "7.3"])
def test_vectors_are_columns(tmp_path: Path, version: str) -> None:
    save(tmp_path / "run.mat", COLUMNS | {"run": EPISODE.astype(float), "dt": 0.1}, version)
    recording = read_file(tmp_path, "run.mat")
    np.testing.assert_array_equal(states(recording), WANTED)
    assert said(recording, "files") == "run.mat: left out, no columns: dt"
    with pytest.raises(DataError, match=r"'dt' of run\.mat is a single number \(0\.1\), not a column"):
        read_file(tmp_path, "run.mat", columns={"u": "dt"})


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_fields_of_structs_are_columns(tmp_path: Path, version: str) -> None:
    log = {"time": T, "run": EPISODE.astype(float), "pos": {"x": COLUMNS["s"]}, "note": "first try", "X": WANTED}
    save(tmp_path / "run.mat", {"log": log, "u": COLUMNS["u"] > 0, "names": "abc"}, version)
    keys = {"time": "log.time", "episode": "log.run", "columns": {"s": "log.pos.x", "v": "log.X_2"}}
    recording = read_file(tmp_path, "run.mat", **keys)
    np.testing.assert_array_equal(states(recording), WANTED)
    assert set(np.unique(recording.train[0].inputs)) <= {0.0, 1.0}
    with pytest.raises(DataError, match=r"column 'log.pos.y' is missing.*Did you mean log.pos.x"):
        read_file(tmp_path, "run.mat", **keys | {"columns": {"s": "log.pos.y"}})


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_a_cell_is_named_with_its_cure(tmp_path: Path, version: str) -> None:
    cell: Any = [[1.0], [2.0, 3.0]]
    if version == "5":
        cell = np.empty((2, 1), object)
        cell[0, 0], cell[1, 0] = 1.0, np.arange(3.0)
    save(tmp_path / "run.mat", COLUMNS | {"run": EPISODE * 1.0, "c": cell}, version)
    message = r"'c' of run\.mat is a cell, which is not read\. In MATLAB: c = cell2mat\(c\); save\('run\.mat', 'c', '-append'\)"
    np.testing.assert_array_equal(
        states(read_file(tmp_path, "run.mat")), WANTED
    )  # it does no harm if nobody asks for it
    with pytest.raises(DataError, match=message) as error:
        read_file(tmp_path, "run.mat", columns={"u": "c"})
    assert error.value.exit_code == 3
    save(tmp_path / "run.mat", {"c": cell}, version)
    with pytest.raises(DataError, match=r"run\.mat has no vector of numbers\. " + message):
        read_file(tmp_path, "run.mat")


def test_other_variables_that_are_no_columns(tmp_path: Path) -> None:
    odd = {
        "many": np.array([(1.0, 2.0), (3.0, 4.0)], dtype=[("a", object), ("b", object)]),
        "thin": csc_matrix(np.eye(40)),
        "wave": T + 1j,
        "cube": np.zeros((2, 3, 4)),
        "half": T[:20],
        "wide": np.zeros((3, 40)),
        "nothing": np.zeros((0, 0)),
    }
    savemat(tmp_path / "run.mat", COLUMNS | {"run": EPISODE * 1.0} | odd)
    sheet = read_sheet(tmp_path / "run.mat")
    assert set(sheet.columns) == {*COLUMNS, "run"}
    assert set(sheet.unusable) == set(odd)
    for name, fragment in [
        ("many", "is a struct array (1 x 2), which is not read. In MATLAB: many = table2struct(struct2table(many), 'ToScalar'"),
        ("thin", "thin = full(thin)"), ("wave", "is complex"), ("cube", "an array of 2 x 3 x 4"),
        ("half", "20 entries long, but the columns have 40 rows"), ("wide", "an array of 3 x 40, not a column of 40 rows"),
        ("nothing", "is empty"),
    ]:  # fmt: skip
        assert fragment in sheet.unusable[name]
    assert sheet.notes[0].startswith("left out, no columns: ")
    assert sheet.notes[0].endswith(", and 4 more")
    with pytest.raises(DataError, match=r"'many' of run\.mat is a struct array"):
        read_file(tmp_path, "run.mat", columns={"u": "many.a"})


def test_objects_of_matlab(tmp_path: Path) -> None:
    save_73(tmp_path / "run.mat", {"log": {"ts": ("timeseries",)}, "tab": ("table",), "odd": ("my.Class",)})
    with pytest.raises(DataError) as error:
        read_sheet(tmp_path / "run.mat")
    assert "'log.ts' of run.mat is a MATLAB object (timeseries)" in str(error.value)
    assert "log_ts = struct('t', log.ts.Time, 'x', log.ts.Data); save('run.mat', 'log_ts', '-append')" in str(
        error.value
    )
    assert "tab = table2struct(tab, 'ToScalar', true)" in str(error.value)
    assert "odd = struct('t', <times>, 'x', <numbers of odd>)" in str(error.value)
    assert "timetable2table(log.tt)" in cure("log.tt", "a MATLAB object (timetable)", "run.mat")


def test_one_matrix(tmp_path: Path) -> None:
    savemat(tmp_path / "run.mat", {"data": np.stack([EPISODE, T, *WANTED.T, COLUMNS["u"]], axis=1)})
    keys = {"time": "data_2", "episode": "data_1", "columns": {"s": "data_3", "v": "data_4", "u": "data_5"}}
    np.testing.assert_array_equal(states(read_file(tmp_path, "run.mat", **keys)), WANTED)


def test_damaged_mat_files(tmp_path: Path) -> None:
    whole = tmp_path / "whole.mat"
    savemat(whole, COLUMNS, do_compression=True)
    content = whole.read_bytes()
    (tmp_path / "empty.mat").write_bytes(b"")
    with pytest.raises(DataError, match=r"empty\.mat is empty \(0 bytes\)"):
        read_sheet(tmp_path / "empty.mat")
    flipped = content[:300] + b"\xff" * 40 + content[340:]
    newest = b"MATLAB 7.3 MAT-file".ljust(700)
    for name, damaged in [
        ("cut", content[:700]),
        ("text", b"no matlab" * 99),
        ("flipped", flipped),
        ("newest", newest),
    ]:
        (tmp_path / f"{name}.mat").write_bytes(damaged)
        with pytest.raises(DataError, match=rf"{name}\.mat is damaged, cut off or no MATLAB file"):
            read_sheet(tmp_path / f"{name}.mat")


def test_a_mat_file_with_any_byte_changed_ends_no_process(tmp_path: Path) -> None:
    """scipy trusts the types in the file and reads outside its memory; `mat_elements` looks at them before."""
    cell = np.array([1.0, "a"], dtype=object)
    savemat(tmp_path / "whole.mat", {"t": T[:5], "u": np.array(["ab"]), "b": T[:5] > 2, "s": {"x": T[:5], "c": cell}})
    content = (tmp_path / "whole.mat").read_bytes()
    path = tmp_path / "run.mat"
    refused = 0
    for i in range(124, len(content), 4):
        for value in (0, 5, 14, 255):
            path.write_bytes(content[:i] + bytes([value]) + content[i + 1 :])
            try:
                read_sheet(path)
            except DataError as error:
                refused += "damaged" in str(error)
    assert refused > 50


def hdf5(path: Path, content: dict[str, Any], units: dict[str, Any] | None = None) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, value in content.items():
            file[name] = value
        for name, attributes in (units or {}).items():
            file[name].attrs.update(attributes)


@pytest.mark.parametrize("name", ["run.h5", "run.HDF5"])
def test_datasets_are_columns(tmp_path: Path, name: str) -> None:
    text = np.array([f"run {i}" for i in EPISODE], dtype=object)
    units = {"s": {"unit": "m"}, "v": {"units": np.bytes_(b"m/s")}, "t": {"unit": "s", "units": "seconds"}}
    hdf5(tmp_path / name, COLUMNS | {"run": text, "image": np.zeros((200, 300))}, units)
    recording = read_file(tmp_path, name)
    np.testing.assert_array_equal(states(recording), WANTED)
    assert {e.name for e in (*recording.train, *recording.test)} == {f"run {i}" for i in range(4)}
    assert said(recording, "units").startswith("2 of 3 columns declare a unit")
    assert said(recording, "files") == f"{name}: left out, no columns: image"


def test_datasets_of_one_group_and_of_several(tmp_path: Path) -> None:
    hdf5(tmp_path / "one.h5", {f"log/raw/{name}": value for name, value in (COLUMNS | {"run": EPISODE}).items()})
    np.testing.assert_array_equal(states(read_file(tmp_path, "one.h5")), WANTED)
    groups = {"t": "clock", "run": "clock", "s": "car", "v": "car", "u": "motor"}
    content = {f"{groups[name]}/{name}": value for name, value in (COLUMNS | {"run": EPISODE}).items()}
    hdf5(tmp_path / "several.h5", content | {"car/gains": np.arange(5.0), "top": T})
    keys = {"time": "clock/t", "episode": "clock/run", "columns": {"s": "car/s", "v": "car/v", "u": "motor/u"}}
    np.testing.assert_array_equal(states(read_file(tmp_path, "several.h5", **keys)), WANTED)
    with pytest.raises(DataError, match=r"'car/gains' of several\.h5 is 5 entries long, but the columns have 40 rows"):
        read_file(tmp_path, "several.h5", **keys | {"columns": {"s": "car/gains"}})


def test_records_of_a_table(tmp_path: Path) -> None:
    table = np.zeros(40, dtype=[("t", "f8"), ("s", ">f4"), ("v", "f8"), ("u", "i2"), ("run", "S3")])
    for name, values in COLUMNS.items():
        table[name] = values
    table["run"] = [f"r{i}" for i in EPISODE]
    hdf5(tmp_path / "run.h5", {"log": table})
    keys = {"time": "log.t", "episode": "log.run", "columns": {"s": "log.s", "v": "log.v", "u": "log.u"}}
    np.testing.assert_allclose(states(read_file(tmp_path, "run.h5", **keys)), WANTED, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "units", "message"),
    [
        ({"a": T, "b": T[:20]}, {}, r"vectors of different lengths: 'a' has 40, 'b' has 20.*one file per recording"),
        ({"a": np.array(["x", "y"], dtype=object)}, {}, r"run\.h5 has no vector of numbers"),
        (
            {"a": np.zeros((3, 3, 3))},
            {},
            r"no vector of numbers\. 'a' of run\.h5 is an array of 3 x 3 x 3, not a column",
        ),
        ({}, {}, r"run\.h5 has no vector of numbers"),
        (
            {"s": T},
            {"s": {"unit": "m", "units": "mm"}},
            r"dataset 's' of run\.h5 has two units: unit is m, units is mm",
        ),
    ],
)
def test_hdf5_files_that_are_refused(tmp_path: Path, content: Any, units: Any, message: str) -> None:
    hdf5(tmp_path / "run.h5", content, units)
    with pytest.raises(DataError, match=message) as error:
        read_sheet(tmp_path / "run.h5")
    assert error.value.exit_code == 3


def test_damaged_hdf5(tmp_path: Path) -> None:
    hdf5(tmp_path / "whole.h5", {name: np.tile(v, 50) for name, v in COLUMNS.items()})
    content = (tmp_path / "whole.h5").read_bytes()
    for name, damaged in [("cut", content[:3000]), ("text", b"no hdf5" * 99), ("flipped", b"\x00" * 8 + content[8:])]:
        (tmp_path / f"{name}.h5").write_bytes(damaged)
        with pytest.raises(DataError, match=rf"{name}\.h5 is damaged, cut off or no HDF5 file"):
            read_sheet(tmp_path / f"{name}.h5")


def test_units_of_datasets_enter_the_check(tmp_path: Path) -> None:
    hdf5(tmp_path / "run.h5", COLUMNS | {"run": EPISODE}, {"s": {"units": "mm"}})
    with pytest.raises(DataError, match=r"unit of column 's' in run\.h5 is mm, but the simulator has 's' in m"):
        read_file(tmp_path, "run.h5")


def test_a_library_that_is_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(optional.importlib, "import_module", absent)
    for name, content in (("run.h5", b"x"), ("run.mat", b"MATLAB 7.3 MAT-file".ljust(600))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}: to read it, `h5py` is needed.*pip install 'simpel\[hdf5\]'"):
            read_sheet(tmp_path / name)
