"""The guard's lock and the master's address."""

import os
from pathlib import Path

import pytest
from tests.ports import free_port

from ros1_master_guard.errors import GuardError
from ros1_master_guard.settings import MasterAddress, directory_for, guard_lock


def test_a_second_guard_is_kept_away() -> None:
    port = free_port()
    with guard_lock(port):
        refused = pytest.raises(GuardError, match=f"has a guard already: process {os.getpid()}")
        with refused, guard_lock(port):
            pass
    with guard_lock(port):
        pass


class TestDirectory:
    def test_one_of_this_user_alone(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        directory = directory_for(None)
        assert directory_for(tmp_path / "named") == tmp_path / "named"
        assert directory.stat().st_mode & 0o777 == 0o700
        directory.chmod(0o777)
        with pytest.raises(GuardError, match="you alone can write to; name another one"):
            directory_for(None)

    def test_one_that_cannot_be_made(self, tmp_path: Path) -> None:
        with pytest.raises(GuardError, match="cannot be made: No such file"):
            directory_for(tmp_path / "missing" / "named")


class TestAddress:
    def test_ros_variables(self) -> None:
        address = MasterAddress.of({"ROS_MASTER_URI": "http://localhost:11999"})
        assert (address.port, address.bind) == (11999, "0.0.0.0")
        assert address.own_uri == "http://127.0.0.1:11999/"
        assert MasterAddress.of({}, port=12000).uri == "http://localhost:12000/"
        assert MasterAddress.of({"ROS_HOSTNAME": "127.0.0.2"}).bind == "127.0.0.2"

    @pytest.mark.parametrize("uri", ["localhost:11311", "https://localhost", "http://:x"])
    def test_what_is_no_uri_is_refused(self, uri: str) -> None:
        with pytest.raises(GuardError, match="expected http://HOST:PORT"):
            MasterAddress.of({"ROS_MASTER_URI": uri})

    def test_a_master_of_another_machine_is_refused(self) -> None:
        with pytest.raises(GuardError, match="no address of this machine"):
            MasterAddress.of({"ROS_MASTER_URI": "http://192.0.2.1:11311"})
