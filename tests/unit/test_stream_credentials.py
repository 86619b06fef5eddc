"""Links whose certificates are revoked or expire: they end, and no others do."""

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from tests.processes.faults import PATIENT

from holdfast.errors import TransportError
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.transport.contract import IncomingCall
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.frames import (
    CALL,
    GOODBYE,
    FrameDecoder,
    encode_frame,
    encode_hello,
    read_goodbye,
)
from holdfast.transport.key_ring import make_credentials, revoke_credentials
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport
from holdfast.transport.tls import TlsStream, client_context

PATIENCE_S = 60.0
LEASE_MS = PATIENT["lease_ms"]
REVOKED = "has a certificate that has been revoked"
FOREIGN = "has a certificate of an authority that is no longer trusted"


async def until(condition: Callable[[], bool], what: object = None) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, what
        await asyncio.sleep(0.005)


class Ends(list[StreamRobotTransport | StreamServiceTransport]):
    async def close_on_loop(self) -> None:
        while self:
            await self.pop().close()


OPEN = Ends()


@pytest.fixture(autouse=True)
def ends() -> Ends:
    """Have what a test opens closed at its end, robots first."""
    return OPEN


class Robot:
    """A robot's end, and what it was told."""

    def __init__(self, directory: Path, endpoint: str) -> None:
        self.events: list[TransportEvent] = []
        self.refusals: list[str] = []
        self.transport = StreamRobotTransport(
            {"cloud": endpoint},
            lease_ms=LEASE_MS,
            tls=TlsFiles.of(directory),
            on_event=lambda _, **fields: self.refusals.append(fields["reason"]),
        )
        OPEN.append(self.transport)
        self.transport.start(self.events.append)

    @property
    def boots(self) -> list[str]:
        return [each.incarnation for each in self.events if isinstance(each, ServiceAppeared)]

    @property
    def vanished(self) -> list[str]:
        return [each.incarnation for each in self.events if isinstance(each, ServiceVanished)]

    @property
    def ended(self) -> list[int]:
        return [each.call for each in self.events if isinstance(each, CallEnded)]

    async def connected(self) -> None:
        await until(lambda: bool(self.boots), (self.events, self.refusals))

    async def ask(self, call: int) -> list[bytes]:
        self.transport.call("cloud", call, b"?")
        await until(lambda: call in self.ended, self.events)
        return [each.payload for each in self.events if isinstance(each, ReplyReceived)]


class Cloud:
    """A service's end that answers with the name of who asks."""

    def __init__(self, directory: Path, protocol: str = "tls") -> None:
        self.told: list[tuple[str, dict[str, object]]] = []
        self.held: list[IncomingCall] = []
        self.holds = False
        self.transport = StreamServiceTransport(
            "cloud",
            incarnation="b1",
            listen=[f"{protocol}/127.0.0.1:0"],
            lease_ms=LEASE_MS,
            tls=TlsFiles.of(directory),
            on_event=lambda name, **fields: self.told.append((name, fields)),
        )

    async def start(self) -> str:
        OPEN.append(self.transport)
        await self.transport.start(self._received)
        return self.transport.endpoints[0]

    def _received(self, call: IncomingCall) -> None:
        if self.holds:
            self.held.append(call)
            return
        self.answer(call)

    def answer(self, call: IncomingCall) -> None:
        call.reply(str(call.robot).encode())
        call.end()


