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
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeAlias, TypeVar

import msgspec

from holdfast.errors import HoldfastError
from holdfast.planning.settings import OffloadSettings
from holdfast.printable import printable
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    PROTOCOL_VERSION,
    Busy,
    NeedState,
    Refused,
    Reply,
    Request,
)
from holdfast.robot.probe import AddressPath, account_of, in_thread, interface_of
from holdfast.robot.reference_decisions import ReferenceDecision, answer_in
from holdfast.runtime.addresses import system_words
from holdfast.transport.credentials import EXPIRES_SOON_DAYS, date_text, load_credentials
from holdfast.transport.endpoints import Endpoint
from holdfast.transport.exchanges import MAX_DATAGRAM_BYTES
from holdfast.transport.tls import client_context

_NAME_S: Final = 3.0
_CONNECT_S: Final = 2.0
_REPLY_S: Final = 2.0
_DATAGRAMS_S: Final = 1.5
_DECISION_S: Final = 4.0
_ALL_S: Final = 10.0

_ECHOES: Final = 20
_CLOCKS_APART_S: Final = 60.0
_DATAGRAM_HEADERS_BYTES: Final = 48
"""Size of the IPv6 and UDP headers."""

_IP_MTU: Final = {
    socket.AF_INET: (socket.IPPROTO_IP, 14),
    socket.AF_INET6: (socket.IPPROTO_IPV6, 24),
}
"""Linux's options that tell the MTU of a connected socket's route."""

_BAD_CERTIFICATE: Final = "has a certificate that "
_CLOSES_AT_TLS: Final = "closes connections at the first bytes of TLS"
_NO_TLS: Final = "is it at tcp/..., another program, or a process that is stopped?"
_NO_HOLDFAST: Final = "is it another program, at tls/... or udp/..., or a process that is stopped?"
_DISTRUST: Final = "do not use it before you know why (docs/trust.md)"
_OPEN_IT: Final = "let it through the firewalls on the way, or mend the VPN"

_AT_SERVICE: Final = {
    "other_code": "deploy the same holdfast and problem at both ends, and start the service again",
    "unknown_problem": "start the service with --problem {0}; its module must be installed there, "
    "or lie, the same as here, where the service starts or in --problem-directory DIR",
}
"""What to do about a refusal, with the problem's name; of other codes the text says it."""

_Kind = TypeVar("_Kind")
_Look: TypeAlias = Callable[..., Awaitable["_Seen | None"]]
State: TypeAlias = Literal["ok", "warns", "fails", "-"]

_ECHO: Final = Request(PROTOCOL_VERSION, os.urandom(16), 1, 0, 0, 0, False, bytes(DIGEST_SIZE))
"""A request of an unknown session, which is answered at once."""

_OTHERS_WORK_WITHOUT: Final = {"datagrams", "problem"}
"""Layers that those above do not need."""


class LayerFinding(NamedTuple):
    """The result of one layer, at one address or at all of them."""

    layer: str
    state: State
    """``warns`` works, with a problem; ``-`` was not reached."""
    seen: str
    advice: str = ""
    """What to do, if anything."""
    address: str = ""
    """If the host has several."""


class _Seen(NamedTuple):
    """What the check of a layer has found; with advice it is a warning."""

    text: str
    advice: str = ""
    state: State = "ok"


class _LayerError(HoldfastError):
    """A layer does not work."""

    def __init__(self, text: str, advice: str = "") -> None:
        super().__init__(text)
        self.advice = advice


@contextlib.asynccontextmanager
async def _within(limit_s: float, text: str, advice: str = "") -> AsyncIterator[None]:
    try:
        async with asyncio.timeout(limit_s):
            yield
    except TimeoutError:
        raise _LayerError(f"{text} within {limit_s:g} s", advice) from None


