"""Can this robot use that service, and if not, why? A check layer by layer, from below.

Each layer needs those below it: without an address there is no connection, and a service with a
wrong certificate is asked nothing. So the check stops at the first layer that fails. It uses a
robot's own links and messages, has a time limit for each layer, and follows each address of a host
on its own.

The last layers send a robot's requests and compare the answers, bit for bit, with those of the
robot's own planner.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import ssl
import statistics
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from functools import partial
from itertools import count
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from holdfast.config.settings import OffloadSettings
from holdfast.errors import HoldfastError
from holdfast.planning import digest
from holdfast.printable import printable
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    PROTOCOL_VERSION,
    Busy,
    NeedState,
    Refused,
    Reply,
    Request,
    SessionConfiguration,
)
from holdfast.robot.probe import (
    CLOSES_AT_TLS,
    AddressPath,
    WatchedTls,
    account_of,
    certificate_at,
    in_thread,
    interface_of,
)
from holdfast.robot.reference_decisions import ReferenceDecisions, ReferenceTurn
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES
from holdfast.transport.credentials import (
    EXPIRES_SOON_DAYS,
    date_text,
    load_credentials,
)
from holdfast.transport.datagram_cipher import require_cryptography
from holdfast.transport.endpoints import (
    Endpoint,
    TlsFiles,
    check_credentials,
    check_endpoint,
    system_words,
)
from holdfast.transport.exchanges import MAX_DATAGRAM_BYTES
from holdfast.transport.frames import encode_hello
from holdfast.transport.link_settings import LinkSettings
from holdfast.transport.tls import client_context

__all__ = [
    "FAILS",
    "NOT_REACHED",
    "OK",
    "WARNS",
    "LayerFinding",
    "RobotSetup",
    "check",
    "examine",
]

OK: Final = "ok"
WARNS: Final = "warns"
FAILS: Final = "fails"
NOT_REACHED: Final = "-"

_NAME_S: Final = 3.0
_CONNECT_S: Final = 2.0
_REPLY_S: Final = 2.0
_DATAGRAMS_S: Final = 1.5
_DECISION_S: Final = 4.0
_ALL_S: Final = 10.0

_ECHOES: Final = 20
_CLOCKS_APART_S: Final = 60.0
_DATAGRAM_HEADERS_BYTES: Final = 48
"""Of IPv6 and UDP."""

_IP_MTU: Final = {
    socket.AF_INET: (socket.IPPROTO_IP, 14),
    socket.AF_INET6: (socket.IPPROTO_IPV6, 24),
}
"""Linux's options that tell the MTU of a connected socket's route."""

_LEASE_MS: Final = 30_000.0
"""The robot may be silent for so long; it never is."""

_NO_TLS: Final = "is it at tcp/..., another program, or a process that is stopped?"
_NO_HOLDFAST: Final = "is it another program, at tls/... or udp/..., or a process that is stopped?"
_DISTRUST: Final = "do not use it before you know why (docs/trust.md)"
_OPEN_IT: Final = "let it through the firewalls on the way, or mend the VPN"


class LayerFinding(NamedTuple):
    """The result of one layer, at one address or at all of them."""

    layer: str
    state: str
    """:data:`OK`, :data:`WARNS` (works, with a problem), :data:`FAILS` or :data:`NOT_REACHED`."""
    seen: str
    advice: str = ""
    """What to do, if anything."""
    address: str = ""
    """If the host has several."""


class RobotSetup(NamedTuple):
    """The robot whose link to a service is checked."""

    name: str
    """May be empty."""
    tls: Path | None
    """Directory of its credentials."""
    offload: OffloadSettings
    """The robot's limits on time."""
    decisions: Future[ReferenceDecisions] | None
    """What the service's answers are compared with; None asks for none."""


def check(service: str, tls: Path | None) -> Endpoint:
    """Read an endpoint of a service.

    Raises
    ------
    TransportError
        If it is none, or credentials are given that it does not use.
    """
    endpoint = check_endpoint(service, "robot", listens=False)
    if not endpoint.is_encrypted and tls is not None:
        check_credentials(endpoint, TlsFiles.of(tls))
    if endpoint.protocol == "udp":
        require_cryptography()
    return endpoint


