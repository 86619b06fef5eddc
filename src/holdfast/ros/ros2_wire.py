"""ROS 2's wire as rmw_zenoh speaks it, without ROS: the typed service, and a way to one.

rmw_zenoh makes a service of a Zenoh queryable. Its key names domain, service, type and the type's
hash, the payload is the message in CDR, and an attachment says which client asks for the how
manieth time; the answer repeats it. What ``ros2 service list`` shows are liveliness tokens, whose
keys tell the same and more. (Source: the design document of ros2/rmw_zenoh.)

Nodes find each other through a router, ``rmw_zenohd``. A session here is its client, or it listens
itself. Zenoh ends a query whose service has died, so a dead service is noticed within
milliseconds; one that is stopped shows nothing, and is given up when its deadline has passed.

Zenoh's threads only hand over what has come: a service answers on one thread of its own, from a
queue with an end, and who comes when it is full is told so.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import os
import queue
import re
import struct
import threading
import traceback
from collections.abc import Callable
from time import monotonic, time_ns
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple, Self

from holdfast.errors import HoldfastError, InvalidValueError, TransportError
from holdfast.ros import messages
from holdfast.ros.active_sensing import ActiveSensing, Answer, ErrorCode, Request
from holdfast.transport.endpoints import why_not_bound

if TYPE_CHECKING:
    import zenoh

__all__ = [
    "DEFAULT_ROUTER",
    "MAX_DOMAIN",
    "NO_HASH",
    "Attachment",
    "Ros2Server",
    "Ros2Service",
    "check_domain",
    "check_service_name",
    "graph_tokens",
    "service_key",
]

DEFAULT_ROUTER = "tcp/localhost:7447"
"""Where rmw_zenoh's nodes look for their router."""

MAX_DOMAIN = 232
"""ROS 2 has the domains from 0 on."""

NO_HASH = "TypeHashNotSupported"
"""What Humble has in the place of a type's hash."""

_MAX_WAITING = 16
"""Requests that may wait for the one that is being answered."""

_OPEN_MS = 500
"""How long one try to reach an endpoint may take; close waits for it."""

_QUALITY_OF_SERVICE = "::,10:,:,:,,"
"""ROS 2's default for services: reliable, volatile, the last 10."""

_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MAX_NAME = 200
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_SIZE = 16

OnEvent = Callable[..., None]


class Attachment(NamedTuple):
    """What goes with a request, and comes back with its answer.

    Attributes
    ----------
    sequence_number : int
        The client's, from 0 up.
    source_timestamp : int
        When it was sent, in nanoseconds since 1970.
    gid : bytes
        The client's identity, 16 bytes.
    """

    sequence_number: int
    source_timestamp: int
    gid: bytes

    def encode(self) -> bytes:
        """Return its 33 bytes."""
        return _ATTACHMENT.pack(self.sequence_number, self.source_timestamp, _GID_SIZE, self.gid)

    @classmethod
    def decode(cls, data: bytes) -> Attachment:
        """Read one.

        Raises
        ------
        InvalidValueError
            If the bytes are none.
        """
        if len(data) == _ATTACHMENT.size:
            number, timestamp, size, gid = _ATTACHMENT.unpack(data)
            if size == _GID_SIZE and number >= 0 and timestamp >= 0:
                return cls(number, timestamp, gid)
        raise InvalidValueError(
            f"attachment of {len(data)} bytes: rmw_zenoh's has {_ATTACHMENT.size}, a sequence "
            f"number, a time and a GID of {_GID_SIZE} bytes"
        )


def check_domain(domain: int, key: str = "domain") -> int:
    """Return a domain of ROS 2.

    Raises
    ------
    InvalidValueError
        If it is none; the message names ``key``.
    """
    if not 0 <= domain <= MAX_DOMAIN:
        raise InvalidValueError(f"{key} {domain}: ROS 2's domains are from 0 to {MAX_DOMAIN}")
    return domain


