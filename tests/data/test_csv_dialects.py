"""CSV files as people have them: decimal commas, units in the header or below it, and what is in doubt."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simpel_cli.data import Measurements, Recording, read
from simpel_cli.data.tables.formats.csv_header import header_of
from simpel_cli.data.unit_words import is_unit
from simpel_cli.errors import DataError
from simulators.model import Declared

SPRING = Declared(
    name="spring",
    dt=0.1,
    states={"s": {"unit": "m", "range": [-10, 10]}, "v": {"unit": "m/s", "range": [-50, 50]}},
    inputs={"u": {"unit": "V", "range": [-2, 2]}},
    dynamics={"s": "v", "v": "u - s"},
    outputs={"force": {"unit": "N", "expression": "-s"}},
).model()


def rows(head: str = "run,t,s,v,u", *below: str) -> str:
    lines = [head, *below]
    for run in range(4):
        lines += [f"{run},{0.1 * i:.1f},{np.sin(i + run):.6f},{np.cos(i + run):.6f},{i % 2}" for i in range(8)]
    return "\n".join(lines) + "\n"


def read_text(folder: Path, text: str, **keys: Any) -> Recording:
    (folder / "run.csv").write_text(text, encoding="utf-8")
    return read(Measurements("run.csv", **({"time": "t", "episode": "run"} | keys)), SPRING, folder, 0)


def said(recording: Recording, name: str) -> str:
    return "".join(check.detail for check in recording.checks if check.name == name)


def same(a: Recording, b: Recording) -> None:
    assert [e.name for e in (*a.train, *a.test)] == [e.name for e in (*b.train, *b.test)]
    for one, other in zip((*a.train, *a.test), (*b.train, *b.test), strict=True):
        np.testing.assert_array_equal(one.time, other.time)
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.inputs, other.inputs)


COMMAS = {
    "semicolons": lambda text: text.replace(",", ";").replace(".", ","),
    "tabs": lambda text: text.replace(",", "\t").replace(".", ","),
    "blanks": lambda text: text.replace(",", "  ").replace(".", ","),
    "names in a remark": lambda text: "# " + text.replace(",", ";").replace(".", ","),
    "blanks, names in a remark": lambda text: "# " + text.replace(",", " ").replace(".", ","),
}  # fmt: skip


@pytest.mark.parametrize("way", COMMAS)
def test_decimal_commas(tmp_path: Path, way: str) -> None:
    plain = read_text(tmp_path, rows())
    assert said(plain, "files") == ""  # a file without peculiarities is not spoken of
    found = read_text(tmp_path, COMMAS[way](rows()))
    same(found, plain)
    assert said(found, "files") == "run.csv: decimal commas"


def test_a_text_with_a_comma_does_no_harm_beside_points(tmp_path: Path) -> None:
    text = rows().replace(",", "\t").replace("u\n", "u\tgains\n").replace("0\n", "0\t1,5\n").replace("1\n", "1\t2,5\n")
    same(read_text(tmp_path, text), read_text(tmp_path, rows()))


UNITS = {
    "square": ("run,t [s],s [m],v [m/s],u [V]",),
    "no blank": ("run,t[s],s[m],v[m/s],u[V]",),
    "round": ("run,t (s),s (m),v (m/s),u (V)",),
    "slash": ("run,t/s,s/m,v/(m/s),u / V",),
    "slash and quotient": ("run,t/s,s/m,v/m/s,u/V",),
    "mixed": ("run,t,s [m],v (m s^-1),u",),
    "row": ("run,t,s,v,u", ",s,m,m/s,V"),
    "row in brackets": ("run,t,s,v,u", "-,[s],[m],[m/s],[V]"),
    "row and header": ("run,t [s],s,v (m/s),u", ",s,m,,V"),
}  # fmt: skip


@pytest.mark.parametrize("way", UNITS)
def test_units_of_a_header(tmp_path: Path, way: str) -> None:
    plain = read_text(tmp_path, rows())
    text = rows(*UNITS[way]).replace("m s^-1", "m/s")
    found = read_text(tmp_path, text)
    same(found, plain)
    assert said(found, "units").startswith("1 of 3" if way == "never" else ("2 of 3" if way == "mixed" else "3 of 3"))
    assert said(found, "files") == "run.csv: units in " + ("a row of their own" if "row" in way else "the header")


def test_units_in_remarks_and_the_line_of_a_fault(tmp_path: Path) -> None:
    text = rows("# run t s v u", "# - s m m/s V").replace(",", " ")
    assert said(read_text(tmp_path, text), "units").startswith("3 of 3")
    with pytest.raises(DataError, match="line 4 has 'oops"):
        read_text(tmp_path, rows("run,t,s,v,u", ",s,m,m/s,V").replace("0,0.1,0.84", "0,0.1,oops0.84"))


def test_a_whole_header_names_its_column_too(tmp_path: Path) -> None:
    text = rows("run no,t [s],pos [m],vel (m/s),u")
    keys = {"time": "t [s]", "episode": "run no", "columns": {"s": "pos [m]", "v": "vel"}}
    found = read_text(tmp_path, text, **keys)
    same(found, read_text(tmp_path, rows()))
    assert said(found, "units").startswith("2 of 3")
    half = text.replace("run no", "part [1]").replace("\n3,", "\ntest,").replace("\n0,", "\ntrain,")
    parts = read_text(tmp_path, half, **keys | {"episode": None, "time": None, "split": {"column": "part [1]"}})
    assert len(parts.train) == len(parts.test) == 1


@pytest.mark.parametrize(
    ("head", "below", "message"),
    [
        ("run,t [s],s [mm],v,u", (), r"unit of column 's' in run\.csv is mm, but the simulator has 's' in m"),
        ("run,t [ms],s,v,u", (), r"column 't' of run\.csv is in ms, but time is read in s"),
        ("run,t,s,v,u", (",ms,m,m/s,V",), r"column 't' of run\.csv is in ms"),
        ("run,t,s [m],v,u", (",s,mm,m/s,V",), r"the header 's \[m\]' gives the unit m, the row below it mm"),
        ("run,t,s [m],s [mm],u", (), r"'s' of run\.csv may be 's \[m\]' or 's \[mm\]'.*its whole header"),
        (
            "run,t,s,v,u",
            (",s,m,furlongs,V",),
            r"line 2 has 's'.*A row of units is read as one if every entry is a known",
        ),
    ],
)
def test_units_that_do_not_fit(tmp_path: Path, head: str, below: tuple[str, ...], message: str) -> None:
    with pytest.raises(DataError, match=message) as error:
        read_text(tmp_path, rows(head, *below))
    assert error.value.exit_code == 3


def test_an_output_in_doubt_is_not_lost_silently(tmp_path: Path) -> None:
    text = "run,t,s,v,u,force [N],force [kN]\n" + "".join(f"0,{i},{i},{i},1,{i},{i}\n" for i in range(5))
    with pytest.raises(DataError, match=r"'force' of run\.csv may be"):
        read_text(tmp_path, text)


def test_columns_that_differ_in_their_unit_go_by_their_headers(tmp_path: Path) -> None:
    text = rows("run,t,s [m],s [mm],u")
    found = read_text(tmp_path, text, columns={"s": "s [m]", "v": None})
    assert said(found, "units").startswith("1 of 2")
    with pytest.raises(DataError, match="is mm, but the simulator has 's' in m"):
        read_text(tmp_path, text, columns={"s": "s [mm]", "v": None})


@pytest.mark.parametrize(
    "text", ["phi [raw]", "x[1]", "x (2)", "a/b", "u/min", "left/pos", "T (filtered)", "[rad]", "/s"]
)
def test_what_is_no_unit_stays_in_the_name(text: str) -> None:
    header = header_of([text])
    assert header == ((text,), {}, {}, {})


def test_what_tells_two_columns_apart_is_no_unit() -> None:
    names = ("force (L)", "force (R)", "left/m", "left/pos", "x[1]", "x[2]", "flow (in)", "flow (out)")
    assert header_of(names) == (names, {}, {}, {})
    assert header_of(["force (L)", "speed (m/s)"]).units == {"force": "L", "speed": "m/s"}


def test_names_that_units_would_make_the_same() -> None:
    header = header_of(["x", "x [m]", "left/m", "left/s", "y [m]", "y [mm]"])
    assert header.names == ("x", "x [m]", "left/m", "left/s", "y [m]", "y [mm]")
    assert header.units == {"x [m]": "m", "y [m]": "m", "y [mm]": "mm"}
    assert header.doubtful == {"left": ("left/m", "left/s"), "y": ("y [m]", "y [mm]")}


@pytest.mark.parametrize("unit", ["rad", "deg", "°", "m/s^2", "m/s²", "N m/V", "N*m/V", "kN·m", "1/s", "%", "-", "µm", "mV",
                                  "°C", "rpm", "rad/s", "m**2", "V/(rad/s)", "kg", "1", "s^-1"])  # fmt: skip
def test_units(unit: str) -> None:
    assert is_unit(unit)


@pytest.mark.parametrize("word", ["", "raw", "phi", "train", "left", "2", "m//s", "furlong", "x/y", "none of these"])
def test_other_words(word: str) -> None:
    assert not is_unit(word)