async def test_a_revoked_robots_link_ends_and_no_other(tmp_path: Path) -> None:
    make_credentials(tmp_path, robots=["anna", "berta"], services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    endpoint = await cloud.start()
    anna, berta = (Robot(tmp_path / name, endpoint) for name in ("anna", "berta"))
    for robot, name in ((anna, b"anna"), (berta, b"berta")):
        await robot.connected()
        assert await robot.ask(1) == [name]
    cloud.holds = True
    for robot in (anna, berta):
        robot.transport.call("cloud", 2, b"?")
    await until(lambda: len(cloud.held) == 2)
    assert cloud.transport.reload_credentials() == 0, "nobody is revoked yet"
    revoke_credentials(tmp_path, names=["anna"])
    assert cloud.transport.reload_credentials() == 1
    await until(lambda: bool(anna.vanished), anna.events)
    assert 2 in anna.ended
    await until(lambda: f"refuses this end, which {REVOKED}" in anna.refusals, anna.refusals)
    # It is not let in again, and the log says who that was.
    await until(lambda: cloud.told[-1][0] == "link_refused", cloud.told)
    again = cloud.told[-1][1]
    assert (again["robot"], again["reason"]) == ("anna", REVOKED)
    assert len([name for name, _ in cloud.told if name == "robot_connected"]) == 2
    # The other one has its answer over the link over which it asked.
    for call in cloud.held:
        cloud.answer(call)
    await until(lambda: 2 in berta.ended)
    assert berta.boots == ["b1"]
    assert berta.refusals == []
    assert [each.payload for each in berta.events if isinstance(each, ReplyReceived)] == [
        b"berta"
    ] * 2
    told = [fields for name, fields in cloud.told if name == "robot_disconnected"]
    assert [(each["robot"], each["reason"]) for each in told] == [("anna", REVOKED)]


@contextlib.asynccontextmanager
async def shaken_hands(
    endpoint: str, credentials: Path
) -> AsyncIterator[tuple[socket.socket, TlsStream]]:
    """Connect as a robot does, up to its part of the handshake, which is not sent."""
    host, port = endpoint.partition("/")[2].rsplit(":", 1)
    loop = asyncio.get_running_loop()
    with socket.create_connection((host, int(port))) as connection:
        connection.setblocking(False)
        tls = TlsStream(client_context(TlsFiles.of(credentials)), host)
        tls.begin()
        await loop.sock_sendall(connection, tls.take())
        while not tls.established:
            tls.receive(await loop.sock_recv(connection, 65536))
        yield connection, tls


@pytest.mark.parametrize("protocol", ["tls", "udp"])
async def test_nothing_of_a_revoked_robot_is_handled(tmp_path: Path, protocol: str) -> None:
    """By a service that had the list when it began: no hello is answered, no keys are sent."""
    make_credentials(tmp_path, robots=["anna"], services=["cloud"])
    revoke_credentials(tmp_path, names=["anna"])
    cloud = Cloud(tmp_path / "cloud", protocol)
    cloud.holds = True
    endpoint = await cloud.start()
    loop = asyncio.get_running_loop()
    (tmp_path / "anna" / "revoked.pem").unlink()
    async with shaken_hands(endpoint, tmp_path / "anna") as (connection, tls):
        tls.send(encode_hello("robot", "anna", "0", LEASE_MS) + encode_frame(CALL, 1, b"?"))
        await loop.sock_sendall(connection, tls.take())
        told = b""
        while data := await loop.sock_recv(connection, 65536):
            told += tls.receive(data)
    (only,) = FrameDecoder(1000).feed(told)
    assert only.kind == GOODBYE
    assert read_goodbye(only.payload) == REVOKED
    ((name, fields),) = cloud.told
    assert (name, fields["robot"], fields["reason"]) == ("link_refused", "anna", REVOKED)
    assert cloud.held == []


async def test_a_rotated_robot_is_let_in_by_itself(tmp_path: Path) -> None:
    """Its new credentials are read when it tries again."""
    make_credentials(tmp_path, robots=["anna"], services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    anna = Robot(tmp_path / "anna", await cloud.start())
    await anna.connected()
    revoke_credentials(tmp_path, names=["anna"])
    cloud.transport.reload_credentials()
    await until(lambda: bool(anna.vanished), anna.events)
    make_credentials(tmp_path, robots=["anna"], rotate=True)
    await until(lambda: len(anna.boots) == 2, (anna.events, anna.refusals))
    assert await anna.ask(1) == [b"anna"]


async def test_a_robot_believes_no_service_that_is_revoked(tmp_path: Path) -> None:
    make_credentials(tmp_path, robots=["anna"], services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    endpoint = await cloud.start()
    first = Robot(tmp_path / "anna", endpoint)
    await first.connected()
    revoke_credentials(tmp_path, names=["cloud"])
    # The robot has the list now; the thief who has the service's key has none.
    (tmp_path / "cloud" / "revoked.pem").unlink()
    second = Robot(tmp_path / "anna", endpoint)
    wanted = f"{REVOKED}; 'holdfast keys DIR --rotate --service NAME' makes a new key"
    await until(lambda: wanted in second.refusals, second.refusals)
    assert second.boots == []
    # One that runs already finds the list when it connects again.
    cloud.transport.end_links(lambda _: "is to come again")
    await until(lambda: wanted in first.refusals, first.refusals)
    assert first.boots == ["b1"]


def put(directory: Path, other: Path, *, believing: list[Path]) -> None:
    """Give a service other credentials, and the authorities of these directories."""
    for name in ("certificate.pem", "key.pem"):
        (directory / name).write_bytes((other / name).read_bytes())
    authorities = [(each / "authority.pem").read_bytes() for each in believing]
    (directory / "authority.pem").write_bytes(b"".join(authorities))


async def test_links_end_whose_authority_is_replaced_and_no_others(tmp_path: Path) -> None:
    old, new, cloud_directory = (tmp_path / name for name in ("old", "new", "cloud"))
    make_credentials(old, robots=["anna"], services=["cloud"])
    make_credentials(new, robots=["berta"], services=["cloud"])
    cloud_directory.mkdir()
    put(cloud_directory, old / "cloud", believing=[old / "cloud"])
    cloud = Cloud(cloud_directory)
    endpoint = await cloud.start()
    anna = Robot(old / "anna", endpoint)
    await anna.connected()
    # Both are believed while robots move from one to the other.
    put(cloud_directory, new / "cloud", believing=[old / "cloud", new / "cloud"])
    assert cloud.transport.reload_credentials() == 0
    berta = Robot(new / "berta", endpoint)
    await berta.connected()
    put(cloud_directory, new / "cloud", believing=[new / "cloud"])
    assert cloud.transport.reload_credentials() == 1
    await until(lambda: f"refuses this end, which {FOREIGN}" in anna.refusals, anna.refusals)
    assert anna.vanished == anna.boots == ["b1"]
    assert await berta.ask(1) == [b"berta"]
    assert berta.boots == ["b1"]
    told = [fields for name, fields in cloud.told if name == "robot_disconnected"]
    assert [(each["robot"], each["reason"]) for each in told] == [("anna", FOREIGN)]


async def test_who_has_shown_a_certificate_and_said_no_hello_is_ended_with_the_others(
    tmp_path: Path,
) -> None:
    make_credentials(tmp_path, robots=["anna", "berta"], services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    endpoint = await cloud.start()
    loop = asyncio.get_running_loop()
    async with (
        shaken_hands(endpoint, tmp_path / "anna") as (connection, tls),
        shaken_hands(endpoint, tmp_path / "berta") as (other, other_tls),
    ):
        for each, its_tls in ((connection, tls), (other, other_tls)):
            await loop.sock_sendall(each, its_tls.take())
        waiting = cloud.transport._without_hello
        await until(lambda: [link.peer is not None for link in waiting] == [True, True])
        revoke_credentials(tmp_path, names=["anna"])
        assert cloud.transport.reload_credentials() == 1
        told = b""
        while data := await loop.sock_recv(connection, 65536):
            told += tls.receive(data)
        (last,) = FrameDecoder(1000).feed(told)
        assert read_goodbye(last.payload) == REVOKED
        assert [link.peer.name for link in waiting if link.peer] == ["berta"]


@pytest.mark.parametrize("reason", [REVOKED, FOREIGN])
async def test_who_shook_hands_before_the_files_came_is_not_let_in_after_them(
    tmp_path: Path, reason: str
) -> None:
    make_credentials(tmp_path, robots=["anna"], services=["cloud"])
    make_credentials(tmp_path / "other", services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    endpoint = await cloud.start()
    loop = asyncio.get_running_loop()
    async with shaken_hands(endpoint, tmp_path / "anna") as (connection, tls):
        if reason == REVOKED:
            revoke_credentials(tmp_path, names=["anna"])
        else:
            other = tmp_path / "other" / "cloud"
            put(tmp_path / "cloud", other, believing=[other])
        assert cloud.transport.reload_credentials() == 0, "it has not shown a certificate yet"
        tls.send(encode_hello("robot", "anna", "0", LEASE_MS))
        await loop.sock_sendall(connection, tls.take())
        told = b""
        while data := await loop.sock_recv(connection, 65536):
            told += tls.receive(data)
    last = list(FrameDecoder(1000).feed(told))[-1]
    assert last.kind == GOODBYE
    assert read_goodbye(last.payload) == reason
    assert [name for name, _ in cloud.told] == ["link_refused"]


async def test_credentials_that_cannot_be_read_leave_those_of_before(tmp_path: Path) -> None:
    make_credentials(tmp_path, robots=["anna"], services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    endpoint = await cloud.start()
    for name in ("revoked.pem", "key.pem"):
        (tmp_path / "cloud" / name).write_bytes(b"half a fi")
        with pytest.raises(TransportError, match=r"is no private key|revoked"):
            cloud.transport.reload_credentials()
        (tmp_path / "cloud" / name).unlink()
    anna = Robot(tmp_path / "anna", endpoint)
    await anna.connected()


async def test_files_of_a_robot_that_do_not_belong_together_leave_those_of_before(
    tmp_path: Path,
) -> None:
    make_credentials(tmp_path, robots=["anna", "berta"], services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    anna = Robot(tmp_path / "anna", await cloud.start())
    await anna.connected()
    (tmp_path / "anna" / "key.pem").write_bytes((tmp_path / "berta" / "key.pem").read_bytes())
    cloud.transport.end_links(lambda _: "is to come again")
    await until(lambda: len(anna.boots) == 2, (anna.events, anna.refusals))
    (told,) = [each for each in anna.refusals if "key.pem: is not the key of " in each]
    assert told.endswith("certificate.pem; the previous ones stay in use")
    assert await anna.ask(1) == [b"anna"]


def short_lived(directory: Path, seconds: float, **names: list[str]) -> None:
    """Make credentials that expire in a few seconds."""
    end = datetime.now(UTC) + timedelta(seconds=seconds)
    make_credentials(directory, days=1, now=end - timedelta(days=1), **names)  # type: ignore[arg-type]


async def test_a_robots_link_ends_when_its_certificate_expires(tmp_path: Path) -> None:
    make_credentials(tmp_path, robots=["berta"], services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    endpoint = await cloud.start()
    await (berta := Robot(tmp_path / "berta", endpoint)).connected()
    short_lived(tmp_path, 6.0, robots=["anna"])
    await (anna := Robot(tmp_path / "anna", endpoint)).connected()
    await until(lambda: bool(anna.vanished), anna.events)
    why = "refuses this end, which has a certificate that has expired"
    await until(lambda: why in anna.refusals, anna.refusals)
    assert anna.boots == ["b1"]
    assert berta.boots == ["b1"]
    assert not berta.vanished


async def test_a_robot_leaves_a_service_whose_certificate_expires(tmp_path: Path) -> None:
    make_credentials(tmp_path, robots=["anna"])
    short_lived(tmp_path, 6.0, services=["cloud"])
    cloud = Cloud(tmp_path / "cloud")
    anna = Robot(tmp_path / "anna", await cloud.start())
    await anna.connected()
    await until(lambda: bool(anna.vanished), anna.events)
    assert "has a certificate that has expired" in anna.refusals