def check_service_name(name: str, key: str = "name") -> str:
    """Return a service's name without the slash that it may begin with.

    Raises
    ------
    InvalidValueError
        If ROS 2 would not allow it; the message names ``key``.
    """
    if not _NAME.fullmatch(name) or "__" in name or len(name) > _MAX_NAME:
        raise InvalidValueError(
            f"{key} {name!r:.210}: a service's name consists of letters, digits and single "
            f"underscores, with slashes between its parts, none of which begins with a digit, and "
            f"has {_MAX_NAME} characters at most"
        )
    return name.removeprefix("/")


def _dds_type() -> str:
    package, kind, name = messages.SERVICE.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def service_key(domain: int, name: str, type_hash: str) -> str:
    """Return the key at which a service is asked."""
    return f"{domain}/{name}/{_dds_type()}/{type_hash}"


def graph_tokens(
    domain: int, session: str, name: str, node: str, *, serves: bool
) -> tuple[str, str]:
    """Return the keys of the tokens that show a node, and its service or its client of one.

    Parameters
    ----------
    domain : int
    session : str
        Zenoh's identifier of the session.
    name, node : str
        Of the service and of the node; the node is in the root namespace.
    serves : bool
        Whether the node offers the service, or asks it.
    """
    identity = f"@ros2_lv/{domain}/{session}/0"
    kind = "SS" if serves else "SC"
    service = f"%{name.replace('/', '%')}/{_dds_type()}/{messages.type_hash()}"
    return (
        f"{identity}/0/NN/%/%/{node}",
        f"{identity}/1/{kind}/%/%/{node}/{service}/{_QUALITY_OF_SERVICE}",
    )


class _Session:
    """A Zenoh session, which is opened when somebody listens at the other end.

    Parameters
    ----------
    endpoint : str
    listens : bool
        Whether the session listens at the endpoint, or connects to it.
    on_open : callable
        Declares what the session offers, on the thread that has opened it.
    on_event : callable
    """

    def __init__(
        self,
        endpoint: str,
        *,
        listens: bool,
        on_open: Callable[[zenoh.Session], None],
        on_event: OnEvent,
    ) -> None:
        self._zenoh = zenoh_module()
        self._endpoint = endpoint
        self._listens = listens
        self._on_open = on_open
        self._on_event = on_event
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._session: zenoh.Session | None = None
        self._reason = ""
        self._closed = False
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Listen, or begin to connect.

        Raises
        ------
        TransportError
            If the endpoint cannot be listened at.
        """
        if self._listens:
            self._open()
        else:
            self._thread = threading.Thread(target=self._connect, name="zenoh-open", daemon=True)
            self._thread.start()

    def get(self, until: float) -> zenoh.Session:
        """Return the session; wait for it until this time of the monotonic clock.

        Raises
        ------
        TransportError
            If nobody listens at the endpoint, or this is closed.
        """
        with self._changed:
            while self._session is None:
                left = until - monotonic()
                if self._closed or self._reason or left <= 0:
                    raise TransportError(
                        f"{self._endpoint}: "
                        f"{'closed' if self._closed else self._reason or 'not connected yet'}"
                    )
                self._changed.wait(left)
            return self._session

    def close(self) -> None:
        """End the session and all that was declared with it; may be repeated."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
        with self._lock:
            session, self._session = self._session, None
        if session is not None:
            with contextlib.suppress(self._zenoh.ZError):
                session.close()

    def _connect(self) -> None:
        pause_s = 0.1
        while True:
            try:
                self._open()
            except TransportError as error:
                with self._changed:
                    if not self._reason:
                        self._on_event("ros2_waiting", reason=str(error))
                    self._reason = str(error)
                    self._changed.notify_all()
                    if self._closed or self._changed.wait_for(lambda: self._closed, pause_s):
                        return
                pause_s = min(2 * pause_s, 1.0)
            else:
                return

    def _open(self) -> None:
        zenoh = self._zenoh
        try:
            session = zenoh.open(_configuration(self._endpoint, listens=self._listens))
        except zenoh.ZError as error:
            if not self._listens:
                why = "no router of Zenoh answers there"
                raise TransportError(f"cannot connect to {self._endpoint}: {why}") from error
            raise TransportError(
                f"cannot listen on {self._endpoint}: {_why_not_bound(error)}"
            ) from error
        try:
            self._on_open(session)
        except BaseException:
            session.close()
            raise
        with self._changed:
            self._session = session
            if self._reason:
                self._on_event("ros2_connected", endpoint=self._endpoint)
            self._reason = ""
            self._changed.notify_all()


