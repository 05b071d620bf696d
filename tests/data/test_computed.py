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
