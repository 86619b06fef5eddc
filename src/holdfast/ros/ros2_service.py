"""The typed service on rmw_zenoh's wire, without ROS.

Zenoh's threads only queue requests. One thread answers them; a request that finds the queue full is
refused as busy, so that the client can ask another service.
"""

from __future__ import annotations

import contextlib
import functools
import queue
import threading
import traceback
from time import time_ns
from typing import TYPE_CHECKING, NamedTuple

from holdfast.errors import InvalidValueError
from holdfast.ros import messages
from holdfast.ros.active_sensing import ActiveSensing, ErrorCode
from holdfast.ros.ros2_keys import (
    NO_HASH,
    Attachment,
    check_domain,
    check_service_name,
    graph_tokens,
    service_key,
)
from holdfast.ros.zenoh_session import (
    DEFAULT_ROUTER,
    OnEvent,
    ZenohSession,
    ignore_event,
    zenoh_module,
)

if TYPE_CHECKING:
    import zenoh

__all__ = ["Ros2Server"]

_MAX_WAITING = 16
"""Requests that may wait besides the one that is being answered."""


class Ros2Server:
    """Offers a typed service to nodes of ROS 2.

    ``endpoint`` is the router's, or where to listen, as in ``tcp/localhost:7447``. ``on_event`` is
    called from any thread: with ``ros2_waiting`` (``reason``) while the router is not there, then
    ``ros2_connected`` (``endpoint``); with ``ros2_refused`` (``reason``) of a request that is none,
    and ``ros2_failed`` (``reason``, ``where``) of a defect.

    Raises InvalidValueError if a parameter cannot be used, or Zenoh or rosbags is not installed.
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
        self._on_event = on_event or ignore_event
        self._busy_answer = messages.encode_answer(
            service.refusal(ErrorCode.BUSY, f"{_MAX_WAITING} requests are waiting already")
        )
        self._requests: queue.SimpleQueue[_Query | None] = queue.SimpleQueue()
        self._takes_requests = True
        self._num_open = 0
        self._lock = threading.Lock()
        self._zenoh_error = zenoh_module().ZError
        self._tokens: list[zenoh.LivelinessToken] = []
        self._session = ZenohSession(
            endpoint, listens=listens, on_open=self._declare, on_event=self._on_event
        )
        self._worker = threading.Thread(target=self._work, name="ros2-service", daemon=True)

    def start(self) -> None:
        """Offer the service; with a router, as soon as that is there.

        Raises TransportError if nothing can listen at the endpoint.
        """
        self._session.open()
        self._worker.start()

    @property
    def is_busy(self) -> bool:
        """Whether answers are owed."""
        return self._num_open > 0

    def take_no_more(self) -> None:
        """Answer the waiting requests, and refuse later ones as busy."""
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
            except Exception as error:  # noqa: BLE001 - else no later request would be answered
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
        payload = query.payload
        return messages.answer_message(
            self._service,
            b"" if payload is None else payload.to_bytes(),
            on_refused=lambda reason: self._on_event("ros2_refused", reason=reason),
        )

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