def _why_not_bound(error: zenoh.ZError) -> str:
    """Return what the system has said; Zenoh says it in the midst of much else."""
    found = re.search(r"\(os error (\d+)\)", str(error))
    if found is None:
        return str(error)
    number = int(found[1])
    return why_not_bound(OSError(number, os.strerror(number)))


def _configuration(endpoint: str, *, listens: bool) -> zenoh.Config:
    """Return Zenoh's settings: one endpoint, nothing found by itself, nothing that takes long."""
    import zenoh

    configuration = zenoh.Config()
    settings = {
        "mode": "peer" if listens else "client",
        "listen/endpoints": [endpoint] if listens else [],
        "connect/endpoints": [] if listens else [endpoint],
        "connect/timeout_ms": _OPEN_MS,
        # A client goes on with this when its router has gone.
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 1000,
            "period_increase_factor": 2,
        },
        "listen/timeout_ms": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "open/return_conditions/connect_scouted": False,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": messages.MAX_BYTES + 65_536,
        # A megabyte may wait for a slow link; then whoever reads nothing may hold up a message for
        # so long, in microseconds.
        "transport/link/tx/queue/size/data": 16,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 50_000,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 200_000,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000,
    }
    for key, value in settings.items():
        configuration.insert_json5(key, json.dumps(value))
    return configuration


