"""The wire between machines: Zenoh, with one session for each service.

Zenoh offers one network in which everybody meets; a robot that must know *which* replica answered,
and that *this* one is gone, needs the opposite. So the robot opens a session of its own to every
endpoint, and sessions never learn of each other. Each incarnation of a service has keys of its own,
``holdfast/1/NAME/BOOT/alive`` (a liveliness token, which says that it is there) and
``holdfast/1/NAME/BOOT/decide`` (a queryable, which answers), so that a process that was killed and
its successor are never taken for one.

What holds here was measured, not read:

- Callbacks run on Zenoh's own threads (``indirect=False``). Zenoh's other way starts a Python
  thread for each call; it is slower, and such a thread keeps the process from ending.
- A message that does not fit the buffers blocks its sender, and with it, now and then, every other
  session of the process. If the other end has stopped reading, the lease does not end that, only
  ``wait_before_close`` does; and that bounds how long a message may take as a whole, so it breaks
  the link to whoever is merely slow. (Shorter than the lease, it makes Zenoh hang.) Therefore large
  requests are sent in parts, a few at a time, each of which is acknowledged, and no part is larger
  than what a slow link carries within a lease.
- A session whose service has vanished is replaced. Zenoh knows a peer by the identity of its
  session, and when one comes back while the link to it is still being closed (a process that was
  stopped goes on), it can be left half connected for ever: seen, and never answering.
- Zenoh has five pools of threads, and hands each message over from one to the next: from the one
  that sees that a socket has something to the one that reads, and back to the one that writes. To
  wake a thread on another core takes longer than all the rest, so here one pool sees and reads, and
  one thread writes (and says that this end lives, also while the others wait for Python). The
  price: while callbacks block, nothing is seen of other links (two clients that did not read what
  was sent to them from a callback cut all others off); so callbacks send nothing.
- ``connect/timeout_ms`` stays at its default: 0 would mean one attempt and no other.
- A session passes on to the others what one client declares. So a client of an honest service, with
  any robot's certificate, could declare the service's own keys and answer other robots in its
  place. Zenoh's access control prevents that at both ends: what is not needed to see a service, to
  ask it and to be answered is dropped, in both directions (``_access``). Its rules cannot be
  changed while a session is open, and a rule for some clients applies only to those that match all
  that it says of them; so these rules are the same for everybody.
- Besides its own authority, a robot's end believes the public ones of the web: Zenoh adds them and
  has no setting against it. They may certify the host name of a service, but no private address.
- ``close`` can take ten seconds when a peer has vanished, so it runs aside and is not waited for. A
  process that ends without it can be aborted in a callback, so it is also called at exit.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import re
import struct
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import monotonic

import zenoh

from holdfast.errors import InvalidValueError, TransportError
from holdfast.runtime.last_threads import join_until
from holdfast.runtime.senders import NOBODY, Senders
from holdfast.runtime.transport.calls import (
    DEFAULT_MAX_MESSAGE_BYTES,
    CallTable,
    Courier,
    PendingCall,
    too_large,
)
from holdfast.runtime.transport.contract import IncomingCall
from holdfast.session.events import TransportEvent
from holdfast.transport.endpoints import (
    Endpoint,
    ServiceAddress,
    TlsFiles,
    check_credentials,
    free_port,
    parse_endpoint,
)

__all__ = [
    "KEY_VERSION",
    "MAX_ROBOTS",
    "ZenohRobotTransport",
    "ZenohServiceTransport",
    "connection_error",
]

KEY_VERSION = 1
"""Of the keys. The messages have a version of their own, which can be told to the other end."""

_PREFIX = f"holdfast/{KEY_VERSION}"
"""Of all keys."""

_FROM_ROBOT = ("query", "liveliness_query", "declare_liveliness_subscriber")
_FROM_SERVICE = ("declare_queryable", "liveliness_token", "reply")
"""Kinds of message, in the words of Zenoh's access control, that either end has use for."""

_THREADS = (
    "(acc: (handover: app), net: (handover: app), rx: (handover: app), app: (worker_threads: 2))"
)
"""Of Zenoh in this process, unless the environment's ZENOH_RUNTIME says otherwise."""

_RETRY_FIRST_MS = 50
_RETRY_MAX_MS = 100
"""A restarted service is reached again within about this time, however long it was away."""

_OPEN_TIMEOUT_MS = 1000
"""For the handshake of a link; without a bound, a QUIC peer takes 4 s to be reached again."""

