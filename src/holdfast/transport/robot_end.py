"""The robot's end of streams: a link to each service, and the calls that are on their way on it.

A service is there from the moment that its link is, and gone when that ends. Over TLS the robot
need not wait for the service to say which process it is: the handshake has proved that it is the
service, and told whether it is the process that the robot knew. So the first question to a service
that was started again is on its way a round trip sooner.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count

from holdfast.errors import InvalidValueError, TransportError
from holdfast.session.events import TransportEvent
from holdfast.transport.calls import CallTable, PendingCall, too_large
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES
from holdfast.transport.dialer import Dialer
from holdfast.transport.endpoints import (
    Endpoint,
    ServiceAddress,
    TlsFiles,
    check_credentials,
    check_direction,
    check_endpoint,
    check_name,
)
from holdfast.transport.frames import (
    CALL,
    END,
    HEADER_BYTES,
    LAST,
    REPLY,
    Frame,
    FrameError,
    Hello,
    encode_hello,
)
from holdfast.transport.links import HalfReceived, Link, LinkSettings, receive_buffer
from holdfast.transport.listener import Listener, one_too_many
from holdfast.transport.tls import ClientCredentials, TlsStream
from holdfast.transport.turns import Turns

__all__ = ["StreamRobotTransport"]

_CALL_NUMBERS = 1 << 32

_PAUSE_S = 0.004
"""Between turns of services that send more than anybody has asked for: a robot decides, too."""

_SAYS_NO_HELLO = "closes connections without a hello: it is no holdfast service, or is just ending"

_TAKES_NO_TLS = (
    "closes connections at the first bytes of TLS: it is at tcp/... instead of tls/..., is no "
    "holdfast service, or is just ending"
)

_MAX_UNGREETED = 64
"""Connections to a robot that listens, of which nobody knows who they are."""


_MAX_TOLD_REASONS = 8
"""So many are not told again; a service may send a new one in each goodbye."""


class StreamRobotTransport:
    """The robot's end: see :class:`~holdfast.transport.contract.RobotTransport`.

    Parameters
    ----------
    services : mapping of str to ServiceAddress
        Where each service is, by the robot's name for it.
    name : str
        The robot's; may be empty.
    incarnation : str
        Of this process.
    lease_ms : float
        Services give this robot up when nothing comes from it for this long; it lets itself be
        heard more often. How long a service may be silent, the service says.
    max_message_bytes : int
        A larger request is refused here, a larger reply is dropped.
    tls : TlsFiles or None
        The robot's credentials, for ``tls``.
    on_unreachable : callable or None
        Is told the service and the reason, as the rest of a sentence about it, when it cannot be
        connected to, refuses this robot or is not what the robot looks for. The last few reasons
        are not told again until the service is there again.
    on_closed_to_datagrams : callable or None
        Is told, once, of a service at ``udp`` to which no datagram gets through, so that the
        stream carries all.
    on_unusable : callable or None
        Is told why credentials that somebody has replaced cannot be used, so that those of before
        stay in use.

    Raises
    ------
    TransportError
        If an endpoint, a name or the credentials cannot be used.
    """

    def __init__(
        self,
        services: Mapping[str, ServiceAddress],
        *,
        name: str = "",
        incarnation: str = "0",
        lease_ms: float = 400.0,
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
        tls: TlsFiles | None = None,
        on_unreachable: Callable[[str, str], None] | None = None,
        on_closed_to_datagrams: Callable[[str], None] | None = None,
        on_unusable: Callable[[str], None] | None = None,
    ) -> None:
        if name:
            check_name("name of a robot", name)
        check_name("incarnation of a robot", incarnation)
        self.identity = f"{name}/{incarnation}"
        self.settings = LinkSettings(
            partial(encode_hello, "robot", name, incarnation, lease_ms),
            lease_ms,
            max_message_bytes,
            HalfReceived(2 * (max_message_bytes + HEADER_BYTES)),
            Turns(_PAUSE_S),
            receive_buffer(),
            must_read=False,
        )
        self.calls = CallTable()
        self.on_unreachable = on_unreachable
        self.on_closed_to_datagrams = on_closed_to_datagrams
        self._services: dict[str, _Service] = {}
        credentials: ClientCredentials | None = None
        for service, address in services.items():
            endpoint = check_endpoint(address.endpoint, listens=address.listens)
            check_credentials(endpoint, tls)
            check_direction(endpoint, service_listens=not address.listens)
            if address.name is not None:
                check_name("name of a service", address.name)
            if credentials is None and tls is not None and endpoint.is_encrypted:
                credentials = ClientCredentials(tls, on_unusable)
            if endpoint.protocol == "udp":
                from holdfast.transport.sealing import require_cryptography

                require_cryptography()
            own = credentials if endpoint.is_encrypted else None
            self._services[service] = _Service(self, service, address, endpoint, own)
        self._started = False
        self._closed = False

    def sends_datagrams(self, service: str) -> bool:
        """Whether short messages to a service go as datagrams now."""
        link = self._service(service).current
        return link is not None and link.sends_datagrams

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to connect, and to deliver events; returns at once, connected or not.

        Raises
        ------
        TransportError
            If the robot cannot listen where it should.
        """
        if self._started or self._closed:
            raise TransportError("this transport was started before; make another one")
        self._started = True
        self.calls.open(deliver)
        try:
            for service in self._services.values():
                service.start()
        except TransportError:
            self._stop()
            raise

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request; never waits."""
        to = self._service(service)
        link = to.link_for_call()
        pending = self.calls.begin(call, link)
        if pending is None:
            return
        if link is not None and len(payload) <= self.settings.max_message_bytes:
            to.send(link, pending, payload)
            return
        loop = asyncio.get_running_loop()
        if len(payload) > self.settings.max_message_bytes:
            refusal = too_large(len(payload), self.settings.max_message_bytes)
            loop.call_soon(self.calls.replied, pending, refusal)
        loop.call_soon(self.calls.ended, pending)

    def abandon(self, call: int) -> None:
        """Give a call up: nothing more of it is delivered, not even its end."""
        pending = self.calls.abandon(call)
        if pending is not None:
            for service in self._services.values():
                service.forget(pending)

    async def close(self, timeout_s: float = 1.0) -> None:
        """Close all links, within this time whatever the other ends do. May be repeated."""
        closing = self._stop()
        if closing:
            await asyncio.wait(closing, timeout=timeout_s)

    def _stop(self) -> list[asyncio.Future[None]]:
        self._closed = True
        self.calls.close()
        return [closing for service in self._services.values() for closing in service.stop()]

    def _service(self, service: str) -> _Service:
        try:
            return self._services[service]
        except KeyError:
            raise InvalidValueError(
                f"service {service!r}: known are {sorted(self._services)}"
            ) from None


class _Service:
    """One service, as a robot sees it: the owner of its links.

    Attributes
    ----------
    endpoint : Endpoint
        Where it listens or, for one that connects, where the robot does.
    """

    def __init__(
        self,
        robot: StreamRobotTransport,
        name: str,
        address: ServiceAddress,
        endpoint: Endpoint,
        credentials: ClientCredentials | None,
    ) -> None:
        self._robot = robot
        self._name = name
        self._address = address
        self._credentials = credentials
        self._listener: Listener | None = None
        self._dialer: Dialer | None = None
        # Those over which it is seen, with the boot that was told, the newest last. There are
        # several only where the robot listens.
        self._links: dict[Link, str] = {}
        # One with its boot that waits until what the process before it owes has come.
        self._successor: tuple[Link, str] | None = None
        # Whether, since the one that is called has said goodbye, nobody else was found.
        self._found_no_other = False
        # In the order of their beginning, with the network from which each came.
        self._made: dict[Link, bytes] = {}
        self._calls: dict[Link, dict[int, PendingCall]] = {}
        self._numbers = count()
        # What the last hello said, under which boot that was told, and whether the handshake alone
        # is believed: not after one to which no hello came, or a refusal.
        self._incarnation: str | None = None
        self._boot = ""
        self._handshake_is_enough = False
        self._early = count(1)
        self._told_reasons: deque[str] = deque(maxlen=_MAX_TOLD_REASONS)
        self._told_closed = False
        self._stopped = False
        self.endpoint = endpoint

    @property
    def current(self) -> Link | None:
        """The link over which it is called."""
        link = next(reversed(self._links), None)
        return None if link is None or link.ended else link

    def start(self) -> None:
        if self._address.listens:
            self._listener = Listener(
                self.endpoint, self._accepted, speaks_first=self._credentials is not None
            )
        else:
            self._dialer = Dialer(
                self.endpoint, self._make_link, self._found_nobody, self._robot.identity
            )
            self._dialer.start()

    def stop(self) -> list[asyncio.Future[None]]:
        self._stopped = True
        if self._listener is not None:
            self._listener.close()
        if self._dialer is not None:
            self._dialer.stop()
        links = list(self._made)
        for link in links:
            link.end("", goodbye="")
        return [link.closed for link in links]

    def link_for_call(self) -> Link | None:
        """Return the link for a new call.

        Who asks anew has what it asked for before, or does not want it any more.
        """
        if self._successor is None:
            return self.current
        # In a later turn, for nothing is delivered from here. Then the call is asked again, with
        # what the other process does not know.
        asyncio.get_running_loop().call_soon(self._move_on)
        return self._successor[0]

    def send(self, link: Link, pending: PendingCall, payload: bytes) -> None:
        number = next(self._numbers) % _CALL_NUMBERS
        self._calls[link][number] = pending
        link.send_message(CALL, number, payload)

    def forget(self, pending: PendingCall) -> None:
        """Take note that nobody wants to hear more of a call."""
        link = pending.peer
        if isinstance(link, Link):
            for number, call in list(self._calls.get(link, {}).items()):
                if call is pending:
                    del self._calls[link][number]
                    link.forget(number)
            if link.said_goodbye and self._successor is not None:
                asyncio.get_running_loop().call_soon(self._move_on_if_free)

    # -- links -----------------------------------------------------------------------------------

    def _make_link(self, network: bytes = b"") -> Link:
        tls = None
        if self._credentials is not None:
            host = None if self._address.listens else self.endpoint.host
            tls = TlsStream(self._credentials.context(), host, self._incarnation)
        link: Link
        if self.endpoint.protocol == "udp":
            from holdfast.transport.datagrams import RobotDatagramLink

            assert tls is not None
            link = RobotDatagramLink(self, self._robot.settings, tls=tls)
        elif self.endpoint.is_ros1:
            from holdfast.transport.ros1 import RobotRosLink

            link = RobotRosLink(self, self._robot.settings, self.endpoint)
        else:
            link = Link(
                self,
                self._robot.settings,
                speaks_first=tls is not None or not self._address.listens,
                tls=tls,
            )
        self._made[link] = network
        return link

    def _accepted(self, connection: socket.socket, network: bytes) -> None:
        unknown = {
            link: its_network
            for link, its_network in self._made.items()
            if link.hello is None and not link.ended
        }
        if len(unknown) >= _MAX_UNGREETED:
            one_too_many(unknown).end("has said no hello, and others wait", abort=True)
        link = self._make_link(network)
        link.connecting = asyncio.get_running_loop().create_task(link.connect(connection))

    def established(self, link: Link) -> None:
        """Take note that the other end has proved to be a service."""
        if not self._handshake_is_enough or self._address.listens or self._links:
            return
        assert link.tls is not None
        same = link.tls.is_known_incarnation
        # What the process is called is not known yet: whatever it is, it is another one.
        self._appeared(link, self._boot if same else f"not-named-yet-{next(self._early)}")

    def refusal(self, link: Link, hello: Hello) -> str | None:
        """Refuse whoever is not the service that is looked for."""
        del link
        if hello.role != "service":
            return "is a robot, and a service was expected"
        wanted = self._address.name
        if wanted is not None and hello.name != wanted:
            return f"is the service {hello.name}, and {wanted} was expected"
        return None

    def greeted(self, link: Link, hello: Hello) -> None:
        """Take note of what the other end says of itself."""
        boot = self._links.get(link)
        if boot is None:
            boot = self._boot if hello.incarnation == self._incarnation else hello.incarnation
        self._incarnation, self._boot = hello.incarnation, boot
        self._handshake_is_enough = True
        self._told_reasons.clear()
        if self._dialer is not None:
            self._dialer.succeeded()
        before = self.current
        if link not in self._links and before is not None and before.said_goodbye:
            self._calls[link] = {}
            self._successor = link, boot
            if self._dialer is not None:
                self._dialer.won(link)
            self._move_on_if_free()
            return
        if link not in self._links:
            self._appeared(link, boot)
        self._replace_others(link, boot)

    def _appeared(self, link: Link, boot: str) -> None:
        is_news = boot not in self._links.values()
        self._links[link] = boot
        self._calls.setdefault(link, {})
        self._found_no_other = False
        if self._dialer is not None:
            self._dialer.won(link)
        if is_news:
            self._robot.calls.appeared(self._name, boot)

    def _replace_others(self, by: Link, boot: str) -> None:
        """End the links that go on without a stream or are about to end: there is a better one.

        Those to the same process first hear the answers that are on their way.
        """
        for link, its_boot in list(self._links.items()):
            ending = link is not by and (link.adrift or link.said_goodbye)
            if ending and (its_boot != boot or not self._calls[link]):
                link.end("", goodbye="")

    # -- a process that is about to end ----------------------------------------------------------

    def leaving(self, link: Link) -> None:
        """Look for another process, while this one still answers."""
        if self._dialer is not None and link is self.current and not self._stopped:
            self._dialer.start()
        else:
            self._leave(link)

    def _leave(self, link: Link) -> None:
        if not self._calls.get(link):
            link.end("", goodbye="")

    def _found_nobody(self, reason: str) -> None:
        """Take note that nobody is at any of the service's addresses."""
        current = self.current
        if current is not None and current.said_goodbye:
            # Other services can be asked, as soon as this one owes nothing.
            self._found_no_other = True
            self._leave(current)
        else:
            self._tell_unreachable(reason)

    def _move_on_if_free(self) -> None:
        """Go over to the next process if the one before owes nothing."""
        current = self.current
        if current is None or not self._calls.get(current):
            self._move_on()

    def _move_on(self) -> None:
        successor, self._successor = self._successor, None
        if successor is not None and not self._stopped:
            self._appeared(*successor)
            self._replace_others(*successor)

    def received(self, link: Link, frame: Frame) -> None:
        """Take a reply, or the end of a call."""
        calls = self._calls.get(link)
        if calls is None:
            raise FrameError("answers before it has been asked")
        if frame.kind not in (REPLY, LAST, END):
            raise FrameError(f"is a service and sends a frame of kind {frame.kind}")
        call = calls.get(frame.call)
        if call is None:
            return  # it has ended
        if frame.kind != END and not frame.passed_over_bytes:
            link.has_answered = True
            self._robot.calls.replied(call, frame.payload)
        if frame.kind != REPLY:
            calls.pop(frame.call, None)
            self._robot.calls.ended(call)
            if calls:
                return
            if link.said_goodbye and self._successor is not None:
                self._move_on_if_free()
            elif (link.adrift and link is not self.current) or (
                link.said_goodbye and (self._dialer is None or self._found_no_other)
            ):
                link.end("", goodbye="")

    def went_adrift(self, link: Link) -> None:
        """Make another link, while this one goes on."""
        if self._dialer is not None and not self._stopped and link is self.current:
            self._dialer.start()

    def closed_to_datagrams(self, link: Link) -> None:
        """Tell that no datagram gets through, once."""
        del link
        on_closed = self._robot.on_closed_to_datagrams
        if on_closed is not None and not self._told_closed:
            self._told_closed = True
            on_closed(self._name)

    def lost(self, link: Link) -> None:
        """Take note that a link has ended."""
        self._made.pop(link, None)
        self._calls.pop(link, None)
        if self._successor is not None:
            if link is self._successor[0]:
                self._successor = None
                if self._dialer is not None and not self._stopped:
                    self._dialer.ended(link)
                    self._dialer.start(refused=link.refused)
                return
            self._move_on_if_free()
        was_current = next(reversed(self._links), None) is link
        boot = self._links.pop(link, None)
        if link.refused or (link.hello is None and boot is not None):
            self._handshake_is_enough = False
        dialer = self._dialer
        if dialer is not None:
            dialer.ended(link)
        if self._stopped:
            return
        if link.refused:
            self._tell_unreachable(link.reason)
        elif link.hello is None and dialer is not None and not self._links:
            takes_tls = link.tls is None or link.tls.established
            self._tell_unreachable(link.reason or (_SAYS_NO_HELLO if takes_tls else _TAKES_NO_TLS))
        if boot is not None and boot in self._links.values():
            self._robot.calls.lost(link)  # it goes on over another link
        elif boot is not None:
            self._robot.calls.vanished(self._name, boot, link)
            older = next(reversed(self._links), None)
            if older is not None and was_current:
                # An older one is still there: from now on it is the one that is called.
                self._robot.calls.appeared(self._name, self._links[older])
        if dialer is not None and not self._links and (boot is not None or link.refused):
            dialer.start(refused=link.refused)

    def _tell_unreachable(self, reason: str) -> None:
        on_unreachable = self._robot.on_unreachable
        if on_unreachable is not None and reason not in self._told_reasons:
            self._told_reasons.append(reason)
            on_unreachable(self._name, reason)
