"""Tables as plain data and as CSV."""

import csv
import io
import math

import pandas as pd

from studies.tables import columns_of, to_csv


def table() -> pd.DataFrame:
    rows = [("a", True, -0.1, 3), ("b,c", False, 1e-300, 4), ("d", True, math.nan, 5)]
    return pd.DataFrame(rows, columns=["name", "success", "reward", "steps"])


def test_plain_data_gives_the_same_table_back() -> None:
    pd.testing.assert_frame_equal(pd.DataFrame(columns_of(table())), table())
    assert columns_of(table())["steps"] == [3, 4, 5]


def test_csv_gives_the_same_numbers_back() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(table()))))
    assert [row["name"] for row in rows] == ["a", "b,c", "d"]
    assert [row["success"] for row in rows] == ["1", "0", "1"]
    assert [float(row["reward"]) for row in rows[:2]] == [-0.1, 1e-300]
    assert rows[2]["reward"] == ""