_BLOCKED_SEND_LEASES = 1.25
"""A send that blocks so many leases long breaks the link. Below 1, Zenoh 1.10 hangs instead."""

_PART_BYTES = 36_000
"""Larger requests are sent in parts; 1000 particles of three coordinates are one part."""

_PARTS_AT_ONCE = 4
"""Parts that are sent before one has been acknowledged: at best 140 KB in each round trip."""

_BATCH_BYTES = 40_000
"""What Zenoh sends at once. A link must carry so much within a lease to count as alive."""

_BATCHES_QUEUED = 16
"""Zenoh's upper bound; enough that the parts which are on their way never block."""

_SMALLEST_PART_BYTES = 1000
"""Of all parts but the last: each takes memory besides its bytes, and only these are counted."""

_LARGEST_MESSAGE_BYTES = 1_000_000
"""What a service takes in one message; a robot that plays by the rules sends no such message."""

_HEADER_BYTES = 1000
"""What Zenoh may put around a reply; what it receives beyond the bound it drops."""

_UPLOADS = 256
"""Requests in parts that a service holds at the same time."""

_UPLOADED_MESSAGES = 2
"""Their size together, as a multiple of the largest request."""

_PART = struct.Struct("<16sQII")  # request, its size, number of this part, number of parts

_FREE_PORT_ATTEMPTS = 8

_MAX_BOOTS = 64
"""Incarnations of one service that a robot takes note of at the same time."""

