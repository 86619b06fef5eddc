"""The service's end: whose certificate it believes, and whose links it ends."""

import asyncio
import contextlib
import ssl
from pathlib import Path

import pytest
from tests.contracts import wires

from holdfast.protocol.robot_events import CallEnded, ServiceAppeared, ServiceVanished
from holdfast.transport import service_end
from holdfast.transport.contract import IncomingCall
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.tls import client_context


class TestEndedLinks:
    async def test_open_calls_are_told_and_others_are_not(self, tcp: wires.StreamWire) -> None:
        told: list[bytes] = []

        def serve(call: IncomingCall) -> None:
            call.on_gone = lambda: told.append(call.payload)
            if call.payload == b"answered":
                call.end()

        await tcp.service("cloud", "b1").start(serve)
        robot, inbox = await wires.joined(tcp)
        robot.call("cloud", 1, b"answered")
        assert await inbox.of_call(1) == [CallEnded(1)]
        robot.call("cloud", 2, b"open")
        await robot.close()
        await wires.until(lambda: bool(told))
        assert told == [b"open"]


class TestCertificates:
    async def test_who_shows_no_certificate_sees_nothing(
        self, tls: wires.StreamWire, robot_tls: TlsFiles
    ) -> None:
        """What else is not believed: unit/test_transport_credentials.py."""
        received = wires.Received()
        await tls.service("cloud", "b1").start(received)
        bare = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        bare.load_verify_locations(robot_tls.authority)
        host, _, port = tls.endpoint("cloud").removeprefix("tls/").rpartition(":")
        with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
            reader, writer = await asyncio.open_connection(host, int(port), ssl=bare)
            writer.write(wires.HELLO)
            await reader.read()
        writer.close()
        with contextlib.suppress(ssl.SSLError):
            await writer.wait_closed()
        robot, _ = await wires.joined(tls)
        robot.call("cloud", 1, b"friend")
        assert (await received.next()).payload == b"friend"
        assert set(tls.reasons()) == {"shows no certificate"}

    async def test_a_robot_has_the_name_of_its_certificate_or_tells_none(
        self, tls: wires.StreamWire
    ) -> None:
        await tls.service("cloud", "b1").start(wires.echo)
        for name in ("robot", ""):
            robot, inbox = tls.robot("cloud", name=name), wires.Inbox()
            robot.start(inbox)
            await inbox.appeared()
        robot, inbox = tls.robot("cloud", name="another"), wires.Inbox()
        robot.start(inbox)
        await wires.until(lambda: bool(tls.refusals) and bool(tls.reasons()))
        reason = "says that it is another, and shows the certificate of robot"
        assert tls.refusals[0] == ("cloud", f"refuses this end, which {reason}")
        assert tls.reasons()[0] == reason

    async def test_an_old_version_of_tls_is_refused(self, tls: wires.StreamWire) -> None:
        await tls.service("cloud", "b1").start(wires.echo)
        assert tls.robot_tls is not None
        context = client_context(tls.robot_tls)
        context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_2
        host, _, port = tls.endpoint("cloud").removeprefix("tls/").rpartition(":")
        with pytest.raises(ssl.SSLError, match="PROTOCOL_VERSION"):
            await asyncio.open_connection(host, int(port), ssl=context)

    @pytest.mark.parametrize("group", ["ffdhe8192", "secp521r1"])
    async def test_nobody_chooses_a_key_exchange_that_takes_long(
        self, tls: wires.StreamWire, group: str
    ) -> None:
        await tls.service("cloud", "b1").start(wires.echo)
        assert tls.robot_tls is not None
        context = client_context(tls.robot_tls)
        context.set_ecdh_curve(group)
        host, _, port = tls.endpoint("cloud").removeprefix("tls/").rpartition(":")
        with pytest.raises(ssl.SSLError, match="HANDSHAKE_FAILURE"):
            await asyncio.open_connection(host, int(port), ssl=context)

    async def test_a_call_names_the_robot_s_certificate(
        self, tls: wires.StreamWire, tcp: wires.StreamWire
    ) -> None:
        for wire, name in ((tls, "robot"), (tcp, None)):
            calls = wires.Received()
            robot, _, _ = await wires.connected(wire, calls)
            robot.call("cloud", 1, b"")
            assert (await calls.next()).robot == name

    async def test_links_of_one_certificate_keep_no_other_out(
        self, tls: wires.StreamWire, keys: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(service_end, "MAX_LINKS", 3)
        await tls.service("cloud", "b1").start(wires.echo)
        greedy = [(tls.robot("cloud"), wires.Inbox()) for _ in range(3)]
        for robot, inbox in greedy:
            robot.start(inbox)
            await inbox.wait_for(ServiceAppeared("cloud", "b1"))
        tls.robot_tls = TlsFiles.of(keys / "another")
        other, other_inbox = await wires.joined(tls)
        reason = "has 3 links, and another robot needs one of 3"
        await wires.until(
            lambda: tls.refusals[:1] == [("cloud", f"refuses this end, which {reason}")]
        )
        full = "refuses this end, which is one too many: 3 robots are connected"
        await wires.until(lambda: ("cloud", full) in tls.refusals)  # as it is back
        await wires.answers(other, other_inbox, 1)
        assert ServiceVanished("cloud", "b1") not in other_inbox

    async def test_a_robot_can_be_closed_amid_a_handshake(self, tls: wires.StreamWire) -> None:
        host, _, port = tls.endpoint("cloud").removeprefix("tls/").rpartition(":")
        heard = asyncio.Event()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readexactly(1)
            heard.set()
            await reader.read()
            writer.close()

        async with await asyncio.start_server(serve, host, int(port)):
            robot, inbox = tls.robot("cloud"), wires.Inbox()
            robot.start(inbox)
            await asyncio.wait_for(heard.wait(), wires.PATIENCE_S)
            await robot.close()
        assert inbox.events == []
