"""What a ROS 1 master tells its guard, and the state that comes of it."""

from pathlib import Path

import pytest
from tests.master_state import known

from ros1_master_guard.process import HEAD, MasterState, decoded, encoded


def test_a_value_gives_way_to_a_namespace() -> None:
    state = MasterState()
    for key, value in (("/a", 1), ("/a/b/", 2), ("/a/c", {"d": 3}), ("/e", 4), ("/e", None)):
        state.apply("parameters", key, value)
    assert state.parameters == {"a": {"b": 2, "c": {"d": 3}}}
    state.apply("parameters", "/", {"f": 5})
    assert state.parameters == {"f": 5}
    assert state.changes == 6


def test_a_key_or_a_whole_table_is_set() -> None:
    state = known()
    state.apply("types", "/a", "x/Y")
    state.apply("services", "/grip", None)
    state.apply("publishers", None, {})
    expected = known()
    expected.types["/a"] = "x/Y"
    del expected.services["/grip"]
    expected.publishers = {}
    assert state == expected


def test_a_message_is_read_as_it_was_written_by_an_older_python() -> None:
    message = encoded(vars(known()))
    # ROS's Python may be 3.8, the guard's is newer.
    assert message[HEAD.size :].startswith(b"\x80\x04")
    assert HEAD.unpack_from(message) == (len(message) - HEAD.size,)
    assert MasterState(**decoded(message[HEAD.size :])) == known()


def test_no_code_comes_out_of_a_message() -> None:
    with pytest.raises(Exception, match=r"pathlib\.PosixPath is no parameter"):
        decoded(encoded(("parameters", "/evil", Path("x")))[HEAD.size :])