MAX_ROBOTS = 4096
"""Links that a service accepts at the same time."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")


class _Boot:
    """One incarnation of a service, as a robot sees it."""

    __slots__ = ("boot", "decide")

    def __init__(self, boot: str, alive: str) -> None:
        self.boot = boot
        self.decide = zenoh.KeyExpr(f"{alive.removesuffix('/alive')}/decide")


class _Link:
    """A session to one endpoint, and the incarnations that are seen there, the newest last."""

    def __init__(self, service: str, address: ServiceAddress, endpoint: Endpoint) -> None:
        self.service = service
        self.address = address
        self.endpoint = endpoint
        self.session: zenoh.Session | None = None
        self.generation = 0
        self.boots: dict[str, _Boot] = {}
        self.newest: _Boot | None = None
        self.sender = Courier(f"holdfast-send-{service}")
        self.keeper = Courier(f"holdfast-keep-{service}")


class _ZenohCall(PendingCall):
    """A call in flight, and what is needed to break it off."""

    __slots__ = ("cancellation", "sending_thread")

    def __init__(self, number: int, boot: _Boot | None) -> None:
        super().__init__(number, boot)
        self.cancellation = zenoh.CancellationToken()
        self.sending_thread = 0


class _Outgoing:
    """A request that is sent in parts; used on the sending thread alone."""

    def __init__(self, pending: _ZenohCall, boot: _Boot, payload: bytes) -> None:
        self.pending = pending
        self.boot = boot
        self.payload = payload
        self.name = os.urandom(16)
        self.count = -(-len(payload) // _PART_BYTES)
        self.sent = 0
        self.acknowledged = 0

    def part(self, index: int) -> tuple[bytes, bytes]:
        """Return a part and what says where it belongs."""
        start = index * _PART_BYTES
        description = _PART.pack(self.name, len(self.payload), index, self.count)
        return self.payload[start : start + _PART_BYTES], description


class _PartSent:
    """What has come back of one part."""

    __slots__ = ("acknowledged",)

    def __init__(self) -> None:
        self.acknowledged = False


class ZenohRobotTransport:
    """The robot's end: see :class:`~holdfast.runtime.transport.contract.RobotTransport`.

    The callable that events are delivered to must not call the transport.

    Parameters
    ----------
    services : mapping of str to ServiceAddress
        Where each service is, by the robot's name for it.
    lease_ms : float
        A link over which nothing comes for this long is given up.
    decision_timeout_ms : float
        A call that takes longer than this is ended.
    max_message_bytes : int
        A larger request is refused here, a larger reply is dropped.
    tls : TlsFiles or None
        The robot's credentials, for ``tls`` and ``quic``.

    Raises
    ------
    TransportError
        If an endpoint cannot be used.
    """

    def __init__(
        self,
        services: Mapping[str, ServiceAddress],
        *,
        lease_ms: float = 400.0,
        decision_timeout_ms: float = 60_000.0,
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
        tls: TlsFiles | None = None,
    ) -> None:
        self._links: dict[str, _Link] = {}
        for service, address in services.items():
            endpoint = _checked(address.endpoint, tls, listens=address.listens)
            if address.name is not None:
                _check_name("name of a service", address.name)
            if address.listens and endpoint.is_local_socket:
                parse_endpoint(f"{_numbered(endpoint, 10**9)}.lock")  # not too long later either
            elif address.listens and endpoint.port == 0:
                # Chosen now, so that a service can be told before it is launched.
                endpoint = endpoint.with_port(free_port(endpoint))
            self._links[service] = _Link(service, address, endpoint)
        self._lease_ms = lease_ms
        self._decision_timeout_s = decision_timeout_ms / 1e3
        self._max_message_bytes = max_message_bytes
        self._tls = tls
        self._calls = CallTable()
        self._courier = Courier("holdfast-robot-end")
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []

    def endpoint_of(self, service: str) -> str:
        """Return the endpoint of a service: for one that the robot listens for, where to connect.

        Port 0 has been replaced by a free one.
        """
        return str(self._link(service).endpoint)

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to connect, and to deliver events; returns at once, connected or not.

        Raises
        ------
        TransportError
            If the robot cannot listen where it should.
        """
        if self._closed.is_set():
            raise TransportError("this transport is closed; make another one")
        self._calls.open(deliver)
        atexit.register(self.close)
        try:
            for link in self._links.values():
                self._open(link)
        except TransportError:
            self.close()
            raise

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request; never blocks."""
        link = self._link(service)
        with self._calls.lock:  # so that an incarnation does not vanish between these two lines
            boot = link.newest
            pending = _ZenohCall(call, boot)
            if not self._calls.begin(pending):
                return
        if len(payload) > self._max_message_bytes:
            self._courier.post(partial(self._refuse, pending, len(payload)))
        elif boot is None:
            self._courier.post(partial(self._calls.ended, pending))
        elif len(payload) > _PART_BYTES:
            outgoing = _Outgoing(pending, boot, payload)
            link.sender.post(partial(self._send_parts, link, outgoing))
        else:
            self._send(link, boot, pending, payload)

    def abandon(self, call: int) -> None:
        """Give a call up: nothing more of it is delivered, not even its end."""
        pending = self._calls.abandon(call)
        if isinstance(pending, _ZenohCall):
            pending.cancellation.cancel()

    def close(self, timeout_s: float = 1.0) -> None:
        """Close all links, within about this time whatever the other ends do. May be repeated."""
        deadline_s = monotonic() + timeout_s
        atexit.unregister(self.close)
        self._closed.set()
        self._calls.close()
        links = list(self._links.values())
        for link in links:
            link.keeper.stop(deadline_s)
            self._put_aside(link)
        for courier in [self._courier, *(link.sender for link in links)]:
            courier.stop(deadline_s)
        join_until(self._threads, deadline_s)

    def _link(self, service: str) -> _Link:
        try:
            return self._links[service]
        except KeyError:
            raise InvalidValueError(
                f"service {service!r}: known are {sorted(self._links)}"
            ) from None

    def _open(self, link: _Link) -> None:
        """Open a session of a link.

        Raises
        ------
        TransportError
            If the robot cannot listen where it should.
        """
        generation = link.generation  # what comes of this session counts while this is the link's
        listens = link.address.listens
        place = link.endpoint
        if listens and place.is_local_socket:
            place = _numbered(place, generation)
        session, _ = _opened(
            listen=[place] if listens else [],
            connect=[] if listens else [place],
            access=_access(coming=_FROM_SERVICE, going=_FROM_ROBOT),
            lease_ms=self._lease_ms,
            max_received_bytes=self._max_message_bytes + _HEADER_BYTES,
            tls=self._tls,
        )
        with self._calls.lock:
            link.session = session  # before anybody can appear and be called
        session.liveliness().declare_subscriber(
            f"{_PREFIX}/{link.address.name or '*'}/*/alive",
            zenoh.handlers.Callback(partial(self._token_changed, link, generation), indirect=False),
            history=True,
        )
        if place is not link.endpoint:
            _point(link.endpoint, place)

    def _put_aside(self, link: _Link) -> None:
        """Take a link's session away and close it, on a thread of its own."""
        with self._calls.lock:
            session, link.session = link.session, None
            link.newest = None
            for boot in list(link.boots.values()):
                # Seen after it was decided to renew the link: it will be seen again.
                del link.boots[boot.boot]
                self._calls.vanished(link.service, boot.boot, boot)
            link.generation += 1
        if session is None:
            return
        if link.address.listens and link.endpoint.is_local_socket:
            with contextlib.suppress(OSError):  # so that nobody connects to what is being closed
                Path(link.endpoint.host).unlink()
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        self._threads.append(_closed_aside(session))

    def _renew(self, link: _Link) -> None:
        """Replace the session of a link whose service has vanished."""
        self._put_aside(link)
        while not self._closed.is_set():
            try:
                self._open(link)
            except (TransportError, zenoh.ZError):
                # The session before still listens there: closing it can take a while.
                self._put_aside(link)
                self._closed.wait(_RETRY_FIRST_MS / 1e3)
            else:
                break
        if self._closed.is_set():
            self._put_aside(link)

    def _token_changed(self, link: _Link, generation: int, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        boot = key.split("/")[3]
        with self._calls.lock:
            if link.generation != generation:
                return
            if sample.kind == zenoh.SampleKind.PUT:
                if boot in link.boots or len(link.boots) >= _MAX_BOOTS:
                    return
                link.boots[boot] = link.newest = _Boot(boot, key)
                self._calls.appeared(link.service, boot)
                return
            gone = link.boots.pop(boot, None)
            if gone is None:
                return
            link.newest = next(reversed(link.boots.values()), None)
            # Zenoh ends these calls too, but only when it gives up the link.
            self._calls.vanished(link.service, boot, gone)
            if link.newest is not None:
                # An older one is still there: from now on it is the one that is called.
                self._calls.appeared(link.service, link.newest.boot)
            if not link.boots:
                link.generation += 1  # whatever this session still sees does not count
                link.keeper.post(partial(self._renew, link))

    def _send(
        self,
        link: _Link,
        boot: _Boot,
        pending: _ZenohCall,
        payload: bytes,
        attachment: bytes | None = None,
    ) -> None:
        """Send a request, or its last part, which is the one that is answered."""
        self._get(
            link,
            boot,
            pending,
            payload,
            attachment,
            partial(self._replied, pending),
            partial(self._ended, pending),
        )

    def _send_parts(self, link: _Link, outgoing: _Outgoing) -> None:
        """Send what may be sent now: a few parts ahead, and the last one after all others."""
        before_last = outgoing.count - 1
        while (
            outgoing.sent < before_last
            and outgoing.sent - outgoing.acknowledged < _PARTS_AT_ONCE
            and self._calls.is_pending(outgoing.pending)
        ):
            part, description = outgoing.part(outgoing.sent)
            outgoing.sent += 1
            sent = _PartSent()
            self._get(
                link,
                outgoing.boot,
                outgoing.pending,
                part,
                description,
                partial(self._part_replied, outgoing.pending, sent),
                lambda sent=sent: link.sender.post(  # type: ignore[misc]
                    partial(self._part_over, link, outgoing, sent)
                ),
            )
        if outgoing.acknowledged == before_last:
            part, description = outgoing.part(before_last)
            self._send(link, outgoing.boot, outgoing.pending, part, description)

    def _part_replied(self, pending: _ZenohCall, sent: _PartSent, reply: zenoh.Reply) -> None:
        sample = reply.ok
        if sample is None:
            return
        if len(sample.payload) == 0:
            sent.acknowledged = True
        else:
            # Refused before it is there as a whole; the other parts' refusals come too late.
            with self._calls.lock:
                self._replied(pending, reply)
                self._calls.ended(pending)

    def _part_over(self, link: _Link, outgoing: _Outgoing, sent: _PartSent) -> None:
        if sent.acknowledged:
            outgoing.acknowledged += 1
            self._send_parts(link, outgoing)
        else:
            self._calls.ended(outgoing.pending)

    def _get(
        self,
        link: _Link,
        boot: _Boot,
        pending: _ZenohCall,
        payload: bytes,
        attachment: bytes | None,
        replied: Callable[[zenoh.Reply], None],
        ended: Callable[[], None],
    ) -> None:
        session = link.session
        if session is None or not self._calls.is_pending(pending):
            return
        pending.sending_thread = threading.get_ident()
        try:
            session.get(
                boot.decide,
                zenoh.handlers.Callback(replied, ended, indirect=False),
                payload=payload,
                attachment=attachment,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=self._decision_timeout_s,
                express=True,
                cancellation_token=pending.cancellation,
            )
        except zenoh.ZError:
            self._courier.post(partial(self._calls.ended, pending))
        finally:
            pending.sending_thread = 0

    def _replied(self, pending: _ZenohCall, reply: zenoh.Reply) -> None:
        sample = reply.ok
        if sample is None:
            return  # Zenoh's own word that the time is up; the end follows.
        payload = sample.payload
        if len(payload) <= self._max_message_bytes:
            self._calls.replied(pending, payload.to_bytes())

    def _ended(self, pending: _ZenohCall) -> None:
        if pending.sending_thread == threading.get_ident():
            # Nobody is there: Zenoh says so from inside get, where our caller may hold a lock.
            self._courier.post(partial(self._calls.ended, pending))
        else:
            self._calls.ended(pending)

    def _refuse(self, pending: _ZenohCall, size_bytes: int) -> None:
        self._calls.replied(pending, too_large(size_bytes, self._max_message_bytes))
        self._calls.ended(pending)


class _ReceivedCall:
    """A request as the service sees it."""

    __slots__ = ("_ended", "_key", "_lock", "_payload", "_query", "_received", "_size_bytes")

    def __init__(
        self,
        query: zenoh.Query,
        received: zenoh.ZBytes | bytes | None,
        key: zenoh.KeyExpr,
        ended: Callable[[_ReceivedCall], None],
    ) -> None:
        self._query = query
        self._received = received
        self._size_bytes = 0 if received is None else len(received)
        self._key = key
        self._ended = ended
        self._lock = threading.Lock()
        self._payload: bytes | None = None

    @property
    def payload(self) -> bytes:
        """The request; copied when it is first asked for, which is not on Zenoh's thread."""
        if self._payload is None:
            self._payload = b"" if self._received is None else bytes(self._received)
            self._received = None
        return self._payload

    @property
    def size_bytes(self) -> int:
        """Of the request, without a copy of it."""
        return self._size_bytes

    def reply(self, payload: bytes) -> None:
        """Send a reply. A robot that is gone is no error."""
        with self._lock:
            try:
                self._query.reply(self._key, payload)
            except zenoh.ZError:
                return  # The call has ended, or the session is closed.

    def end(self) -> None:
        """End the call. May be repeated."""
        with self._lock:
            self._query.drop()
        self._ended(self)


class _Incoming:
    """A request of which parts have come."""

    __slots__ = ("count", "parts", "size_bytes")

    def __init__(self, count: int) -> None:
        self.count = count
        self.parts: dict[int, bytes] = {}
        self.size_bytes = 0


class _Assembly:
    """Puts requests together from their parts; forgets the oldest when they become too many."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._incoming: dict[bytes, _Incoming] = {}
        self._size_bytes = 0

    def add(self, name: bytes, index: int, count: int, part: bytes) -> bytes | None:
        """Take a part; return the request if this was the last one and all are there."""
        incoming = self._incoming.pop(name, None) or _Incoming(count)
        self._size_bytes -= incoming.size_bytes
        parts = incoming.parts
        if index == incoming.count - 1:
            if len(parts) < index:
                return None
            return b"".join((*(parts[number] for number in range(index)), part))
        # By the upload's own count, which a part that claims another one cannot change.
        if index < incoming.count and index not in parts and len(part) >= _SMALLEST_PART_BYTES:
            parts[index] = part
            incoming.size_bytes += len(part)
        self._incoming[name] = incoming  # the newest now
        self._size_bytes += incoming.size_bytes
        while self._size_bytes > self._max_bytes or len(self._incoming) > _UPLOADS:
            self._size_bytes -= self._incoming.pop(next(iter(self._incoming))).size_bytes
        return None


class _ShortAnswer:
    """Ends a query, after a reply if there is one."""

    __slots__ = ("_key", "_query", "_reply", "lane")

    def __init__(
        self, query: zenoh.Query, key: zenoh.KeyExpr, reply: bytes | None, lane: bytes
    ) -> None:
        self._query = query
        self._key = key
        self._reply = reply
        self.lane = lane

    def send(self) -> None:
        with self._query, contextlib.suppress(zenoh.ZError):  # the session is being closed
            if self._reply is not None:
                self._query.reply(self._key, self._reply)


class ZenohServiceTransport:
    """The service's end: see :class:`~holdfast.runtime.transport.contract.ServiceTransport`.

    Parameters
    ----------
    name : str
        Under which robots know the service.
    boot : str
        Of this process; no other one may ever have had it.
    listen, connect : sequence of str
        Endpoints at which robots connect, and of robots that listen.
    lease_ms : float
        A link over which nothing comes for this long is given up.
    max_message_bytes : int
        A larger request is refused before it is copied or read.
    tls : TlsFiles or None
        The service's credentials, for ``tls`` and ``quic``.

    Raises
    ------
    TransportError
        If an endpoint, the name or the boot cannot be used.
    """

    def __init__(
        self,
        name: str,
        *,
        boot: str,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        lease_ms: float = 400.0,
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
        tls: TlsFiles | None = None,
    ) -> None:
        _check_name("name of a service", name)
        _check_name("boot of a service", boot)
        if not listen and not connect:
            raise TransportError(
                f"service {name} has no endpoint: give one, as in tcp/127.0.0.1:7447"
            )
        self._listen = [_checked(endpoint, tls, listens=True) for endpoint in listen]
        self._connect = [_checked(endpoint, tls, listens=False) for endpoint in connect]
        self._prefix = f"{_PREFIX}/{name}/{boot}"
        self._key = zenoh.KeyExpr(f"{self._prefix}/decide")
        self._lease_ms = lease_ms
        self._max_message_bytes = max_message_bytes
        self._tls = tls
        self._deliver: Callable[[IncomingCall], None] | None = None
        self._calls: set[_ReceivedCall] = set()
        self._assembly = _Assembly(_UPLOADED_MESSAGES * max_message_bytes)
        self._senders = Senders("holdfast-service-end")
        self._state = threading.Condition()
        self._deliveries = 0
        self._session: zenoh.Session | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._closing: threading.Thread | None = None
        self._closed = False

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where robots can connect; once started, with the ports that were free instead of 0."""
        return tuple(str(endpoint) for endpoint in self._listen)

    def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Listen, be seen, and deliver calls; returns when robots can connect.

        Raises
        ------
        TransportError
            If it cannot listen there; the message names the endpoint.
        """
        if self._closed or self._session is not None:
            raise TransportError(f"service {self._prefix} was started before")
        self._deliver = deliver
        self._senders.start()
        atexit.register(self.close)
        self._session, self._listen = _opened(
            listen=self._listen,
            connect=self._connect,
            access=_access(coming=_FROM_ROBOT, going=_FROM_SERVICE),
            lease_ms=self._lease_ms,
            max_received_bytes=_LARGEST_MESSAGE_BYTES,
            tls=self._tls,
        )
        # In this order: who sees the token must find the queryable.
        self._session.declare_queryable(
            self._key, zenoh.handlers.Callback(self._received, indirect=False)
        )
        self._token = self._session.liveliness().declare_token(f"{self._prefix}/alive")

    def close(self, timeout_s: float = 1.0) -> None:
        """Be seen no more, end all calls, and close all links. May be repeated."""
        deadline_s = monotonic() + timeout_s
        atexit.unregister(self.close)
        with self._state:
            self._closed = True
            self._deliver = None
            self._state.wait_for(lambda: self._deliveries == 0, timeout_s)
            calls = list(self._calls)
            session, self._session = self._session, None
            token, self._token = self._token, None
        if session is not None:
            self._closing = _closed_aside(session, partial(_take_leave, token, calls))
        self._senders.close(deadline_s)
        if self._closing is not None:
            join_until([self._closing], deadline_s)

    def _received(self, query: zenoh.Query) -> None:
        payload = query.payload
        attachment = query.attachment
        if attachment is not None:
            self._received_part(query, b"" if payload is None else payload.to_bytes(), attachment)
        elif payload is not None and len(payload) > self._max_message_bytes:
            self._refuse(query, len(payload))
        else:
            self._hand_over(query, payload)

    def _received_part(self, query: zenoh.Query, part: bytes, attachment: zenoh.ZBytes) -> None:
        try:
            name, size_bytes, index, count = _PART.unpack(attachment.to_bytes())
        except struct.error:
            # Of another version; the robot sees a call that ends without an answer.
            self._answer(query, None, NOBODY)
            return
        if size_bytes > self._max_message_bytes:
            self._refuse(query, size_bytes)
            return
        request = None
        if index < count <= 1 + size_bytes // _SMALLEST_PART_BYTES:
            with self._state:
                request = self._assembly.add(name, index, count, part)
        if request is not None and len(request) == size_bytes:
            self._hand_over(query, request)
            return
        # A last part that does not complete its request ends without an answer.
        self._answer(query, b"" if index < count - 1 else None, name)

    def _refuse(self, query: zenoh.Query, size_bytes: int) -> None:
        self._answer(query, too_large(size_bytes, self._max_message_bytes), NOBODY)

    def _answer(self, query: zenoh.Query, reply: bytes | None, lane: bytes) -> None:
        """Answer from a thread of our own: if it blocks, other robots' calls are to come in."""
        self._senders.post((_ShortAnswer(query, self._key, reply, lane),))

    def _hand_over(self, query: zenoh.Query, payload: zenoh.ZBytes | bytes | None) -> None:
        call = _ReceivedCall(query, payload, self._key, self._ended)
        with self._state:
            deliver = self._deliver
            if deliver is not None:
                self._calls.add(call)
                self._deliveries += 1
        if deliver is None:
            call.end()
            return
        try:
            # Not under the lock: a reply from in there can block while a robot does not read, and
            # the other robots' calls are to come in meanwhile.
            deliver(call)
        finally:
            with self._state:
                self._deliveries -= 1
                self._state.notify_all()

    def _ended(self, call: _ReceivedCall) -> None:
        with self._state:
            self._calls.discard(call)


def _take_leave(token: zenoh.LivelinessToken | None, calls: Iterable[_ReceivedCall]) -> None:
    if token is not None:
        token.undeclare()
    for call in calls:
        call.end()


def _closed_aside(
    session: zenoh.Session, before: Callable[[], object] | None = None
) -> threading.Thread:
    """Close a session on a thread that does not keep the process alive."""

    def close() -> None:
        try:
            if before is not None:
                before()
            session.close()
        except zenoh.ZError:
            return  # It gave up after ten seconds; there is nothing that we could do better.

    thread = threading.Thread(target=close, name="holdfast-close", daemon=True)
    thread.start()
    return thread


def _numbered(endpoint: Endpoint, generation: int) -> Endpoint:
    """Return the local socket of one session, near the one that is told to others."""
    return endpoint._replace(host=f"{endpoint.host}.{generation}")


def _point(endpoint: Endpoint, place: Endpoint) -> None:
    """Let the path of a local socket lead to another one.

    A session that is being closed keeps its socket for a while, and in the end removes it by name;
    so each session has a socket of its own, and who connects follows the path to the newest.
    """
    path = Path(endpoint.host)
    link = Path(f"{endpoint.host}.link")
    try:
        if path.exists() and not path.is_symlink():
            raise TransportError(f"cannot listen on {endpoint}: there is a file of that name")
        link.unlink(missing_ok=True)
        link.symlink_to(Path(place.host).name)
        link.replace(path)
    except OSError as error:
        raise TransportError(f"cannot listen on {endpoint}: {error.strerror}") from error


def _checked(text: str, tls: TlsFiles | None, *, listens: bool) -> Endpoint:
    endpoint = parse_endpoint(text)
    check_credentials(endpoint, tls)
    if not listens and endpoint.port == 0 and not endpoint.is_local_socket:
        raise TransportError(
            f"endpoint {endpoint}: port 0 is for listening; to connect, give the port, "
            f"as in {endpoint.with_port(7447)}"
        )
    return endpoint


def _check_name(what: str, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise TransportError(
            f"{what} {name!r}: allowed are 1 to 100 letters, digits, '_', '-' and '.', "
            f"beginning with a letter or digit"
        )


def _opened(
    *,
    listen: list[Endpoint],
    connect: list[Endpoint],
    access: dict[str, object],
    lease_ms: float,
    max_received_bytes: int,
    tls: TlsFiles | None,
) -> tuple[zenoh.Session, list[Endpoint]]:
    """Open a session; return it and where it listens."""
    # Read by Zenoh when the first session of the process is opened.
    os.environ.setdefault("ZENOH_RUNTIME", _THREADS)
    any_port = any(each.port == 0 and not each.is_local_socket for each in listen)
    for attempt in range(_FREE_PORT_ATTEMPTS):
        places = [
            each if each.port or each.is_local_socket else each.with_port(free_port(each))
            for each in listen
        ]
        settings = _settings(places, connect, access, lease_ms, max_received_bytes, tls)
        try:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(settings))), places
        except zenoh.ZError as error:
            # Somebody else may have taken the free port since.
            if any_port and "os error 98" in str(error) and attempt < _FREE_PORT_ATTEMPTS - 1:
                continue
            where = ", ".join(map(str, places or connect))
            verb = "listen on" if places else "connect to"
            raise TransportError(f"cannot {verb} {where}: {_reason(error)}") from error
    raise AssertionError  # not reached


