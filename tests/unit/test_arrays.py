"""How arrays and numbers are read, and how a message shows an array."""

import copy
from decimal import Decimal
from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import (
    KeepsReadOnly,
    floats,
    in_brief,
    integer,
    is_masked,
    plain,
    real_number,
    real_numbers,
    whole,
)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (np.array([1.0, 2.5]), "[1.  2.5]"),
        (np.arange(100), "[ 0  1  2  3 ... 96 97 98 99]"),
        ([[1, 2], [3, 4]], "[[1 2]\n [3 4]]"),
        ([[1, 2], [3]], "[[1, 2], [3]]"),
        (3.0, "3."),
        ("abc", "'abc'"),
    ],
)
def test_in_brief(values: object, text: str) -> None:
    assert in_brief(values) == text


def test_a_ragged_list_is_cut() -> None:
    shown = in_brief([[0], list(range(1000))])
    assert shown.startswith("[[0], [0, 1, 2, 3,")
    assert shown.endswith("18, 19,...")


HIDDEN = np.ma.array([1.0, 2.0], mask=[False, True])


@pytest.mark.parametrize(
    "value", [3, np.int8(3), np.uint64(3), np.array(3), np.ma.array(3)], ids=lambda each: repr(each)
)
def test_whole_numbers(value: Any) -> None:
    assert integer(value) == whole("steps", value, 1) == 3
    assert type(integer(value)) is int


@pytest.mark.parametrize(
    "value",
    [3.0, True, np.False_, np.array(True), "3", [3], np.array([3]), np.ma.masked, Decimal(3)],
)
def test_no_whole_numbers(value: Any) -> None:
    assert integer(value) is None


@pytest.mark.parametrize(("value", "limits"), [(0, "from 1 to 9"), (10, "from 1 to 9"), (-1, "1")])
def test_whole_numbers_out_of_bounds(value: int, limits: str) -> None:
    with pytest.raises(InvalidValueError, match=f"^steps {value}: allowed are whole .*{limits}"):
        whole("steps", np.int64(value), 1, 9)


@pytest.mark.parametrize("value", [0.5, np.float32(0.5), np.float16(0.5), np.array(0.5)])
def test_one_real_number(value: Any) -> None:
    assert real_number(value) == 0.5
    assert type(real_number(value)) is float
    assert floats("x", value).shape == ()


@pytest.mark.parametrize("value", ["0.5", True, [0.5], np.array([0.5]), 0.5j, np.ma.masked, None])
def test_no_real_number(value: Any) -> None:
    assert real_number(value) is None


@pytest.mark.parametrize(
    "value",
    [
        *("4.0", ["4.0"], True, [1.0, True], [[1.0], [np.True_]], [1.0, None], [[1], [1, 2]]),
        *(np.datetime64("2020"), [Decimal(1)], 1j, HIDDEN, [HIDDEN], [1.0, np.ma.masked], 2**70),
    ],
    ids=repr,
)
def test_no_real_numbers(value: Any) -> None:
    assert real_numbers(value) is None
    with pytest.raises(InvalidValueError, match=r"^points is .*must be real numbers"):
        floats("points", value)


def test_a_mask_that_hides_nothing() -> None:
    assert not is_masked(HIDDEN[:1])
    assert floats("x", HIDDEN[:1]).tolist() == [1.0]
    assert type(floats("x", HIDDEN[:1])) is np.ndarray


def test_plain_values() -> None:
    given = {"a": np.array([[1, 2]]), "b": (np.float32(0.5), [np.int64(3)]), "c": np.str_("x")}
    found = plain(given)
    assert found == {"a": [[1, 2]], "b": (0.5, [3]), "c": "x"}
    assert type(found["b"][1][0]) is int
    for other in (HIDDEN, np.datetime64("2020"), Decimal(1)):
        assert plain(other) is other


def test_read_only_arrays_stay_so_in_a_copy() -> None:
    kept = KeepsReadOnly()
    fixed = np.ones(2)
    fixed.setflags(write=False)
    vars(kept).update(fixed=fixed, several=[fixed, fixed.copy()], own=np.ones(2), all=[fixed])
    copied: Any = copy.deepcopy(kept)
    writable = {
        "fixed": copied.fixed.flags.writeable,
        "several": copied.several[1].flags.writeable,
        "own": copied.own.flags.writeable,
        "all": copied.all[0].flags.writeable,
    }
    assert writable == {"fixed": False, "several": True, "own": True, "all": False}
