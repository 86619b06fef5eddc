"""The robot's end: a link to each service, and the calls on it.

A service appears when its link is open, and vanishes when the link ends. Over TLS the robot need
not wait for the hello: the handshake proves that the peer is the service, and whether it is
the known process. So the first request to a restarted service leaves one round trip sooner.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count

from holdfast.errors import DEFECT, FrameError, InvalidValueError, TransportError, defect_fields
from holdfast.protocol.robot_events import TransportEvent
from holdfast.transport.calls import CallTable
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES, too_large
from holdfast.transport.dialer import Dialer
from holdfast.transport.endpoints import (
    Endpoint,
    TlsFiles,
    check_credentials,
    check_endpoint,
    check_name,
)
from holdfast.transport.frames import CALL, END, LAST, REPLY, Frame, Hello, encode_hello
from holdfast.transport.link_settings import LinkSettings
from holdfast.transport.links import Link, LinkOwner
from holdfast.transport.schemes import link_maker
from holdfast.transport.tls import ClientCredentials, TlsStream

_PAUSE_S = 0.004
"""Between time slices of services that send too much: the robot's own loop comes first."""

_SAYS_NO_HELLO = "closes connections without a hello: it is no holdfast service, or is just ending"

_TAKES_NO_TLS = (
    "closes connections at the first bytes of TLS: it is at tcp/... instead of tls/..., is no "
    "holdfast service, or is just ending"
)

_NO_DATAGRAMS = "none gets through, so everything goes on the TLS stream; is UDP filtered?"

_MAX_REPORTED_REASONS = 8
"""Reasons that are not reported again; bounded, as a service may send a new one each time."""


class StreamRobotTransport:
    """The robot's end: see :class:`~holdfast.transport.contract.RobotTransport`.

    Raises TransportError if an endpoint, a name or the credentials cannot be used.
    """

    def __init__(
        self,
        # The endpoint of each service, by the robot's name for it. None for one that the robot
        # launches, whose connections come by :meth:`attach`.
        services: Mapping[str, str | None],
        *,
        name: str = "",  # the robot's; may be empty
        incarnation: str = "0",
        # After this much silence services consider this robot lost. A service's own lease is in its
        # hello.
        lease_ms: float = 400.0,
        # A larger request is refused here, a larger reply is dropped.
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
        tls: TlsFiles | None = None,  # the robot's credentials, for ``tls`` and ``udp``
        # Called for the log: ``defect`` with ``service``, ``reason`` and ``traceback``, when an
        # exception that no code here expects has ended a link; ``unreachable`` with ``service`` and
        # ``reason``, the rest of a sentence about a service that cannot be reached, refuses this
        # robot or is another one (recent reasons are not repeated until it has appeared);
        # ``no_datagrams`` with ``service`` and ``reason``, once for each; ``credentials`` with
        # ``reason``, when replaced ones cannot be used.
        on_event: Callable[..., None] = lambda _, **__: None,
    ) -> None:
        if name:
            check_name("name of a robot", name)
        check_name("incarnation of a robot", incarnation)
        self.identity = f"{name}/{incarnation}"
        self.settings = LinkSettings(
            partial(encode_hello, "robot", name, incarnation, lease_ms),
            lease_ms,
            max_message_bytes,
            pauses_for_readers=False,
            pause_s=_PAUSE_S,
        )
        self.calls = CallTable()
        self.on_event = on_event
        self._services: dict[str, _ServiceLinks] = {}
        credentials: ClientCredentials | None = None
        for service, text in services.items():
            if text is None:
                self._services[service] = _ServiceLinks(self, service, None, None)
                continue
            endpoint = check_endpoint(text, "robot")
            check_credentials(endpoint, tls)
            if credentials is None and tls is not None and endpoint.is_encrypted:
                credentials = ClientCredentials(
                    tls, lambda reason: on_event("credentials", reason=reason)
                )
            own = credentials if endpoint.is_encrypted else None
            self._services[service] = _ServiceLinks(self, service, endpoint, own)
        self._started = False
        self._closed = False

    def sends_datagrams(self, service: str) -> bool:
        """Whether short messages to a service go as datagrams now."""
        link = self._service(service).current
        return link is not None and link.sends_datagrams

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to connect and to deliver events; returns at once."""
        if self._started or self._closed:
            raise TransportError("this transport was started before; make another one")
        self._started = True
        self.calls.open(deliver)
        for service in self._services.values():
            service.start()

    def attach(self, service: str, connection: socket.socket) -> None:
        """Take the connection to a service that was launched now; it replaces the one before."""
        self._service(service).attach(connection)

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request; never waits."""
        to = self._service(service)
        link = to.link_for_call()
        if not self.calls.begin(call, link):
            return
        if link is not None and len(payload) <= self.settings.max_message_bytes:
            link.send_message(CALL, call, payload)
            return
        loop = asyncio.get_running_loop()
        if len(payload) > self.settings.max_message_bytes:
            refusal = too_large(len(payload), self.settings.max_message_bytes)
            loop.call_soon(self.calls.replied, call, refusal)
        loop.call_soon(self.calls.ended, call)

    def abandon(self, call: int) -> None:
        """Abandon a call: nothing more of it is delivered, not even its end."""
        link = self.calls.abandon(call)
        if isinstance(link, Link):
            link.forget(call)
            for service in self._services.values():
                service.freed(link)

    async def close(self, timeout_s: float = 1.0) -> None:
        """Close all links, within this time whatever the other ends do. May be repeated."""
        self._closed = True
        self.calls.close()
        closing = [each for service in self._services.values() for each in service.stop()]
        if closing:
            await asyncio.wait(closing, timeout=timeout_s)

    def _service(self, service: str) -> _ServiceLinks:
        try:
            return self._services[service]
        except KeyError:
            raise InvalidValueError(
                f"service {service!r}: known are {sorted(self._services)}"
            ) from None