class Ros2Server:
    """Offers a typed service to nodes of ROS 2.

    Parameters
    ----------
    service : ActiveSensing
        It is asked on one thread.
    name : str
        The service's name in ROS 2.
    domain : int
    endpoint : str
        Of the router, or where to listen, as in ``tcp/localhost:7447``.
    listens : bool
    on_event : callable or None
        Is told what happens, from any thread: ``ros2_waiting`` (``reason``) while the
        router is not there, then ``ros2_connected`` (``endpoint``); ``ros2_refused``
        (``reason``) of a request that is none; ``ros2_failed`` (``reason``, ``where``) of a defect.

    Raises
    ------
    InvalidValueError
        If a parameter cannot be used, or Zenoh or rosbags is not installed.
    """

    def __init__(
        self,
        service: ActiveSensing,
        name: str,
        domain: int,
        endpoint: str = DEFAULT_ROUTER,
        *,
        listens: bool = False,
        on_event: OnEvent | None = None,
    ) -> None:
        self._service = service
        self._name = check_service_name(name)
        self._domain = check_domain(domain)
        self._on_event = on_event or _ignore
        self._busy_answer = messages.encode_answer(
            service.refusal(ErrorCode.BUSY, f"{_MAX_WAITING} requests are waiting already")
        )
        self._requests: queue.SimpleQueue[_Query | None] = queue.SimpleQueue()
        self._takes_requests = True
        self._num_open = 0
        self._lock = threading.Lock()
        self._zenoh_error = zenoh_module().ZError
        self._tokens: list[zenoh.LivelinessToken] = []
        self._session = _Session(
            endpoint, listens=listens, on_open=self._declare, on_event=self._on_event
        )
        self._worker = threading.Thread(target=self._work, name="ros2-service", daemon=True)

    def start(self) -> None:
        """Offer the service; with a router, as soon as that is there.

        Raises
        ------
        TransportError
            If nothing can listen at the endpoint.
        """
        self._session.open()
        self._worker.start()

    @property
    def is_busy(self) -> bool:
        """Whether answers are owed."""
        return self._num_open > 0

    def take_no_more(self) -> None:
        """Answer what is waiting, and tell whoever comes now that this service is busy."""
        self._takes_requests = False

    def close(self, timeout_s: float) -> None:
        """Stop; wait so long at most for a request that is being answered."""
        self._takes_requests = False
        if self._worker.ident is not None:
            with contextlib.suppress(queue.Empty):
                while (waiting := self._requests.get_nowait()) is not None:
                    # Without an answer, which ends it at the other side.
                    waiting.query.drop()
                    with self._lock:
                        self._num_open -= 1
            self._requests.put(None)
            self._worker.join(timeout_s)
        self._session.close()

    def _declare(self, session: zenoh.Session) -> None:
        for type_hash in (messages.type_hash(), NO_HASH):
            key = service_key(self._domain, self._name, type_hash)
            session.declare_queryable(key, functools.partial(self._hand_over, key), complete=True)
        # After them: who sees the service can ask it.
        node = self._name.rpartition("/")[2]
        zid = str(session.zid())
        tokens = graph_tokens(self._domain, zid, self._name, node, serves=True)
        self._tokens = [session.liveliness().declare_token(token) for token in tokens]

    def _hand_over(self, key: str, query: zenoh.Query) -> None:
        """Queue a request; this is one of Zenoh's threads."""
        try:
            attached = query.attachment
            attachment = Attachment.decode(b"" if attached is None else attached.to_bytes())
        except InvalidValueError as error:
            self._on_event("ros2_refused", reason=str(error))
            query.reply_err(str(error))
            query.drop()
            return
        waiting = _Query(query, key, attachment)
        with self._lock:
            takes_it = self._takes_requests and self._num_open <= _MAX_WAITING
            self._num_open += takes_it
        if takes_it:
            self._requests.put(waiting)
        else:
            self._reply(waiting, self._busy_answer)

    def _work(self) -> None:
        while (waiting := self._requests.get()) is not None:
            try:
                self._reply(waiting, self._answer(waiting.query))
            except Exception as error:  # noqa: BLE001 - else nobody would be answered any more
                reason = f"{type(error).__name__}: {error}"
                where = traceback.extract_tb(error.__traceback__)[-1]
                self._on_event("ros2_failed", reason=reason, where=f"{where.name}:{where.lineno}")
                with contextlib.suppress(self._zenoh_error):
                    waiting.query.reply_err(f"a defect of the service: {reason}")
                    waiting.query.drop()
            finally:
                with self._lock:
                    self._num_open -= 1
            # Nothing of it is held while the thread waits for the next.
            del waiting

    def _answer(self, query: zenoh.Query) -> bytes:
        try:
            payload = query.payload
            request = messages.decode_request(b"" if payload is None else payload.to_bytes())
        except HoldfastError as error:
            self._on_event("ros2_refused", reason=str(error))
            answer = self._service.refusal(ErrorCode.BAD_REQUEST, str(error))
        else:
            answer = self._service.answer(request)
        return messages.encode_answer(answer)

    def _reply(self, waiting: _Query, answer: bytes) -> None:
        query, key, asked = waiting
        attachment = asked._replace(source_timestamp=time_ns())
        try:
            query.reply(key, answer, encoding="application/cdr", attachment=attachment.encode())
            query.drop()
        except self._zenoh_error as error:
            self._on_event("ros2_refused", reason=f"the answer cannot be sent: {error}")


class _Query(NamedTuple):
    """A request that waits."""

    query: zenoh.Query
    key: str
    attachment: Attachment


