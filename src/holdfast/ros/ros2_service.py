"""The typed service on rmw_zenoh's wire, without ROS.

Zenoh's threads only queue requests; another thread answers them.
"""

from __future__ import annotations

import contextlib
import functools
import traceback
from collections.abc import Callable
from time import time_ns
from typing import TYPE_CHECKING

from holdfast.errors import InvalidValueError
from holdfast.ros import messages
from holdfast.ros.active_sensing import ActiveSensing, ErrorCode
from holdfast.ros.decision_thread import DecisionThread
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
        self._decisions = DecisionThread(_MAX_WAITING)
        self._zenoh_error = zenoh_module().ZError
        messages.typestore()  # raises now what the first request would
        self._tokens: list[zenoh.LivelinessToken] = []
        self._session = ZenohSession(
            endpoint, listens=listens, on_open=self._declare, on_event=self._on_event
        )

    def start(self) -> None:
        """Offer the service; with a router, as soon as that is there.

        Raises TransportError if nothing can listen at the endpoint.
        """
        self._session.open()

    @property
    def is_busy(self) -> bool:
        """Whether answers are owed."""
        return self._decisions.is_busy

    def take_no_more(self) -> None:
        """Answer the waiting requests, and refuse later ones as busy."""
        self._decisions.take_no_more()

    def close(self, timeout_s: float) -> None:
        """Stop; wait so long at most for a request that is being answered."""
        self._decisions.close(timeout_s)
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
        send = functools.partial(self._send, query, key, attachment)
        future = self._decisions.submit(
            functools.partial(self._answer, query, send),
            lambda reason: send(
                messages.encode_answer(self._service.refusal(ErrorCode.BUSY, reason))
            ),
        )
        # Without an answer, which ends it at the other side.
        future.add_done_callback(lambda answered: query.drop() if answered.cancelled() else None)

    def _answer(self, query: zenoh.Query, send: Callable[[bytes], None]) -> None:
        try:
            payload = query.payload
            answer = messages.answer_message(
                self._service,
                b"" if payload is None else payload.to_bytes(),
                on_refused=lambda reason: self._on_event("ros2_refused", reason=reason),
            )
            send(answer)
        except Exception as error:  # noqa: BLE001 - else there would be no answer
            reason = f"{type(error).__name__}: {error}"
            where = traceback.extract_tb(error.__traceback__)[-1]
            self._on_event("ros2_failed", reason=reason, where=f"{where.name}:{where.lineno}")
            with contextlib.suppress(self._zenoh_error):
                query.reply_err(f"a defect of the service: {reason}")
                query.drop()

    def _send(self, query: zenoh.Query, key: str, asked: Attachment, answer: bytes) -> None:
        attachment = asked._replace(source_timestamp=time_ns())
        try:
            query.reply(key, answer, encoding="application/cdr", attachment=attachment.encode())
            query.drop()
        except self._zenoh_error as error:
            self._on_event("ros2_refused", reason=f"the answer cannot be sent: {error}")
