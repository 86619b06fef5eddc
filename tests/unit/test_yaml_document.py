"""YAML: what is written is read back, by this reader and by another one, and lines are right."""

from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast.config.yaml_document import read, write
from holdfast.errors import ConfigurationError
from holdfast.validation import dotted

TEXT = st.one_of(
    st.text(st.characters(exclude_categories=["Cs"]), max_size=30),
    # What a reader may take for something else than text.
    st.text("0123456789._:-+eExXo~", max_size=8),
    st.sampled_from(["no", "Yes", "on", "null", "~", "", "true", ".nan", "1e-3", "<<", "=", "010"]),
)
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    TEXT,
)
DATA = st.dictionaries(
    TEXT,
    st.recursive(
        SCALARS,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
        max_leaves=10,
    ),
    max_size=4,
)


@given(DATA)
@settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow])
def test_what_is_written_is_read_back_unchanged(data: dict[str, Any]) -> None:
    again = read(write(data).encode(), "written").data
    assert again == data
    # Equality takes 1, 1.0 and True for the same.
    assert repr(again) == repr(data)


def test_what_is_written_another_reader_reads_alike() -> None:
    data = {"a": [1e-3, 1e22, -5, True, None], "b": {"c": ["1e3", "x"]}, "d": [{"e": [1.0]}]}
    assert yaml.safe_load(write(data)) == data


def test_lines() -> None:
    document = read(b"a:\n  b: 1\n  c:\n    - 1\n    -\n      2\nd: {e: [5]}\n", "text")
    assert document.data == {"a": {"b": 1, "c": [1, 2]}, "d": {"e": [5]}}
    for path, line in {("a",): 1, ("a", "b"): 2, ("a", "c"): 3, ("a", "c", 0): 4}.items():
        assert document.line(path) == line
    assert document.line(("a", "absent", 3)) == 1
    assert document.line(("d", "e", 0)) == 7
    assert document.line(("absent",)) is None


def test_dotted() -> None:
    assert dotted(("model", "holes", 2, "center", 0)) == "model.holes[2].center[0]"
    assert dotted(("model", "\x1b[2J")) == "model.'\\x1b[2J'"
    assert len(dotted(("k" * 1000,))) == 80


@pytest.mark.parametrize("text", ['"\\ud800"', '{"\\udfff": 1}'])
def test_half_a_character(text: str) -> None:
    with pytest.raises(ConfigurationError, match="holds half a character"):
        read(text.encode(), "text")
