"""docs/datagrams.md: its test vectors and limits are the code's."""

import os
import re
from pathlib import Path

import pytest

from holdfast.transport import datagram_cipher, datagram_links, exchanges, redundancy, return_path
from holdfast.transport.datagram_cipher import AssociationKeys, DatagramCipher
from holdfast.transport.exchanges import RobotExchange, ServiceExchange
from holdfast.transport.redundancy import Paths
from holdfast.transport.return_path import ReturnPath

PAGE = (Path(__file__).parents[2] / "docs" / "datagrams.md").read_text(encoding="utf-8")
VECTORS = re.findall(
    r"^\| (robot|service) \| (\d+) \| (.+) \| `([0-9a-f]+)` \| `([0-9a-f]+)` \|$", PAGE, re.M
)


def keys() -> AssociationKeys:
    found = re.findall(r"^(?:association|key to service|key to robot) +([0-9a-f]+)$", PAGE, re.M)
    association, to_service, to_robot = map(bytes.fromhex, found)
    return AssociationKeys(int.from_bytes(association), to_service, to_robot)


def test_each_end_makes_the_datagrams_and_takes_those_of_the_other() -> None:
    assert len(VECTORS) == 8
    ends = {end: DatagramCipher(keys(), service=end == "service") for end in ("robot", "service")}
    others = {"robot": ends["service"], "service": ends["robot"]}
    for end, counter, _, message, datagram in VECTORS:
        assert datagram[8:16] == f"{int(counter):08x}"
        assert ends[end].encrypt(bytes.fromhex(message)).hex() == datagram
        assert others[end].decrypt(bytes.fromhex(datagram)) == bytes.fromhex(message)
        assert others[end].decrypt(bytes.fromhex(datagram)) is None


def test_the_messages_are_those_of_a_conversation(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[tuple[str, str]] = []
    robot = RobotExchange(_paths("robot", said, lost=1))
    service = ServiceExchange(_paths("service", said, lost=0))

    def newest() -> bytes:
        return bytes.fromhex(said[-1][1])

    monkeypatch.setattr(os, "urandom", lambda size: bytes(range(0xA1, 0xA1 + size)))
    robot.begin(1.5)
    first = newest()
    (probe,) = ReturnPath().heard("where the robot is", 1.5, newest=True)
    said.append(("service", (bytes((exchanges.PROBE, 0)) + probe.secret).hex()))
    assert robot.received(newest(), 1.6, datagram=True) == []
    assert not robot.open  # nothing shows yet that replies come
    service.received(first, datagram=True)
    robot.received(newest(), 1.6, datagram=True)
    robot.send(9, b"what next?", 2.0)
    asked = newest()
    request = service.received(asked, datagram=True)
    assert request is not None
    assert service.received(asked, datagram=True) is None
    service.reply(request.number, b"go on", 2.0, last=False)
    service.reply(request.number, b"look", 2.0, last=True)
    assert said == [(end, message) for end, _, _, message, _ in VECTORS]


def _paths(end: str, said: list[tuple[str, str]], *, lost: int) -> Paths:
    def say(message: bytes) -> None:
        said.append((end, message.hex()))

    return Paths(say, lambda _, message: say(message), lambda: lost)


def test_limits() -> None:
    limits = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", PAGE[PAGE.index("## Limits") :], re.M))
    first_probes = datagram_cipher.KNOWN_AFTER + exchanges._NEWEST
    assert limits == {
        "limit": "value",
        "a datagram": f"{exchanges.MAX_DATAGRAM_BYTES:,} bytes",
        "a payload; longer ones go on the stream": f"{exchanges.MAX_PAYLOAD_BYTES:,} bytes",
        "datagrams of one key; then the link ends": f"{datagram_cipher.MAX_DATAGRAMS:,}",
        "the window": f"{datagram_cipher.WINDOW:,} counters",
        "repetitions and copies": (
            "two bytes for each byte sent once, plus "
            f"{redundancy._EXTRA_BURST_BYTES * redundancy._EXTRA_SHARE // 2:,}"
        ),
        "requests of a robot whose replies are kept; replies that came out of order": (
            f"{exchanges.MAX_CACHED_REQUESTS:,}; {exchanges.MAX_REORDERED_BYTES >> 20} MiB"
        ),
        "messages of a link that wait for their turn; dropped ones, after which the link ends": (
            f"{datagram_links._MAX_BACKLOG}; {datagram_links._MAX_DROPPED:,}"
        ),
        "probes of the robot: while none is answered": (
            f"{first_probes} at first, {1e3 * exchanges._FIRST_PROBE_INTERVAL_S:g} ms apart, "
            f"then doubled pauses up to {exchanges.MAX_TIMEOUT_S:g} s"
        ),
        "probes of the robot: while nothing else is sent": "3 in its lease",
        "probes of the service": f"{1 / return_path._PROBE_INTERVAL_S:g} a second",
    }
