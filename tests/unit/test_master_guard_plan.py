"""What a new ROS 1 master is to know, and what the last one wrote down."""

from __future__ import annotations

import copy
import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.ros.master.plan import (
    NodeAnswer,
    NodeReport,
    lookups_of,
    reconcile,
    state_of_snapshot,
    unregistrations,
)
from holdfast.ros.master.process import (
    Journal,
    MasterState,
    parameter_names,
    read_journal,
    write_journal,
)
from holdfast.ros.master.settings import GuardError, GuardLock

ARM, BASE, LIDAR = "http://robot:1/", "http://robot:2/", "http://robot:3/"


def known() -> MasterState:
    state = MasterState()
    state.parameters = {"run_id": "x", "arm": {"speed": 1}}
    state.publishers = {"/joints": [("/arm", ARM)], "/scan": [("/lidar", LIDAR)]}
    state.subscribers = {"/scan": [("/base", BASE), ("/arm", ARM)]}
    state.services = {
        "/grip": ("/arm", ARM, "rosrpc://robot:11"),
        "/stop": ("/base", BASE, "rosrpc://robot:12"),
    }
    state.types = {"/joints": "sensor_msgs/JointState", "/scan": "sensor_msgs/LaserScan"}
    state.parameter_subscribers = {"/arm/speed/": [("/arm", ARM)]}
    return state


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


class TestParameters:
    def test_a_value_gives_way_to_a_namespace(self) -> None:
        state = MasterState()
        for key, value in (("/a", 1), ("/a/b/", 2), ("/a/c", {"d": 3}), ("/e", 4), ("/e", None)):
            state.apply("parameters", key, value)
        assert state.parameters == {"a": {"b": 2, "c": {"d": 3}}}
        assert parameter_names(state.parameters) == ["/a/b", "/a/c/d"]
        state.apply("parameters", "/", {"f": 5})
        assert state.parameters == {"f": 5}


class TestLock:
    def test_a_second_guard_is_kept_away_even_if_the_file_is_removed(self, tmp_path: Path) -> None:
        path = tmp_path / "lock"
        with GuardLock(path, 11311) as lock:
            path.unlink()
            lock.keep()
            with pytest.raises(GuardError, match=f"has a guard already: process {os.getpid()}"):
                GuardLock(path, 11311)
        with GuardLock(path, 11311):
            pass

    def test_it_is_kept_young(self, tmp_path: Path) -> None:
        path = tmp_path / "lock"
        with GuardLock(path, 11311) as lock:
            os.utime(path, (0, 0))
            lock.keep()
            assert path.stat().st_mtime > 0


