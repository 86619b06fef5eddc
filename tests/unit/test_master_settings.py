"""The guard's lock and the master's address."""

from __future__ import annotations

import os

import pytest
from tests.ports import free_port

from ros1_master_guard.errors import GuardError
from ros1_master_guard.settings import MasterAddress, guard_lock


def test_a_second_guard_is_kept_away() -> None:
    port = free_port()
    with guard_lock(port):
        refused = pytest.raises(GuardError, match=f"has a guard already: process {os.getpid()}")
        with refused, guard_lock(port):
            pass
    with guard_lock(port):
        pass


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
