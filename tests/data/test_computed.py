"""Columns that a formula makes of a file's columns."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from simpel_cli.data.computed import with_computed
from simpel_cli.data.tables.table import Table, read_table
from simpel_cli.errors import ConfigError, DataError


@pytest.fixture
def table(tmp_path: Path) -> Table:
    angle = np.linspace(0, 2, 9)
    frame = pd.DataFrame({"vx": 3 * np.cos(angle), "vy": 3 * np.sin(angle), "theta": angle, "who": "a"})
    frame.loc[4, "vx"] = np.nan
    for name in ("a", "b"):
        frame.to_parquet(tmp_path / f"{name}.parquet")
    return read_table((tmp_path / "a.parquet", tmp_path / "b.parquet"))


def test_values_of_all_files_and_of_columns_computed_before(table: Table) -> None:
    found = with_computed(table, {"v": "vx*cos(theta) + vy*sin(theta)", "twice": "2*v"})
    expected = np.full(18, 3.0)
    expected[[4, 13]] = np.nan
    np.testing.assert_allclose(found.numbers("v"), expected, rtol=1e-12)
    np.testing.assert_allclose(found.numbers("twice"), 2 * expected, rtol=1e-12)
    assert found.columns[-2:] == ("v", "twice")
    assert "v" not in table.columns


def test_names_of_fields(tmp_path: Path) -> None:
    columns = {
        "imu.gyro.x": [1.0, 2.0],
        "imu.gyro": [3.0, 4.0],
        "imu_gyro": [5.0, 6.0],
        "car/v": [8.0, 9.0],
        "v": [2.0, 3.0],
    }
    pd.DataFrame(columns).to_parquet(tmp_path / "a.parquet")
    table = read_table((tmp_path / "a.parquet",))
    found = with_computed(table, {"y": "imu.gyro.x/imu.gyro + 2.5*imu_gyro", "z": "car/v/v", "w": "sqrt(imu.gyro.x)"})
    np.testing.assert_allclose(found.numbers("y"), [1 / 3 + 12.5, 2 / 4 + 15])
    np.testing.assert_allclose(found.numbers("z"), [4, 3])
    np.testing.assert_allclose(found.numbers("w"), [1, 2**0.5])
    pd.DataFrame(columns | {"car": [1.0, 1.0]}).to_parquet(tmp_path / "b.parquet")
    table = read_table((tmp_path / "b.parquet",))
    with pytest.raises(ConfigError, match=r"data\.computed\.z: car/v may be that column or a quotient.*`car / v`"):
        with_computed(table, {"z": "car/v"})
    np.testing.assert_allclose(with_computed(table, {"z": "car / v"}).numbers("z"), [0.5, 1 / 3])


@pytest.mark.parametrize(
    ("formulas", "error", "words"),
    [
        ({"vx": "2*vy"}, ConfigError, ["data.computed.vx", "already"]),
        ({"v": "vx*cos(tetha)"}, DataError, ["'tetha' is missing", "Did you mean theta?", "data.computed.v"]),
        ({"v": "vx*"}, ConfigError, ["data.computed.v", "vx*"]),
        ({"v": "3"}, ConfigError, ["data.computed.v", "no column"]),
        ({"v": "who*2"}, DataError, ["'who'", "should hold numbers"]),
    ],
)
def test_errors_name_the_key_and_the_cure(
    table: Table, formulas: dict[str, str], error: type[Exception], words: list[str]
) -> None:
    with pytest.raises(error) as raised:
        with_computed(table, formulas)
    assert all(word in str(raised.value) for word in words), str(raised.value)