class TestJournal:
    def test_there_is_none(self, tmp_path: Path) -> None:
        assert read_journal(tmp_path / "none") is None

    def test_what_is_there_and_cannot_be_read_is_said(self, tmp_path: Path) -> None:
        (tmp_path / "other").write_bytes(b"something else")
        with pytest.raises(ValueError, match="no journal"):
            read_journal(tmp_path / "other")
        (tmp_path / "empty").touch()
        with pytest.raises(ValueError, match="no journal"):
            read_journal(tmp_path / "empty")
        with pytest.raises(IsADirectoryError):
            read_journal(tmp_path)

    @pytest.mark.parametrize("by", ["a look", "a change"])
    @pytest.mark.parametrize("loss", ["file", "directory", "truncated", "another"])
    def test_it_is_written_anew_when_it_is_gone(self, tmp_path: Path, loss: str, by: str) -> None:
        path = tmp_path / "guard" / "journal"
        journal = Journal(path, known())
        if loss == "file":
            path.unlink()
        elif loss == "directory":
            shutil.rmtree(path.parent)
        elif loss == "truncated":
            os.truncate(path, 10)
        else:
            path.unlink()
            path.write_bytes(b"another")
        expected = known()
        if by == "a look":
            journal.look()
        else:
            journal.write("types", "/a", "x/Y")
            expected.types["/a"] = "x/Y"
        journal.close()
        assert read_journal(path) == expected
        assert path.parent.stat().st_mode & 0o777 == 0o700

    def test_a_look_keeps_it_young(self, tmp_path: Path) -> None:
        journal = Journal(tmp_path / "journal", known())
        os.utime(tmp_path / "journal", (0, 0))
        journal.look()
        journal.close()
        assert (tmp_path / "journal").stat().st_mtime > 0

    def test_a_removed_one_that_is_open_can_be_read(self, tmp_path: Path) -> None:
        write_journal(tmp_path / "journal", known())
        with (tmp_path / "journal").open("rb") as file:
            (tmp_path / "journal").unlink()
            for _ in range(2):
                assert read_journal(file.fileno()) == known()

    def test_that_it_cannot_be_written_is_said_once(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "guard" / "journal"
        journal = Journal(path, known())
        shutil.rmtree(path.parent)
        path.parent.touch()
        for number in range(3):
            journal.write("parameters", "/a", number)
            journal.look()
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "changes are not written down" in said
        path.parent.unlink()
        journal.look()
        assert "written down again" in capsys.readouterr().err
        journal.close()
        found = read_journal(path)
        assert found is not None
        assert found.parameters["a"] == 2

    def test_it_is_not_written_through_a_link(self, tmp_path: Path) -> None:
        (tmp_path / "precious").write_text("mine")
        (tmp_path / "journal.new").symlink_to(tmp_path / "precious")
        write_journal(tmp_path / "journal", known())
        assert (tmp_path / "precious").read_text() == "mine"
        assert read_journal(tmp_path / "journal") == known()

    def test_it_is_written_and_read(self, tmp_path: Path) -> None:
        path = tmp_path / "journal"
        write_journal(path, known())
        assert read_journal(path) == known()
        assert path.stat().st_mode & 0o777 == 0o600
        assert [each.name for each in tmp_path.iterdir()] == ["journal"]

    @given(
        st.lists(
            st.one_of(
                st.tuples(
                    st.just("parameters"),
                    st.sampled_from(["/a", "/a/b", "/c", "/"]),
                    st.dictionaries(st.sampled_from("abc"), st.integers(), max_size=2),
                ),
                st.tuples(
                    st.sampled_from(["publishers", "subscribers", "parameter_subscribers"]),
                    st.sampled_from(["/x", "/y"]),
                    st.none()
                    | st.lists(st.tuples(st.sampled_from("ab"), st.just("u")), min_size=1),
                ),
                st.tuples(
                    st.just("services"),
                    st.sampled_from(["/x", "/y"]),
                    st.none() | st.tuples(st.just("n"), st.just("u"), st.text()),
                ),
                st.tuples(st.just("types"), st.sampled_from(["/x", "/y"]), st.text()),
            ),
            max_size=20,
        ),
        st.integers(0, 10_000),
    )
    def test_cut_anywhere_it_holds_what_was_whole(
        self, changes: list[tuple[str, str, Any]], cut: int
    ) -> None:
        import tempfile

        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "journal"
            journal = Journal(path, MasterState())
            begun = path.stat().st_size
            state = MasterState()
            after = [(begun, copy.deepcopy(state))]
            for change in changes:
                journal.write(*change)
                state.apply(*copy.deepcopy(change))
                after.append((path.stat().st_size, copy.deepcopy(state)))
            journal.close()
            assert read_journal(path) == state
            size = min(begun + cut, after[-1][0])
            os.truncate(path, size)
            assert read_journal(path) == [whole for end, whole in after if end <= size][-1]

    def test_it_is_written_anew_before_it_grows_large(self, tmp_path: Path) -> None:
        path = tmp_path / "journal"
        journal = Journal(path, known())
        value = "x" * 100_000
        for number in range(200):
            journal.write("parameters", "/large", f"{number}{value}")
            assert path.stat().st_size < 6_000_000
        journal.close()
        expected = known()
        expected.apply("parameters", "/large", f"199{value}")
        assert read_journal(path) == expected

    def test_after_a_full_disk_it_is_written_anew(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "journal"
        journal = Journal(path, known())
        with monkeypatch.context() as patch:
            # A disk takes what there is room for.
            patch.setattr(os, "write", lambda _, data, write=os.write: write(_, data[:9]))
            journal.write("types", "/a", "x/Y")
        assert str(path) in capsys.readouterr().err
        assert read_journal(path) == known()
        journal.write("types", "/b", "x/Y")
        journal.close()
        expected = known()
        expected.types |= {"/a": "x/Y", "/b": "x/Y"}
        assert read_journal(path) == expected

    def test_no_code_comes_out_of_it(self, tmp_path: Path) -> None:
        path = tmp_path / "journal"
        journal = Journal(path, known())
        journal.write("parameters", "/evil", Path("x"))
        journal.write("parameters", "/good", 1)
        journal.close()
        found = read_journal(path)
        assert found is not None
        assert found.parameters == {**known().parameters, "good": 1}

    def test_what_cannot_be_written_down_costs_nobody_anything(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        journal = Journal(tmp_path / "journal", known())
        journal.write("parameters", "/no", lambda: None)
        journal.close()
        assert "cannot be written down" in capsys.readouterr().err
        assert read_journal(tmp_path / "journal") == known()

    def test_it_takes_old_pythons_pickles_alone(self, tmp_path: Path) -> None:
        # ROS's Python may be 3.8, the guard's is newer; both read the same file.
        path = tmp_path / "journal"
        write_journal(path, known())
        assert b"\x80\x04" in path.read_bytes()
        assert pickle.HIGHEST_PROTOCOL > 4