class _ServiceLinks(LinkOwner):
    """The links to one service, and the calls on them."""

    def __init__(
        self,
        robot: StreamRobotTransport,
        name: str,
        endpoint: Endpoint | None,
        credentials: ClientCredentials | None,
    ) -> None:
        self._robot = robot
        self._name = name
        self._endpoint = endpoint
        self._credentials = credentials
        self._maker = None if endpoint is None else link_maker(endpoint.protocol, "robot")
        self._dialer: Dialer | None = None
        # To a launched process that has said nothing yet.
        self._silent: socket.socket | None = None
        # The links with a known process, with the incarnation that was reported, the newest last.
        self._links: dict[Link, str] = {}
        # A link to the next process, while the current one still owes replies; and its incarnation.
        self._successor: tuple[Link, str] | None = None
        # Whether the current process has said goodbye and no other was found.
        self._has_no_successor = False
        # All links, the oldest first.
        self._made: dict[Link, None] = {}
        # From the last hello, and the name under which that process was reported.
        self._incarnation: str | None = None
        self._reported = ""
        # Whether a TLS handshake is enough to report a process, before its hello.
        self._handshake_is_enough = False
        self._early = count(1)
        self._reported_reasons: deque[str] = deque(maxlen=_MAX_REPORTED_REASONS)
        self._reported_blocked = False
        self._stopped = False

    @property
    def current(self) -> Link | None:
        """The link over which it is called."""
        link = next(reversed(self._links), None)
        return None if link is None or link.ended else link

    def start(self) -> None:
        if self._endpoint is not None:
            self._dialer = Dialer(
                self._endpoint, self._make_link, self._all_failed, self._robot.identity
            )
            self._dialer.start()

    def stop(self) -> list[asyncio.Future[None]]:
        self._stopped = True
        self._drop_silent()
        if self._dialer is not None:
            self._dialer.stop()
        links = list(self._made)
        for link in links:
            link.end("", goodbye="")
        return [link.closed for link in links]

    def attach(self, connection: socket.socket) -> None:
        self._drop_silent()
        self._silent = connection
        # A process may take long to start, and no link waits so long for a hello.
        asyncio.get_running_loop().add_reader(connection, self._heard_from, connection)

    def _heard_from(self, connection: socket.socket) -> None:
        asyncio.get_running_loop().remove_reader(connection)
        self._silent = None
        link = Link(self, self._robot.settings, speaks_first=False)
        self._made[link] = None
        link.begin(connection)

    def _drop_silent(self) -> None:
        if self._silent is not None:
            asyncio.get_running_loop().remove_reader(self._silent)
            self._silent.close()
            self._silent = None

    def link_for_call(self) -> Link | None:
        """Return the link for a new call: the successor's, if there is one.

        A robot that makes a new call has abandoned the previous one or has its answer.
        """
        if self._successor is None:
            return self.current
        # In a later turn, because nothing is delivered from here. The robot then repeats the call
        # with the state that the new process lacks.
        asyncio.get_running_loop().call_soon(self._switch)
        return self._successor[0]

    def freed(self, link: Link) -> None:
        """Note that a call on a link was abandoned."""
        if link.said_goodbye and link in self._links and self._successor is not None:
            asyncio.get_running_loop().call_soon(self._switch_if_free)

    # -- links -----------------------------------------------------------------------------------

    def _make_link(self) -> Link:
        assert self._endpoint is not None and self._maker is not None
        tls = None
        if self._credentials is not None:
            context = self._credentials.context()
            tls = TlsStream(context, self._endpoint.host, self._incarnation)
        link = self._maker(self, self._robot.settings, tls=tls)
        self._made[link] = None
        return link

    def on_handshake(self, link: Link) -> None:
        if not self._handshake_is_enough or self._links:
            return
        assert link.tls is not None
        same = link.tls.is_known_incarnation
        # The incarnation is not known yet, only that it is another one.
        self._appeared(link, self._reported if same else f"not-named-yet-{next(self._early)}")

    def refusal(self, link: Link, hello: Hello) -> str | None:
        del link
        return None if hello.role == "service" else "is a robot, and a service was expected"

    def on_hello(self, link: Link, hello: Hello) -> None:
        incarnation = self._links.get(link)
        if incarnation is None:
            is_known = hello.incarnation == self._incarnation
            incarnation = self._reported if is_known else hello.incarnation
        self._incarnation, self._reported = hello.incarnation, incarnation
        self._handshake_is_enough = True
        self._reported_reasons.clear()
        if self._dialer is not None:
            self._dialer.succeeded()
        before = self.current
        if link not in self._links and before is not None and before.said_goodbye:
            self._successor = link, incarnation
            if self._dialer is not None:
                self._dialer.selected(link)
            self._switch_if_free()
            return
        if link not in self._links:
            self._appeared(link, incarnation)
        self._replace_others(link, incarnation)

    def _appeared(self, link: Link, incarnation: str) -> None:
        is_news = incarnation not in self._links.values()
        self._links[link] = incarnation
        self._has_no_successor = False
        if self._dialer is not None:
            self._dialer.selected(link)
        if is_news:
            self._robot.calls.appeared(self._name, incarnation)

    def _replace_others(self, by: Link, incarnation: str) -> None:
        """End links without a stream or with a goodbye: there is a better one.

        Links to the same process first get the replies that are on their way.
        """
        for link, its_incarnation in list(self._links.items()):
            ending = link is not by and (link.without_stream or link.said_goodbye)
            if ending and (its_incarnation != incarnation or not self._robot.calls.to(link)):
                link.end("", goodbye="")

    # -- a draining process ----------------------------------------------------------------------

    def on_goodbye(self, link: Link) -> None:
        """Look for another process, while this one still replies."""
        if self._dialer is not None and link is self.current and not self._stopped:
            self._dialer.start()
        else:
            self._leave(link)

    def _leave(self, link: Link) -> None:
        if not self._robot.calls.to(link):
            link.end("", goodbye="")

    def _all_failed(self, reason: str) -> None:
        """Note that no address of the service has accepted a connection."""
        current = self.current
        if current is not None and current.said_goodbye:
            # Once this process owes nothing, the robot can use other services.
            self._has_no_successor = True
            self._leave(current)
        else:
            self._report_unreachable(reason)

    def _switch_if_free(self) -> None:
        """Switch to the successor if the current process owes no replies."""
        current = self.current
        if current is None or not self._robot.calls.to(current):
            self._switch()

    def _switch(self) -> None:
        successor, self._successor = self._successor, None
        if successor is not None and not self._stopped:
            self._appeared(*successor)
            self._replace_others(*successor)

    def on_frame(self, link: Link, frame: Frame) -> None:
        calls = self._robot.calls
        if link not in self._links and (self._successor is None or link is not self._successor[0]):
            raise FrameError("replies before it has a request")
        if frame.kind not in (REPLY, LAST, END):
            raise FrameError(f"is a service and sends a frame of kind {frame.kind}")
        if frame.call not in calls.to(link):
            return  # it has ended
        if frame.kind != END and not frame.skipped_bytes:
            link.has_answered = True
            calls.replied(frame.call, frame.payload)
        if frame.kind != REPLY:
            calls.ended(frame.call)
            if calls.to(link):
                return
            if link.said_goodbye and self._successor is not None:
                self._switch_if_free()
            elif (link.without_stream and link is not self.current) or (
                link.said_goodbye and (self._dialer is None or self._has_no_successor)
            ):
                link.end("", goodbye="")

    def on_stream_lost(self, link: Link) -> None:
        if self._dialer is not None and not self._stopped and link is self.current:
            self._dialer.start()

    def on_datagrams_blocked(self, link: Link) -> None:
        del link
        if not self._reported_blocked:
            self._reported_blocked = True
            self._robot.on_event("no_datagrams", service=self._name, reason=_NO_DATAGRAMS)

    def on_defect(self, link: Link, error: Exception) -> None:
        del link
        self._robot.on_event(DEFECT, service=self._name, **defect_fields(error))

    def on_ended(self, link: Link) -> None:
        self._made.pop(link, None)
        if self._successor is not None:
            if link is self._successor[0]:
                self._successor = None
                if self._dialer is not None and not self._stopped:
                    self._dialer.ended(link)
                    self._dialer.start(refused=link.refused)
                return
            self._switch_if_free()
        was_current = next(reversed(self._links), None) is link
        incarnation = self._links.pop(link, None)
        if link.refused or (link.hello is None and incarnation is not None):
            self._handshake_is_enough = False
        dialer = self._dialer
        if dialer is not None:
            dialer.ended(link)
        if self._stopped:
            return
        if link.refused:
            self._report_unreachable(link.reason)
        elif link.hello is None and dialer is not None and not self._links:
            takes_tls = link.tls is None or link.tls.established
            self._report_unreachable(
                link.reason or (_SAYS_NO_HELLO if takes_tls else _TAKES_NO_TLS)
            )
        if incarnation is not None and incarnation in self._links.values():
            self._robot.calls.peer_lost(link)  # another link to the same process remains
        elif incarnation is not None:
            self._robot.calls.vanished(self._name, incarnation, link, link.why_ended)
            older = next(reversed(self._links), None)
            if older is not None and was_current:
                # An older link is open; from now on it is the current one.
                self._robot.calls.appeared(self._name, self._links[older])
        if dialer is not None and not self._links and (incarnation is not None or link.refused):
            dialer.start(refused=link.refused)

    def _report_unreachable(self, reason: str) -> None:
        if reason not in self._reported_reasons:
            self._reported_reasons.append(reason)
            self._robot.on_event("unreachable", service=self._name, reason=reason)