class Ros2Service:
    """A way to a typed service that a node of ROS 2, or :class:`Ros2Server`, offers.

    It implements :class:`holdfast.ros.client.Service`.

    Parameters
    ----------
    name : str
        The service's name in ROS 2.
    domain : int
    endpoint : str
        Of the router, or of a service that listens itself.
    type_hash : str or None
        What stands for the type's hash in the key: :data:`NO_HASH` for a node of Humble; None
        takes the hash.

    Raises
    ------
    InvalidValueError
        If a parameter cannot be used, or Zenoh or rosbags is not installed.
    """

    def __init__(
        self,
        name: str,
        domain: int,
        endpoint: str = DEFAULT_ROUTER,
        *,
        type_hash: str | None = None,
    ) -> None:
        self.name = check_service_name(name)
        self._domain = check_domain(domain)
        self._key = service_key(self._domain, self.name, type_hash or messages.type_hash())
        self._gid = os.urandom(_GID_SIZE)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._open: set[queue.SimpleQueue[zenoh.Reply | None]] = set()
        self._closed = False
        self._session = _Session(endpoint, listens=False, on_open=self._declare, on_event=_ignore)
        self._session.open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def ask(self, request: Request, deadline_s: float) -> Answer:
        """Ask, and wait for the answer for so long at most.

        Only sending may take longer, by 0.2 s: a megabyte to somebody who reads nothing.

        Raises
        ------
        TransportError
            If there is no answer; the message says why.
        InvalidValueError
            If the request cannot be written as a message.
        """
        until = monotonic() + deadline_s
        payload = messages.encode_request(request)
        session = self._session.get(until)
        attachment = Attachment(next(self._numbers), time_ns(), self._gid)
        replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        with self._lock:
            self._open.add(replies)
        cancellation = zenoh_module().CancellationToken()
        try:
            self._send(session, replies, payload, attachment, cancellation, deadline_s)
            return self._first_answer(replies, attachment, until, deadline_s)
        finally:
            with self._lock:
                self._open.discard(replies)
            cancellation.cancel()

    def close(self) -> None:
        """End what is being asked; may be called from another thread, and repeated."""
        with self._lock:
            self._closed = True
            for replies in self._open:
                replies.put(None)
        self._session.close()

    def _declare(self, session: zenoh.Session) -> None:
        node = f"{self.name.rpartition('/')[2]}_client"
        zid = str(session.zid())
        tokens = graph_tokens(self._domain, zid, self.name, node, serves=False)
        self._tokens = [session.liveliness().declare_token(token) for token in tokens]

    def _send(
        self,
        session: zenoh.Session,
        replies: queue.SimpleQueue[zenoh.Reply | None],
        payload: bytes,
        attachment: Attachment,
        cancellation: zenoh.CancellationToken,
        deadline_s: float,
    ) -> None:
        zenoh = zenoh_module()
        try:
            session.get(
                self._key,
                zenoh.handlers.Callback(replies.put, lambda: replies.put(None), indirect=False),
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                # Else a service that reads nothing would hold up whoever asks it.
                congestion_control=zenoh.CongestionControl.DROP,
                timeout=deadline_s + 1.0,
                payload=payload,
                encoding="application/cdr",
                attachment=attachment.encode(),
                cancellation_token=cancellation,
            )
        except zenoh.ZError as error:
            raise TransportError(f"{self.name} cannot be asked: {error}") from None

    def _first_answer(
        self,
        replies: queue.SimpleQueue[zenoh.Reply | None],
        attachment: Attachment,
        until: float,
        deadline_s: float,
    ) -> Answer:
        """Return the first answer; one that says that it is not one only if there is no other."""
        refusal: Answer | None = None
        reason = "nobody offers it, or who did has died"
        while True:
            try:
                reply = replies.get(timeout=max(until - monotonic(), 0.0))
            except queue.Empty:
                reason = f"no answer in {deadline_s:g} s"
                reply = None
            if reply is None:
                if refusal is not None:
                    return refusal
                if self._closed:
                    reason = "closed"
                raise TransportError(f"{self.name}: {reason}")
            try:
                answer = self._read(reply, attachment)
            except HoldfastError as error:
                reason = str(error)
                continue
            if answer.error not in (ErrorCode.BUSY, ErrorCode.OTHER_CONFIGURATION):
                return answer
            refusal = answer

    def _read(self, reply: zenoh.Reply, attachment: Attachment) -> Answer:
        sample = reply.ok
        if sample is None:
            error = reply.err
            told = b"" if error is None else error.payload.to_bytes()
            raise TransportError(f"it has answered: {told[:500].decode(errors='replace')!r}")
        if sample.attachment is None:
            raise TransportError("an answer without an attachment")
        answered = Attachment.decode(sample.attachment.to_bytes())
        if (answered.sequence_number, answered.gid) != (
            attachment.sequence_number,
            attachment.gid,
        ):
            raise TransportError("an answer to another request")
        return messages.decode_answer(sample.payload.to_bytes())


def zenoh_module() -> ModuleType:
    """Return the module zenoh, which is imported only if it is needed.

    Raises
    ------
    InvalidValueError
        If it is not installed; the message says what mends it.
    """
    try:
        import zenoh
    except ImportError as error:
        raise InvalidValueError(
            f"ROS 2's wire needs eclipse-zenoh: pip install 'holdfast[ros]' ({error})"
        ) from error
    return zenoh


def _ignore(_name: str, **_fields: object) -> None:
    """Do nothing."""
