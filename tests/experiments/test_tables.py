"""Tables: what goes in comes out, and what does not fit is refused."""

import csv
import io

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.experiments.tables import Table


def table() -> Table:
    return Table.of_rows(
        ("name", "success", "reward"),
        [("a", True, -0.1), ("b,c", False, 1e-300), ("d", True, None)],
    )


def test_numbers_have_nan_where_there_is_nothing() -> None:
    np.testing.assert_array_equal(table().numbers("reward"), [-0.1, 1e-300, np.nan])
    np.testing.assert_array_equal(table().numbers("success"), [1.0, 0.0, 1.0])


def test_csv_gives_the_same_numbers_back() -> None:
    rows = list(csv.DictReader(io.StringIO(table().to_csv())))
    assert [row["name"] for row in rows] == ["a", "b,c", "d"]
    assert [row["success"] for row in rows] == ["1", "0", "1"]
    assert [float(row["reward"]) for row in rows[:2]] == [-0.1, 1e-300]
    assert rows[2]["reward"] == ""


def test_rows_of_another_length_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="2 cells for 3 columns"):
        Table.of_rows(("a", "b", "c"), [(1, 2)])


def test_extending() -> None:
    longer = Table({})
    longer.extend(table(), way="first")
    longer.extend(table(), way="second")
    assert longer.num_rows == 6
    assert list(longer.rows())[3] == {"way": "second", "name": "a", "success": True, "reward": -0.1}
    with pytest.raises(InvalidValueError, match="do not fit"):
        longer.extend(table())