async def examine(
    endpoint: Endpoint, robot: RobotSetup, tell: Callable[[LayerFinding], None]
) -> None:
    """Check all layers between this robot and a service; ``tell`` gets each finding at once."""
    await _Examination(endpoint, robot, tell).run()


class _Seen(NamedTuple):
    """What the check of a layer at one address has found."""

    text: str
    advice: str = ""
    state: str = ""
    """If empty: :data:`OK`, or :data:`WARNS` if there is advice."""
    goes_on: bool = False
    """Whether the layers above a failed one are checked nevertheless."""


_Look: TypeAlias = Callable[[AddressPath], Awaitable[_Seen | None]]
"""Checks a layer; None if another path did."""


def _fails(text: str, advice: str = "", *, goes_on: bool = False) -> _Seen:
    return _Seen(text, advice, FAILS, goes_on)


class _Examination:
    def __init__(
        self, endpoint: Endpoint, robot: RobotSetup, tell: Callable[[LayerFinding], None]
    ) -> None:
        self._endpoint = endpoint
        self._robot = robot
        self._report = tell
        self._layer = "name"
        self._paths: list[AddressPath] = []
        self._numbers = count(1)
        self._context: ssl.SSLContext | None = None
        self._ours = self._ours_advice = ""
        self._decision_s: tuple[float, float] | None = None
        self._settings = LinkSettings(
            partial(encode_hello, "robot", robot.name, os.urandom(8).hex(), _LEASE_MS),
            _LEASE_MS,
            DEFAULT_MAX_MESSAGE_BYTES,
            pauses_for_readers=False,
        )

    async def run(self) -> None:
        layers: dict[str, _Look] = {
            "route": self._route,
            "port": self._port,
            "tls": self._tls,
            "certificate": self._certificate,
            "protocol": self._protocol,
            "datagrams": self._datagrams,
            "clock": self._clock,
            "problem": self._problem,
            "round trip": self._round_trip,
        }
        if self._endpoint.is_local_socket:
            del layers["route"]
        if self._endpoint.is_encrypted:
            self._read_own()
        else:
            del layers["certificate"]
        if self._endpoint.protocol != "udp":
            del layers["datagrams"]
        try:
            async with asyncio.timeout(_ALL_S):
                self._paths = going_on = await self._name()
                for self._layer, look in layers.items():
                    if going_on:
                        follow = (self._follow(each, look) for each in going_on)
                        went = await asyncio.gather(*follow)
                        going_on = [each for each, on in zip(going_on, went, strict=True) if on]
                    else:
                        now = f"; it is {date_text(time.time())} here"
                        seen = f"not reached{now if self._layer == 'clock' else ''}"
                        self._tell(NOT_REACHED, seen)
        except TimeoutError:
            self._tell(FAILS, f"all together was not finished within {_ALL_S:g} s")
        finally:
            for path in self._paths:
                path.close()

    async def _follow(self, path: AddressPath, look: _Look) -> bool:
        """Check one layer at one address; return whether to check those above."""
        address = path.text if len(self._paths) > 1 else ""
        seen = await look(path)
        if seen is None:
            return True
        state = seen.state or (WARNS if seen.advice else OK)
        self._tell(state, seen.text, seen.advice, address)
        return seen.goes_on or state != FAILS

    def _tell(self, state: str, seen: str, advice: str = "", address: str = "") -> None:
        self._report(LayerFinding(self._layer, state, printable(seen), printable(advice), address))

    # -- the layers, from below ------------------------------------------------------------------

    async def _name(self) -> list[AddressPath]:
        host, port = self._endpoint.host, self._endpoint.port
        if self._endpoint.is_local_socket:
            if Path(host).is_socket():
                self._tell(OK, "a socket of this machine")
                return [AddressPath(socket.AF_UNIX, host, host)]
            seen = "is no socket" if Path(host).exists() else "is not there"
            self._tell(FAILS, f"{host} {seen}", "start the service that listens there")
            return []
        look_up = partial(socket.getaddrinfo, host, port, type=socket.SOCK_STREAM)
        try:
            found = await asyncio.wait_for(asyncio.wrap_future(in_thread(look_up)), _NAME_S)
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or f"no answer within {_NAME_S:g} s"
            advice = "is it spelled right, and the name server reached? /etc/hosts may name it too"
            self._tell(FAILS, f"{host} is not found: {why}", advice)
            return []
        paths = [AddressPath(entry[0], entry[4], str(entry[4][0])) for entry in found]
        listed = ", ".join(path.text for path in paths)
        self._tell(OK, f"{host} is {'an address' if listed == host else listed}")
        return paths

    async def _route(self, path: AddressPath) -> _Seen:
        with socket.socket(path.family, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(path.address)
            except OSError as error:
                return _fails(
                    f"no way there: {system_words(error.errno)}",
                    "is the network up, and the VPN? 'ip route' lists what there is",
                )
            local = str(probe.getsockname()[0])
            mtu = probe.getsockopt(*_IP_MTU[path.family])
        least = MAX_DATAGRAM_BYTES + _DATAGRAM_HEADERS_BYTES
        short = self._endpoint.protocol == "udp" and mtu < least
        cut = f"datagrams of up to {least} bytes are cut to pieces: raise the MTU, or use tls/..."
        return _Seen(f"from {local} ({interface_of(local)}MTU {mtu})", cut if short else "")

    async def _port(self, path: AddressPath) -> _Seen:
        endpoint = self._endpoint
        what = "the socket" if endpoint.is_local_socket else f"TCP port {endpoint.port}"
        path.stream = stream = socket.socket(path.family, socket.SOCK_STREAM)
        stream.setblocking(False)
        try:
            async with asyncio.timeout(_CONNECT_S):
                await asyncio.get_running_loop().sock_connect(stream, path.address)
        except TimeoutError:
            advice = f"is the machine on, and the port right? {_OPEN_IT}"
            return _fails(f"{what}: nothing answers within {_CONNECT_S:g} s", advice)
        except ConnectionRefusedError:
            own = endpoint.is_local_socket or endpoint.is_loopback
            at = endpoint if own else f"{endpoint.protocol}/0.0.0.0:{endpoint.port}"
            advice = f"start the service there: holdfast serve --listen {at}"
            return _fails(f"{what}: refused, nothing listens there", advice)
        except OSError as error:
            return _fails(f"{what}: {system_words(error.errno)}", _OPEN_IT)
        return _Seen(f"{what} is open")

    def _read_own(self) -> None:
        robot = self._robot
        if robot.tls is None:
            self._ours = "none was given"
            self._ours_advice = "'holdfast keys DIR' makes them; give this robot's with --tls DIR"
            return
        warnings: list[str] = []
        try:
            own = load_credentials(robot.tls, "robot", warn=warnings.append)
            self._context = client_context(own.files)
        except HoldfastError as error:
            self._ours = str(error)
            return
        self._ours = f"{own.name}, {_until(own.expires_s)}"
        self._ours_advice = "; ".join(warnings)

    async def _tls(self, path: AddressPath) -> _Seen:
        endpoint = self._endpoint
        tls = None
        if endpoint.is_encrypted:
            if self._context is None:
                _, why_not = await certificate_at(path)
                if why_not:
                    return _fails(why_not, _NO_TLS)
                return _Seen("TLS 1.3")
            tls = path.tls = WatchedTls(self._context, endpoint.host)
        await path.greet(self._settings, endpoint, tls)
        if tls is None:
            none = f"none, as {endpoint.protocol}/... has: "
            if endpoint.is_loopback:
                return _Seen(f"{none}only this machine can connect")
            advice = "use tls/... or udp/... with credentials ('holdfast keys DIR' makes them)"
            return _Seen(f"{none}whoever is on the way can read along, and answer", advice)
        if not tls.established and not isinstance(tls.error, ssl.SSLCertVerificationError):
            return _fails(path.why_not or CLOSES_AT_TLS, _NO_TLS)
        return _Seen("TLS 1.3")

    async def _certificate(self, path: AddressPath) -> _Seen:
        ours = f"ours: {self._ours}"
        tls, link = path.tls, path.link
        if tls is None or link is None:
            return _fails(ours, self._ours_advice)
        if not tls.established:
            shown, _ = await certificate_at(path)
            fault = path.why_not.removeprefix("has a certificate that ")
            return _fails(f"theirs: {fault}", account_of(shown))
        if link.hello is None and "certificate" in path.why_not:
            return _fails(f"{ours}: {path.why_not}")
        if link.peer is None:
            return _fails(f"theirs: {path.why_not}")
        ends, advice = link.peer.expires_at, [self._ours_advice] * bool(self._ours_advice)
        if ends < time.time() + 86_400.0 * EXPIRES_SOON_DAYS:
            renew = f"'holdfast keys DIR --renew --service {link.peer.name}'"
            advice.append(f"the service's ends soon: {renew} makes another")
        theirs = f"theirs: {link.peer.name}, {_until(ends)}, for {tls.hosts()}"
        return _Seen(f"{ours}; {theirs}", "; ".join(advice))

    async def _protocol(self, path: AddressPath) -> _Seen:
        hello = None if path.link is None else path.link.hello
        if hello is None:
            reason = path.why_not or "closes the connection without a hello"
            return _fails(reason, "" if "install" in reason or "--tls" in reason else _NO_HOLDFAST)
        try:
            replies = await path.ask(self._echo(), _REPLY_S)
        except TimeoutError:
            advice = "its process stands still, or has far too much to do"
            return _fails(f"has not answered within {_REPLY_S:g} s", advice)
        except HoldfastError as error:
            return _fails(str(error))
        for reply in replies:
            if isinstance(reply, Refused):
                advice = "install the same release at both ends"
                return _fails(f"{reply.code}: {reply.text}", advice)
        seen = f"{hello.name}, holdfast {hello.release}, messages of version {PROTOCOL_VERSION}"
        return _Seen(seen)

    async def _datagrams(self, path: AddressPath) -> _Seen:
        assert path.link is not None
        try:
            async with asyncio.timeout(_DATAGRAMS_S):
                while not path.link.sends_datagrams:
                    await asyncio.sleep(0.005)
        except TimeoutError:
            seen = f"none gets through within {_DATAGRAMS_S:g} s, so everything goes on TLS"
            advice = f"UDP port {self._endpoint.port}: {_OPEN_IT}"
            return _fails(seen, advice, goes_on=True)
        return _Seen("get through in both directions")

    async def _clock(self, path: AddressPath) -> _Seen:
        ahead_s = path.clock_ahead_s
        now = f"it is {date_text(time.time())} here"
        if ahead_s is None:
            return _Seen(f"the service does not tell its own; {now}", state=NOT_REACHED)
        size = f"{abs(ahead_s):.0f} s" if abs(ahead_s) >= 1.0 else "less than a second"
        if abs(ahead_s) < _CLOCKS_APART_S:
            return _Seen(f"{size} from the service's")
        advice = "set both ('timedatectl' tells whether they are): certificates are judged by them"
        where = "ahead of" if ahead_s > 0 else "behind"
        return _Seen(f"{size} {where} the service's; {now}", advice)

    async def _problem(self, path: AddressPath) -> _Seen | None:
        if path is not next((each for each in self._paths if each.is_greeted), path):
            return None
        decisions = self._robot.decisions
        if decisions is None:
            seen = "not asked: with CONFIG, decisions are compared"
            return _Seen(seen, state=NOT_REACHED)
        try:
            own = await asyncio.wait_for(asyncio.wrap_future(decisions), _DECISION_S)
        except TimeoutError:
            seen = f"not asked: two decisions take longer than {_DECISION_S:g} s here"
            return _Seen(seen, state=NOT_REACHED)
        except HoldfastError as error:
            return _fails(f"this robot's own planner fails: {error}", goes_on=True)
        session, took_s = os.urandom(16), 0.0
        for turn in own.turns:
            session_configuration = None if turn.observations else own.session_configuration
            began = time.perf_counter()
            try:
                async with asyncio.timeout(_DECISION_S):
                    replies = await self._decided(path, session, turn, session_configuration)
            except TimeoutError:
                advice = "it is too slow for this problem, or has too much to do"
                seen = f"no decision within {_DECISION_S:g} s"
                return _fails(seen, advice, goes_on=True)
            except HoldfastError as error:
                return _fails(str(error), goes_on=True)
            took_s = time.perf_counter() - began
            if (fault := _fault_of(replies, turn)) is not None:
                return fault
        self._decision_s = took_s, own.turns[-1].took_s
        problem = own.session_configuration.problem
        seen = f"{problem}: the same code and settings; {len(own.turns)} decisions are"
        return _Seen(f"{seen} the robot's own, bit for bit")

    async def _decided(
        self,
        path: AddressPath,
        session: bytes,
        turn: ReferenceTurn,
        session_configuration: SessionConfiguration | None,
    ) -> list[Reply]:
        while True:
            state = turn.state
            request = Request(
                PROTOCOL_VERSION,
                session,
                1,
                next(self._numbers),
                state.trial,
                state.step,
                state.sensed,
                digest(state)[:DIGEST_SIZE],
                turn.observations,
                session_configuration,
            )
            replies = await path.ask(request, _DECISION_S)
            busy = next((reply for reply in replies if isinstance(reply, Busy)), None)
            if busy is None:
                return replies
            await asyncio.sleep(1e-3 * busy.retry_after_ms)

    async def _round_trip(self, path: AddressPath) -> _Seen:
        assert path.link is not None and path.link.hello is not None
        took_ms: list[float] = []
        with contextlib.suppress(TimeoutError, HoldfastError):
            async with asyncio.timeout(_REPLY_S):
                while len(took_ms) < _ECHOES:
                    began = time.perf_counter()
                    await path.ask(self._echo(), _REPLY_S)
                    took_ms.append(1e3 * (time.perf_counter() - began))
        if not took_ms:
            return _fails(f"no echo within {_REPLY_S:g} s", "its process stands still")
        worst_ms = max(took_ms)
        seen = f"{len(took_ms)} echoes: median {statistics.median(took_ms):.1f} ms, "
        seen += f"worst {worst_ms:.1f} ms"
        if self._decision_s is not None:
            there_s, here_s = self._decision_s
            seen += f"; a decision {1e3 * there_s:.1f} ms, here {1e3 * here_s:.1f} ms"
        offload = self._robot.offload
        limits_ms = {
            "--lease-ms of the service": path.link.hello.lease_ms,
            "offload.lease_ms": offload.lease_ms,
            "offload.detection_timeout_ms": offload.detection_timeout_ms,
        }
        advice = [
            f"{key}, {limit_ms:g}, is short for this way: take {100 * (4 * worst_ms // 100 + 1):g}"
            for key, limit_ms in limits_ms.items()
            if 2.0 * worst_ms > limit_ms
        ]
        return _Seen(seen, "; ".join(advice))

    def _echo(self) -> Request:
        """Return a request of an unknown session, which is answered at once."""
        unknown, number = os.urandom(16), next(self._numbers)
        return Request(PROTOCOL_VERSION, unknown, 1, number, 0, 0, False, bytes(DIGEST_SIZE))


def _fault_of(replies: list[Reply], own: ReferenceTurn) -> _Seen | None:
    """Return what is wrong with answers; None if they are the robot's own, bit for bit."""
    for reply in replies:
        if isinstance(reply, Refused):
            advice = "deploy the same holdfast and problem at both ends"
            return _fails(f"{reply.code}: {reply.text}", advice, goes_on=True)
        if isinstance(reply, NeedState):
            seen = "the service comes to another state than this robot, with the same code"
            return _fails(seen, _DISTRUST, goes_on=True)
    if not own.agrees_with(replies):
        seen = "the service answers otherwise than this robot's own planner, with the same code"
        return _fails(seen, _DISTRUST, goes_on=True)
    return None


def _until(expires_s: float) -> str:
    days = (expires_s - time.time()) / 86_400.0
    return f"until {date_text(expires_s)} ({days:.0f} days)"
