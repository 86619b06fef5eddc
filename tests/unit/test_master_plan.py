"""The state of a new ROS 1 master: what the last one knew, without who has ended."""

from __future__ import annotations

from tests.master_state import ARM, BASE, LIDAR, known

from ros1_master_guard.plan import state_of_snapshot, without


def test_who_has_ended_is_left_out() -> None:
    before = known()
    found = without(before, {ARM})
    assert before == known()
    assert found.publishers == {"/scan": [("/lidar", LIDAR)]}
    assert found.subscribers == {"/scan": [("/base", BASE)]}
    assert found.services == {"/stop": known().services["/stop"]}
    assert found.parameter_subscribers == {}
    assert found.parameters == known().parameters
    assert without(before, ()) == known()


def test_every_published_topic_has_a_type() -> None:
    # Without one, `rostopic list` fails at a stock master.
    before = known()
    before.types = {}
    assert without(before, ()).types == {"/joints": "*", "/scan": "*"}


def test_what_has_ended_while_a_stock_master_was_asked_is_left_out() -> None:
    expected = known()
    expected.parameter_subscribers = {}
    system_state = (
        [["/joints", ["/arm"]], ["/scan", ["/lidar", "/left"]]],
        [["/scan", ["/base", "/arm"]], ["/left", ["/left"]]],
        [["/grip", ["/arm"]], ["/stop", ["/base"]], ["/gone", ["/base"]]],
    )
    uris = {"/arm": ARM, "/base": BASE, "/lidar": LIDAR, "/left": None, "service /gone": None}
    uris |= {"service /grip": "rosrpc://robot:11", "service /stop": "rosrpc://robot:12"}
    types = [list(pair) for pair in expected.types.items()]
    assert state_of_snapshot(system_state, types, expected.parameters, uris) == expected
