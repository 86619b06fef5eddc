"""The state of a new ROS 1 master: what the last one knew, without who has ended."""

from tests.master_state import ARM, BASE, LIDAR, known

from ros1_master_guard.plan import without


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
