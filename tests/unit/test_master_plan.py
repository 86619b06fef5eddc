"""The state of a new ROS 1 master: what the last one knew, and what nodes answer."""

from __future__ import annotations

from tests.master_state import ARM, BASE, LIDAR, known

from ros1_master_guard.plan import (
    NodeAnswer,
    NodeReport,
    lookups_of,
    reconcile,
    state_of_snapshot,
    unregistrations,
)
from ros1_master_guard.process import MasterState


def reports() -> dict[str, NodeAnswer]:
    """Return what nodes say that are as the master knew them."""
    return {
        ARM: NodeReport({"/joints": "sensor_msgs/JointState"}, {"/scan": "sensor_msgs/LaserScan"}),
        BASE: NodeReport({}, {"/scan": "sensor_msgs/LaserScan"}),
        LIDAR: NodeReport({"/scan": "sensor_msgs/LaserScan"}, {}),
    }


SERVED: dict[str, bool | None] = {"/grip": True, "/stop": True}


class TestReconcile:
    def test_nothing_has_changed(self) -> None:
        before = known()
        found = reconcile(before, reports(), SERVED)
        assert found.state == before == known()
        assert (found.gone, found.silent, found.lost_services) == ((), (), ())

    def test_who_is_silent_is_kept(self) -> None:
        found = reconcile(known(), dict.fromkeys(reports()), dict.fromkeys(SERVED))
        assert found.state == known()
        assert sorted(found.silent) == ["/arm", "/base", "/lidar"]

    def test_who_has_ended_is_left_out(self) -> None:
        found = reconcile(known(), {**reports(), ARM: "gone"}, {**SERVED, "/grip": False})
        assert found.state.publishers == {"/scan": [("/lidar", LIDAR)]}
        assert found.state.subscribers == {"/scan": [("/base", BASE)]}
        assert found.state.services == {"/stop": known().services["/stop"]}
        assert found.state.parameter_subscribers == {}
        assert found.state.parameters == known().parameters
        assert (found.gone, found.lost_services) == (("/arm",), ("/grip",))

    def test_a_service_is_kept_if_it_answers_whatever_its_node_does(self) -> None:
        found = reconcile(known(), {**reports(), ARM: "gone"}, SERVED)
        assert found.state.services == known().services

    def test_of_a_topic_the_node_has_the_last_word(self) -> None:
        said = NodeReport({"/gripper": "std_msgs/Bool"}, {"/scan": "*", "/map": "*"})
        found = reconcile(known(), {**reports(), ARM: said}, SERVED).state
        assert found.publishers == {
            "/scan": [("/lidar", LIDAR)],
            "/gripper": [("/arm", ARM)],
        }
        assert found.subscribers["/map"] == [("/arm", ARM)]
        assert found.types["/gripper"] == "std_msgs/Bool"
        assert found.types["/scan"] == "sensor_msgs/LaserScan"
        assert "/map" not in found.types

    def test_two_names_at_one_address(self) -> None:
        # The arm has died, and the base has its port now.
        before = known()
        before.publishers["/odometry"] = [("/base", ARM)]
        before.subscribers["/scan"] = [("/base", ARM), ("/arm", ARM)]
        before.services["/stop"] = ("/base", ARM, "rosrpc://robot:12")
        said = NodeReport({"/odometry": "nav_msgs/Odometry", "/new": "x/Y"}, {})
        found = reconcile(before, {**reports(), ARM: said}, SERVED).state
        assert found.publishers == {
            "/scan": [("/lidar", LIDAR)],
            "/odometry": [("/base", ARM)],
        }
        assert found.subscribers == {}

    def test_every_published_topic_has_a_type(self) -> None:
        # Without one, `rostopic list` fails at a stock master.
        before = known()
        before.types = {}
        assert reconcile(before, {}, {}).state.types == {"/joints": "*", "/scan": "*"}

    def test_what_was_known_is_left_as_it_is(self) -> None:
        before = known()
        said = NodeReport({"/scan": "x/Y", "/more": "x/Y"}, {})
        reconcile(before, {ARM: said, BASE: "gone"}, {})
        assert before == known()


class TestWhoDidNotAnswer:
    def test_only_their_part_is_doubtful(self) -> None:
        found = reconcile(known(), {**reports(), ARM: None}, {**SERVED, "/stop": None}).doubtful
        expected = MasterState()
        expected.publishers = {"/joints": [("/arm", ARM)]}
        expected.subscribers = {"/scan": [("/arm", ARM)]}
        expected.parameter_subscribers = known().parameter_subscribers
        expected.services = {"/stop": known().services["/stop"]}
        assert found == expected
        assert reconcile(known(), reports(), SERVED).doubtful == MasterState()

    def test_what_is_no_more_is_taken_back(self) -> None:
        before = reconcile(known(), {**reports(), ARM: None}, {**SERVED, "/grip": None}).doubtful
        assert unregistrations(before, before) == []
        after = reconcile(before, {ARM: "gone"}, {"/grip": False})
        assert unregistrations(before, after.state) == [
            ("unregisterPublisher", ("/arm", "/joints", ARM)),
            ("unregisterSubscriber", ("/arm", "/scan", ARM)),
            ("unsubscribeParam", ("/arm", ARM, "/arm/speed/")),
            ("unregisterService", ("/arm", "/grip", "rosrpc://robot:11")),
        ]


class TestSnapshot:
    SYSTEM_STATE = (
        [["/joints", ["/arm"]], ["/scan", ["/lidar", "/left"]]],
        [["/scan", ["/base", "/arm"]], ["/left", ["/left"]]],
        [["/grip", ["/arm"]], ["/stop", ["/base"]], ["/gone", ["/base"]]],
    )

    def test_what_to_look_up(self) -> None:
        nodes, services = lookups_of(self.SYSTEM_STATE)
        assert nodes == ["/arm", "/base", "/left", "/lidar"]
        assert services == ["/grip", "/stop", "/gone"]

    def test_what_has_gone_meanwhile_is_left_out(self) -> None:
        expected = known()
        expected.parameter_subscribers = {}
        assert expected == state_of_snapshot(
            self.SYSTEM_STATE,
            [list(pair) for pair in expected.types.items()],
            expected.parameters,
            {"/arm": ARM, "/base": BASE, "/lidar": LIDAR, "/left": None},
            {"/grip": "rosrpc://robot:11", "/stop": "rosrpc://robot:12", "/gone": None},
        )
