"""The place of a mistake is data: keys and indices that lead to the value."""

from typing import Annotated, Any, Literal

import msgspec
import pytest

from holdfast.validation import close_match, find_mismatch, shown


class Leg(msgspec.Struct, forbid_unknown_fields=True):
    length: Annotated[float, msgspec.Meta(gt=0.0)]
    foot: Literal["round", "flat"] = "round"


class Table(msgspec.Struct, forbid_unknown_fields=True):
    legs: Annotated[list[Leg], msgspec.Meta(max_length=2)] = []
    top: tuple[float, float] | None = None
    weights: dict[str, tuple[int, ...]] = {}

    def __post_init__(self) -> None:
        if self.top is not None and self.top[0] > self.top[1]:
            raise ValueError("the top is the wrong way round")


LEG = {"length": 1.0}


@pytest.mark.parametrize(
    ("value", "path", "expected"),
    [
        ({"legs": [LEG, {"length": 0.0}]}, ("legs", 1, "length"), "a number > 0"),
        ({"legs": [LEG, LEG, LEG]}, ("legs",), "a list of at most 2"),
        ({"legs": {}}, ("legs",), "a list of at most 2"),
        ({"legs": [{**LEG, "foot": "flta"}]}, ("legs", 0, "foot"), "one of flat, round"),
        ({"legs": ["leg"]}, ("legs", 0), "a mapping with the keys length, foot"),
        ({"top": [1.0]}, ("top",), "a list of 2 or null"),
        ({"top": [1.0, "b"]}, ("top", 1), "a number"),
        ({"top": [2.0, 1.0]}, (), "the top is the wrong way round"),
        ({"weights": {"a": [1], "b.c": [1, 2.5]}}, ("weights", "b.c", 1), "a whole number"),
        ([], (), "a mapping with the keys legs, top, weights"),
    ],
)
def test_a_value_that_does_not_fit(value: Any, path: tuple[str | int, ...], expected: str) -> None:
    found = find_mismatch(value, Table, ("table",))
    assert found is not None
    assert (found.path, found.expected) == (("table", *path), expected)
    assert not (found.unknown or found.missing)


def test_keys() -> None:
    unknown = find_mismatch({"legs": [{**LEG, "colour": 1}]}, Table)
    assert unknown is not None and unknown.unknown
    assert (unknown.path, unknown.allowed) == (("legs", 0, "colour"), ("length", "foot"))
    missing = find_mismatch({"legs": [{"foot": "flat"}]}, Table)
    assert missing is not None and missing.missing
    assert missing.path == ("legs", 0, "length")


def test_what_fits_has_none() -> None:
    assert find_mismatch({"legs": [LEG], "top": [0, 1]}, Table) is None


def test_words() -> None:
    choices = ["action_entropy", "path_entropy", "random"]
    assert close_match("radnom", choices) == "; did you mean random?"
    assert close_match("entropy", choices) == "; did you mean action_entropy or path_entropy?"
    assert close_match("zzz", choices) == ""
    assert shown({"a": [1, None]}) == '{"a": [1, null]}'
    assert len(shown("x" * 100)) == 60