def _reason(error: zenoh.ZError) -> str:
    """Return what a person can use of Zenoh's message, which names places in its source."""
    text = str(error)
    if "SocketStream" in text and "EAGAIN" in text:
        return "another process listens there"
    found = re.search(r"([^:\[\]]+) \(os error \d+\)", text)
    return found[1].strip() if found else re.sub(r" at /\S+", "", text)


def connection_error(endpoint: Endpoint, tls: TlsFiles | None, timeout_s: float) -> str | None:
    """Connect once as a robot does, and hang up; return Zenoh's own words if that fails.

    Parameters
    ----------
    endpoint : Endpoint
    tls : TlsFiles or None
        The robot's credentials.
    timeout_s : float

    Returns
    -------
    str or None
        None if the link could be opened.
    """
    settings = _settings(
        [],
        [endpoint],
        _access(coming=_FROM_SERVICE, going=_FROM_ROBOT),
        1e3 * timeout_s,
        _HEADER_BYTES,
        tls,
        open_timeout_ms=max(1, round(1e3 * timeout_s)),
    )
    # One attempt, whose error is told.
    settings["connect"] = {
        "endpoints": [_in_zenoh_s_words(endpoint)],
        "exit_on_failure": True,
        "timeout_ms": 0,
    }
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        return str(error)
    _closed_aside(session)
    return None


