"""A robot and a service far from each other: which paths there are, and that nothing is changed."""

import subprocess
import sys
from typing import Any

import pytest

from holdfast.errors import InvalidValueError
from holdfast_lab.testbed.wide_area import lay_route, why_no_wide_area

WHY_NOT = why_no_wide_area()

SERVE = """
import socket, sys
with socket.create_server((sys.argv[1], int(sys.argv[2]))) as listener:
    print("listens", flush=True)
    connection, _ = listener.accept()
    with connection:
        while data := connection.recv(65536):
            connection.sendall(data)
"""
ASK = """
import hashlib, random, socket, sys, threading, time
sent = random.Random(1).randbytes(int(sys.argv[3]))
began = time.monotonic()
with socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=30) as connection:
    print(time.monotonic() - began)
    sending = threading.Thread(target=connection.sendall, args=(sent,))
    sending.start()
    got = b""
    while len(got) < len(sent):
        got += connection.recv(65536)
    sending.join()
print(got == sent)
"""


def test_the_same_machine_needs_no_path() -> None:
    with lay_route("tcp", 0.0, 0.0, "seed") as path:
        assert path.emulated_by == "nothing"
        assert path.listen == path.connect
        assert path.robot_prefix == path.service_prefix == ()
        assert path.carried_bytes is None


@pytest.mark.parametrize(
    ("transport", "way"), [("tcp", "tcp proxy"), ("tls", "tcp proxy"), ("udp", "datagram proxy")]
)
def test_where_no_networks_can_be_had_there_is_a_proxy(transport: Any, way: str) -> None:
    with lay_route(transport, 20.0, 0.01, "seed", packets=False) as path:
        assert path.emulated_by == way
        assert path.listen != path.connect
        assert path.connect.startswith(f"{transport}/127.0.0.1:")


@pytest.mark.parametrize(
    ("transport", "round_trip_ms", "loss", "message"),
    [
        ("quic", 20.0, 0.0, "transport 'quic': there are tcp, tls, udp"),
        ("tcp", -20.0, 0.0, "round_trip_ms -20.0: must be from 0 to 120000"),
        ("tcp", float("nan"), 0.0, "round_trip_ms nan: must be"),
        ("udp", 20.0, 1.01, r"loss 1.01: must be from 0 to 1"),
    ],
)
def test_what_is_out_of_bounds(
    transport: Any, round_trip_ms: float, loss: float, message: str
) -> None:
    with (
        pytest.raises(InvalidValueError, match=message),
        lay_route(transport, round_trip_ms, loss, "seed"),
    ):
        pass


@pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))
@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_a_stream_survives_delay_and_loss(loss: float) -> None:
    """The system's own TCP makes good what the line loses; and nothing is faster than the line."""
    with lay_route("tcp", 10.0, loss, "seed") as path:
        assert path.emulated_by == "packets"
        assert path.carried_bytes is not None
        before = path.carried_bytes()
        port = path.listen.rpartition(":")[2]
        with subprocess.Popen(
            [*path.service_prefix, sys.executable, "-c", SERVE, path.host, port],
            stdout=subprocess.PIPE,
        ) as service:
            try:
                assert service.stdout is not None
                assert service.stdout.readline() == b"listens\n"
                asked = subprocess.run(
                    [*path.robot_prefix, sys.executable, "-c", ASK, path.host, port, "60000"],
                    capture_output=True,
                    text=True,
                    timeout=60,
                )
            finally:
                service.kill()
        # There and back, and what was lost was sent again.
        assert path.carried_bytes() > before + 2 * 60_000
    assert asked.returncode == 0, asked.stderr
    took_s, same = asked.stdout.split()
    assert same == "True"
    assert float(took_s) >= 0.01