class Examination:
    """The check of all layers between a robot and a service; ``report`` gets each finding at once.

    The robot's name, credentials and limits on time are in ``offload``. Without ``decisions`` the
    service is asked for none; they are of the ``problem``.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        offload: OffloadSettings,
        decisions: Future[list[ReferenceDecision]] | None,
        report: Callable[[LayerFinding], None],
        problem: str = "",
    ) -> None:
        self._endpoint, self._offload = endpoint, offload
        self._decisions, self._report = decisions, report
        self._to_serve = f" --problem {problem}" if ":" in problem else ""
        self._layer = "name"
        self._paths: list[AddressPath] = []
        self._going_on: list[AddressPath] = []
        self._context: ssl.SSLContext | None = None
        self._decision_s: tuple[float, float] | None = None

    async def run(self) -> None:
        """Check them from below."""
        endpoint = self._endpoint
        layers: dict[str, _Look | Literal[False]] = {
            "route": not endpoint.is_local_socket and self._route,
            "port": self._port,
            "tls": self._tls,
            "certificate": endpoint.is_encrypted and self._certificate,
            "protocol": self._protocol,
            "datagrams": endpoint.protocol == "udp" and self._datagrams,
            "clock": self._clock,
            "problem": self._problem,
            "round trip": self._round_trip,
        }
        self._ours = self._own_credentials()
        try:
            async with _within(_ALL_S, "all together was not finished"):
                await self._check(self._name)
                self._going_on = self._paths
                for self._layer, look in layers.items():
                    if look and self._going_on:
                        checks = (self._check(look, path) for path in self._going_on)
                        went = zip(self._going_on, await asyncio.gather(*checks), strict=True)
                        self._going_on = [path for path, goes_on in went if goes_on]
                    elif look:
                        now = f"; it is {_now()} here" if self._layer == "clock" else ""
                        self._tell(_Seen(f"not reached{now}", state="-"))
        except _LayerError as error:
            self._tell(_Seen(str(error), state="fails"))
        finally:
            for path in self._paths:
                path.close()

    async def _check(self, look: _Look, *path: AddressPath) -> bool:
        """Check one layer, at one address; return whether to check those above."""
        try:
            seen = await look(*path)
        except HoldfastError as error:
            seen = _Seen(str(error), getattr(error, "advice", ""), "fails")
        if seen is not None:
            self._tell(seen, "".join(each.text for each in path if len(self._paths) > 1))
        return seen is None or seen.state != "fails" or self._layer in _OTHERS_WORK_WITHOUT

    def _tell(self, seen: _Seen, address: str = "") -> None:
        text, advice, state = seen
        state = "warns" if advice and state == "ok" else state
        self._report(LayerFinding(self._layer, state, printable(text), printable(advice), address))

    # -- the layers, from below ------------------------------------------------------------------

    async def _name(self) -> _Seen:
        host, port = self._endpoint.host, self._endpoint.port
        name = self._offload.name or ("" if self._offload.tls else "doctor")
        make_path = partial(AddressPath, self._endpoint, name)
        if self._endpoint.is_local_socket:
            if not Path(host).is_socket():
                fault = "is no socket" if Path(host).exists() else "is not there"
                raise _LayerError(f"{host} {fault}", "start the service that listens there")
            self._paths = [make_path(socket.AF_UNIX, host)]
            return _Seen("a socket of this machine")
        look_up = partial(socket.getaddrinfo, host, port, type=socket.SOCK_STREAM)
        try:
            found = await asyncio.wait_for(asyncio.wrap_future(in_thread(look_up)), _NAME_S)
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or f"no answer within {_NAME_S:g} s"
            advice = "is it spelled right, and the name server reached? /etc/hosts may name it too"
            raise _LayerError(f"{host} is not found: {why}", advice) from error
        self._paths = [make_path(family, address) for family, _, _, _, address in found]
        listed = ", ".join(path.text for path in self._paths)
        return _Seen(f"{host} is {'an address' if listed == host else listed}")

    async def _route(self, path: AddressPath) -> _Seen:
        with socket.socket(path.family, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(path.address)
            except OSError as error:
                raise _LayerError(
                    f"no way there: {system_words(error.errno)}",
                    "is the network up, and the VPN? 'ip route' lists what there is",
                ) from error
            local = str(probe.getsockname()[0])
            mtu = probe.getsockopt(*_IP_MTU[path.family])
        least = MAX_DATAGRAM_BYTES + _DATAGRAM_HEADERS_BYTES
        short = self._endpoint.protocol == "udp" and mtu < least
        cut = f"datagrams of up to {least} bytes are cut to pieces: raise the MTU, or use tls/..."
        return _Seen(f"from {local} ({interface_of(local)}MTU {mtu})", cut if short else "")

    async def _port(self, path: AddressPath) -> _Seen:
        endpoint = self._endpoint
        what = "the socket" if endpoint.is_local_socket else f"TCP port {endpoint.port}"
        advice = f"is the machine on, and the port right? {_OPEN_IT}"
        try:
            async with _within(_CONNECT_S, f"{what}: nothing answers", advice):
                await path.connect()
        except ConnectionRefusedError as error:
            own = endpoint.is_local_socket or endpoint.is_loopback
            at = endpoint if own else f"{endpoint.protocol}/0.0.0.0:{endpoint.port}"
            advice = f"start the service there: holdfast serve --listen {at}{self._to_serve}"
            if endpoint.is_encrypted:
                advice += " --tls KEYS/service; 'holdfast keys KEYS' makes both ends' credentials"
            raise _LayerError(f"{what}: refused, nothing listens there", advice) from error
        except OSError as error:
            raise _LayerError(f"{what}: {system_words(error.errno)}", _OPEN_IT) from error
        return _Seen(f"{what} is open")

    def _own_credentials(self) -> _Seen:
        if self._offload.tls is None:
            advice = "give this robot's, --tls KEYS/robot; 'holdfast keys KEYS' makes both ends'"
            return _Seen("none was given", advice)
        warnings: list[str] = []
        try:
            own = load_credentials(Path(self._offload.tls), "robot", warn=warnings.append)
            self._context = client_context(own.files)
        except HoldfastError as error:
            return _Seen(str(error))
        return _Seen(f"{own.name}, {_until(own.expires_s)}", "; ".join(warnings))

    async def _tls(self, path: AddressPath) -> _Seen:
        endpoint = self._endpoint
        await path.greet(self._context)
        if path.tls is None:
            none = f"none, as {endpoint.protocol}/... has: "
            if endpoint.is_loopback:
                return _Seen(f"{none}only this machine can connect")
            advice = "use tls/... or udp/... with credentials ('holdfast keys DIR' makes them)"
            return _Seen(f"{none}whoever is on the way can read along, and answer", advice)
        if not path.tls.established and not path.why_not.startswith(_BAD_CERTIFICATE):
            raise _LayerError(path.why_not or _CLOSES_AT_TLS, _NO_TLS)
        return _Seen("TLS 1.3")

    async def _certificate(self, path: AddressPath) -> _Seen:
        tls, link, ours = path.tls, path.link, f"ours: {self._ours.text}"
        assert tls is not None
        if self._context is None:
            raise _LayerError(ours, self._ours.advice)
        if link.peer is None:
            fault = path.why_not.removeprefix(_BAD_CERTIFICATE)
            raise _LayerError(f"theirs: {fault}", account_of(await path.certificate()))
        if link.hello is None and "certificate" in path.why_not:
            raise _LayerError(f"{ours}: {path.why_not}")
        ends, advice = link.peer.expires_at, [self._ours.advice] * bool(self._ours.advice)
        if ends < time.time() + 86_400.0 * EXPIRES_SOON_DAYS:
            renew = f"'holdfast keys DIR --renew --service {link.peer.name}'"
            advice.append(f"the service's ends soon: {renew} makes another")
        theirs = f"theirs: {link.peer.name}, {_until(ends)}, for {tls.hosts()}"
        return _Seen(f"{ours}; {theirs}", "; ".join(advice))

    async def _protocol(self, path: AddressPath) -> _Seen:
        hello = path.link.hello
        if hello is None:
            reason = path.why_not or "closes the connection without a hello"
            known = "install" in reason or "--tls" in reason
            raise _LayerError(reason, "" if known else _NO_HOLDFAST)
        slow = "its process stands still, or has far too much to do"
        async with _within(_REPLY_S, "has not answered", slow):
            replies = await path.ask(_ECHO)
        if refused := _of_kind(Refused, replies):
            advice = "install the same release at both ends"
            raise _LayerError(f"{refused.code}: {refused.text}", advice)
        seen = f"{hello.name}, holdfast {hello.release}, messages of version {PROTOCOL_VERSION}"
        return _Seen(seen)

    async def _datagrams(self, path: AddressPath) -> _Seen:
        try:
            async with asyncio.timeout(_DATAGRAMS_S):
                while not path.link.sends_datagrams:
                    await asyncio.sleep(0.005)
        except TimeoutError:
            seen = f"none gets through within {_DATAGRAMS_S:g} s, so everything goes on TLS"
            raise _LayerError(seen, f"UDP port {self._endpoint.port}: {_OPEN_IT}") from None
        return _Seen("get through in both directions")

    async def _clock(self, path: AddressPath) -> _Seen:
        ahead_s, now = path.clock_ahead_s, f"it is {_now()} here"
        if ahead_s is None:
            return _Seen(f"the service does not tell its own; {now}", state="-")
        size = f"{abs(ahead_s):.0f} s" if abs(ahead_s) >= 1.0 else "less than a second"
        if abs(ahead_s) < _CLOCKS_APART_S:
            return _Seen(f"{size} from the service's")
        advice = "set both ('timedatectl' tells whether they are): certificates are judged by them"
        where = "ahead of" if ahead_s > 0 else "behind"
        return _Seen(f"{size} {where} the service's; {now}", advice)

    async def _problem(self, path: AddressPath) -> _Seen | None:
        if path is not self._going_on[0]:
            return None
        if self._decisions is None:
            return _Seen("not asked: with CONFIG, decisions are compared", state="-")
        try:
            own = await asyncio.wait_for(asyncio.wrap_future(self._decisions), _DECISION_S)
        except TimeoutError:
            seen = f"not asked: two decisions take longer than {_DECISION_S:g} s here"
            return _Seen(seen, state="-")
        except HoldfastError as error:
            raise _LayerError(f"this robot's own planner fails: {error}") from error
        session, slow = os.urandom(16), "it is too slow for this problem, or has too much to do"
        described = own[0].request.session_configuration
        assert described is not None
        for decision in own:
            request = msgspec.structs.replace(decision.request, session=session)
            began = time.perf_counter()
            async with _within(_DECISION_S, "no decision", slow):
                while busy := _of_kind(Busy, replies := await path.ask(request)):
                    await asyncio.sleep(1e-3 * busy.retry_after_ms)
            took_s = time.perf_counter() - began
            if refused := _of_kind(Refused, replies):
                advice = _AT_SERVICE.get(refused.code, "").format(described.problem)
                raise _LayerError(f"{refused.code}: {refused.text}", advice)
            if answer_in(replies) != decision.answer:
                other = "answers otherwise than this robot's own planner"
                if _of_kind(NeedState, replies):
                    other = "comes to another state than this robot"
                raise _LayerError(f"the service {other}, with the same code", _DISTRUST)
        self._decision_s = took_s, decision.took_s
        seen = f"{described.problem}: the same code and settings; {len(own)} decisions are"
        return _Seen(f"{seen} the robot's own, bit for bit")

    async def _round_trip(self, path: AddressPath) -> _Seen:
        assert path.link.hello is not None
        took_ms: list[float] = []
        with contextlib.suppress(TimeoutError, HoldfastError):
            async with asyncio.timeout(_REPLY_S):
                while len(took_ms) < _ECHOES:
                    began = time.perf_counter()
                    await path.ask(_ECHO)
                    took_ms.append(1e3 * (time.perf_counter() - began))
        if not took_ms:
            raise _LayerError(f"no echo within {_REPLY_S:g} s", "its process stands still")
        worst_ms = max(took_ms)
        seen = f"{len(took_ms)} echoes: median {statistics.median(took_ms):.1f} ms, "
        seen += f"worst {worst_ms:.1f} ms"
        if self._decision_s is not None:
            there_s, here_s = self._decision_s
            seen += f"; a decision {1e3 * there_s:.1f} ms, here {1e3 * here_s:.1f} ms"
        limits_ms = {
            "--lease-ms of the service": path.link.hello.lease_ms,
            "offload.lease_ms": self._offload.lease_ms,
            "offload.detection_timeout_ms": self._offload.detection_timeout_ms,
        }
        advice = [
            f"{key}, {limit_ms:g}, is short for this way: take {100 * (4 * worst_ms // 100 + 1):g}"
            for key, limit_ms in limits_ms.items()
            if 2.0 * worst_ms > limit_ms
        ]
        return _Seen(seen, "; ".join(advice))


def _of_kind(kind: type[_Kind], replies: list[Reply]) -> _Kind | None:
    return next((reply for reply in replies if isinstance(reply, kind)), None)


def _now() -> str:
    return date_text(time.time())


def _until(expires_s: float) -> str:
    days = (expires_s - time.time()) / 86_400.0
    return f"until {date_text(expires_s)} ({days:.0f} days)"
