"""A client of the typed service on rmw_zenoh's wire, without ROS.

Zenoh ends a query whose service has died, so a dead service is noticed within milliseconds. A
stopped service gives no sign; the request ends at its deadline.
"""

from __future__ import annotations

import itertools
import os
import queue
import threading
from time import monotonic, time_ns
from typing import TYPE_CHECKING, Self

from holdfast.errors import HoldfastError, TransportError
from holdfast.ros import messages
from holdfast.ros.active_sensing import ANOTHER_MAY_ANSWER, DecisionAnswer, DecisionRequest
from holdfast.ros.ros2_keys import (
    GID_SIZE,
    Attachment,
    check_domain,
    check_service_name,
    graph_tokens,
    service_key,
)
from holdfast.ros.zenoh_session import DEFAULT_ROUTER, ZenohSession, ignore_event, zenoh_module

if TYPE_CHECKING:
    import zenoh

__all__ = ["Ros2Service"]


class Ros2Service:
    """A client of one typed service; a :class:`~holdfast.ros.client.DecisionService`.

    The service may be a node of ROS 2 or a :class:`~holdfast.ros.ros2_service.Ros2Server`.

    Parameters
    ----------
    name : str
        The service's name in ROS 2.
    endpoint : str
        Of the router, or of a service that listens itself.
    type_hash : str or None
        Replaces the type's hash in the key, such as :data:`~holdfast.ros.ros2_keys.NO_HASH` for a
        node of Humble.

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
        self._gid = os.urandom(GID_SIZE)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._open: set[queue.SimpleQueue[zenoh.Reply | None]] = set()
        self._closed = False
        self._session = ZenohSession(
            endpoint, listens=False, on_open=self._declare, on_event=ignore_event
        )
        self._session.open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        """Ask, and wait at most ``deadline_s`` for the answer.

        Sending a megabyte to a service that reads nothing may take 0.2 s longer.

        Raises
        ------
        TransportError
            If there is no answer; the message gives the reason.
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
        """End all requests; may be called from another thread, and repeated."""
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
                # Else a service that reads nothing would block its clients.
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
    ) -> DecisionAnswer:
        """Return the first answer, or a refusal if every service refuses."""
        refusal: DecisionAnswer | None = None
        reason = "no such service, or it has died"
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
            if answer.error not in ANOTHER_MAY_ANSWER:
                return answer
            refusal = answer

    def _read(self, reply: zenoh.Reply, attachment: Attachment) -> DecisionAnswer:
        sample = reply.ok
        if sample is None:
            error = reply.err
            text = b"" if error is None else error.payload.to_bytes()
            raise TransportError(f"it has answered: {text[:500].decode(errors='replace')!r}")
        if sample.attachment is None:
            raise TransportError("an answer without an attachment")
        answered = Attachment.decode(sample.attachment.to_bytes())
        if (answered.sequence_number, answered.gid) != (
            attachment.sequence_number,
            attachment.gid,
        ):
            raise TransportError("an answer to another request")
        return messages.decode_answer(sample.payload.to_bytes())
