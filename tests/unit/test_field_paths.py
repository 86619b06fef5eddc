"""Fields of messages by their path; the messages here have what generated ones have."""

from __future__ import annotations

import array
import sys
import types
from typing import Any, ClassVar

import numpy as np
import pytest

from holdfast.errors import ConfigurationError, EnvironmentFailedError
from holdfast.ros.field_paths import (
    check_path,
    find_type,
    parse_path,
    read_field,
    read_numbers,
    write,
)


class Generated:
    """What generated classes have in common."""

    FIELDS: ClassVar[dict[str, str]] = {}

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        return dict(cls.FIELDS)


class Point(Generated):
    FIELDS: ClassVar[dict[str, str]] = {"x": "double", "y": "double"}

    def __init__(self) -> None:
        self.x, self.y = 0.0, 0.0


class Request(Generated):
    FIELDS: ClassVar[dict[str, str]] = {
        "point": "fake_msgs/Point",
        "points": "sequence<fake_msgs/Point>",
        "corners": "fake_msgs/Point[2]",
        "values": "sequence<double>",
        "counts": "sequence<int32, 4>",
        "vector": "double[3]",
        "index": "uint8",
        "now": "boolean",
        "label": "string",
        "labels": "sequence<string>",
    }

    def __init__(self) -> None:
        self.point = Point()
        self.points: list[Point] = []
        self.corners = [Point(), Point()]
        self.values = array.array("d")
        self.counts = array.array("i")
        self.vector = np.zeros(3)
        self.index = 0
        self.now = False
        self.label = ""
        self.labels: list[str] = []


@pytest.fixture(autouse=True)
def fake_msgs(monkeypatch: pytest.MonkeyPatch) -> None:
    package, messages = types.ModuleType("fake_msgs"), types.ModuleType("fake_msgs.msg")
    messages.Point = Point  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fake_msgs", package)
    monkeypatch.setitem(sys.modules, "fake_msgs.msg", messages)


def path(text: str) -> Any:
    return parse_path(text, "environment.act.action")


class TestParsing:
    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("x", ("x",)),
            ("pose.position.x", ("pose", "position", "x")),
            ("points[0].x", ("points", 0, "x")),
            ("values[12]", ("values", 12)),
        ],
    )
    def test_a_path_is_names_and_indices(self, text: str, expected: Any) -> None:
        assert path(text) == expected

    @pytest.mark.parametrize(
        "text", ["", ".", "x.", ".x", "x..y", "x[]", "x[-1]", "x[a]", "[0]", "x y", "x[99999]"]
    )
    def test_anything_else_is_an_error_that_names_the_key(self, text: str) -> None:
        with pytest.raises(ConfigurationError, match=r"environment\.act\.action is "):
            path(text)


class TestChecking:
    @pytest.mark.parametrize(
        "text",
        ["point.x", "points[3].y", "corners[1].x", "values", "values[2]", "vector[2]", "labels[1]"],
    )
    def test_a_field_that_a_type_has(self, text: str) -> None:
        check_path(Request, path(text), "key")

    @pytest.mark.parametrize(
        ("text", "reason"),
        [
            ("pont.x", r"has no field pont; there: point, points"),
            ("point.z", r"has no field point\.z; there: x, y"),
            ("index.x", r"has no field index\.x; there: none"),
            ("point[0]", r"has no array point"),
            ("label[0]", r"has no array label"),
            ("vector[3]", r"has 3 elements in vector, and vector\[3\] is meant"),
            ("corners[2].x", r"has 2 elements in corners"),
        ],
    )
    def test_one_that_it_has_not(self, text: str, reason: str) -> None:
        with pytest.raises(ConfigurationError, match=rf"environment\.x: .*{reason}"):
            check_path(Request, path(text), "environment.x")


class TestReading:
    def test_numbers_and_arrays_are_lists_of_numbers(self) -> None:
        message = Request()
        message.values.extend([1.0, 2.0])
        message.vector[1] = 4.0
        message.index = 3
        message.now = True
        assert read_numbers(message, path("values")) == [1.0, 2.0]
        assert read_numbers(message, path("vector")) == [0.0, 4.0, 0.0]
        assert read_numbers(message, path("vector[1]")) == [4.0]
        assert read_numbers(message, path("index")) == [3.0]
        assert read_numbers(message, path("now")) == [1.0]
        assert read_numbers(message, path("counts")) == []
        assert read_field(message, path("now")) is True

    @pytest.mark.parametrize("text", ["point", "label", "corners"])
    def test_anything_else_is_an_error(self, text: str) -> None:
        with pytest.raises(EnvironmentFailedError, match=f"field {text} of .* must be a number"):
            read_numbers(Request(), path(text))

    def test_an_array_of_a_message_does_not_grow(self) -> None:
        with pytest.raises(
            EnvironmentFailedError, match=r"has 0 elements in values, and values\[0"
        ):
            read_numbers(Request(), path("values[0]"))


class TestWriting:
    @pytest.mark.parametrize(
        ("text", "value", "expected"),
        [
            ("point.x", 2, 2.0),
            ("index", 2.0, 2),
            ("now", 1, True),
            ("label", "y", "y"),
            ("labels", "y", ["y"]),
            ("values", [1, 2.5], array.array("d", [1.0, 2.5])),
            ("values", 1.5, array.array("d", [1.5])),
            ("counts", [1.0, 2.0], array.array("i", [1, 2])),
            ("points[0].x", 2.5, 2.5),
            ("corners[1].y", 2.5, 2.5),
            ("vector[2]", 2.5, 2.5),
        ],
    )
    def test_a_value_becomes_what_the_field_is(self, text: str, value: Any, expected: Any) -> None:
        message = Request()
        write(message, path(text), value)
        written = read_field(message, path(text))
        assert type(written) in (type(expected), np.float64)
        assert written == expected

    def test_an_array_becomes_as_long_as_it_must(self) -> None:
        message = Request()
        write(message, path("values[2]"), 1.0)
        write(message, path("points[1].x"), 2.0)
        write(message, path("vector"), [1.0, 2.0, 3.0])
        assert list(message.values) == [0.0, 0.0, 1.0]
        assert [point.x for point in message.points] == [0.0, 2.0]
        assert list(message.vector) == [1.0, 2.0, 3.0]

    @pytest.mark.parametrize(
        ("text", "value"),
        [
            ("index", 1.5),
            ("now", 2),
            ("vector", [1.0, 2.0]),
            ("counts", [1.5]),
            ("point", 1.0),
            ("point.x", "a"),
            ("point.x", [1.0]),
            ("index", float("nan")),
        ],
    )
    def test_one_that_does_not_fit_is_an_error(self, text: str, value: Any) -> None:
        with pytest.raises(EnvironmentFailedError, match="cannot be put into field"):
            write(Request(), path(text), value)


class TestTypes:
    def test_a_type_is_found_by_its_name(self) -> None:
        assert find_type("fake_msgs/msg/Point", "environment.done.type") is Point

    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("Point", "it must be package/msg/Type"),
            ("fake_msgs/Point", "it must be package/msg/Type"),
            ("fake_msgs/srv/Point", "it must be package/msg/Type"),
            ("fake_msgs/msg/Line", "cannot be imported"),
            ("no_such_msgs/msg/Line", "install ros-DISTRO-no-such-msgs"),
            ("os.path/msg/Line", "it must be"),
        ],
    )
    def test_another_is_an_error_that_names_the_key(self, name: str, reason: str) -> None:
        with pytest.raises(ConfigurationError, match=rf"environment\.done\.type is .*{reason}"):
            find_type(name, "environment.done.type", ("msg",))