def _access(*, coming: Sequence[str], going: Sequence[str]) -> dict[str, object]:
    """Return Zenoh's access control: these kinds of message, on our keys, and nothing else.

    Parameters
    ----------
    coming, going : sequence of str
        Kinds of message from the other ends, and to them.
    """
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": flow,
                "flows": [flow],
                "messages": list(messages),
                "key_exprs": [f"{_PREFIX}/**"],
                "permission": "allow",
            }
            for flow, messages in (("ingress", coming), ("egress", going))
        ],
        "subjects": [{"id": "everybody"}],
        "policies": [{"rules": ["ingress", "egress"], "subjects": ["everybody"]}],
    }


def _in_zenoh_s_words(endpoint: Endpoint) -> str:
    text = str(endpoint)
    return text.replace("unix/", "unixsock-stream/", 1) if endpoint.is_local_socket else text


def _settings(
    listen: list[Endpoint],
    connect: list[Endpoint],
    access: dict[str, object],
    lease_ms: float,
    max_received_bytes: int,
    tls: TlsFiles | None,
    open_timeout_ms: int = _OPEN_TIMEOUT_MS,
) -> dict[str, object]:
    link: dict[str, object] = {
        "protocols": sorted({_in_zenoh_s_words(e).split("/")[0] for e in [*listen, *connect]}),
        "tx": {
            "lease": round(lease_ms),
            "batch_size": _BATCH_BYTES,
            "queue": {
                "size": {"data": _BATCHES_QUEUED},
                "congestion_control": {
                    "block": {"wait_before_close": round(_BLOCKED_SEND_LEASES * lease_ms * 1e3)}
                },
            },
        },
        "rx": {"max_message_size": max_received_bytes},
    }
    if tls is not None:
        link["tls"] = {
            "root_ca_certificate": str(tls.authority),
            "listen_private_key": str(tls.key),
            "listen_certificate": str(tls.certificate),
            "connect_private_key": str(tls.key),
            "connect_certificate": str(tls.certificate),
            "enable_mtls": True,
            "verify_name_on_connect": True,
        }
    retry = {
        "period_init_ms": _RETRY_FIRST_MS,
        "period_max_ms": _RETRY_MAX_MS,
        "period_increase_factor": 2,
    }
    return {
        "mode": "peer",
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "listen": {"endpoints": [*map(_in_zenoh_s_words, listen)], "exit_on_failure": True},
        "connect": {
            "endpoints": [*map(_in_zenoh_s_words, connect)],
            "exit_on_failure": False,
            "retry": retry,
        },
        "open": {"return_conditions": {"connect_scouted": False}},
        "access_control": access,
        "transport": {
            "unicast": {
                "open_timeout": open_timeout_ms,
                "accept_timeout": open_timeout_ms,
                "max_sessions": MAX_ROBOTS,
            },
            "shared_memory": {"enabled": False},
            "link": link,
        },
    }
