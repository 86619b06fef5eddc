"""A Zenoh session that opens as soon as the other end listens.

Nodes of ROS 2 find each other through a router, ``rmw_zenohd``. A session here is a client of that
router, or listens itself. Discovery is off: a session has exactly one endpoint.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import threading
from collections.abc import Callable
from time import monotonic
from types import ModuleType
from typing import TYPE_CHECKING

from holdfast.errors import InvalidValueError, TransportError
from holdfast.ros import messages
from holdfast.transport.endpoints import why_not_bound

if TYPE_CHECKING:
    import zenoh

__all__ = ["DEFAULT_ROUTER", "OnEvent", "ZenohSession", "ignore_event", "zenoh_module"]

DEFAULT_ROUTER = "tcp/localhost:7447"
"""The router's address that rmw_zenoh's nodes use by default."""

_OPEN_MS = 500
"""Longest time of one attempt to connect; ``close`` waits for it."""

OnEvent = Callable[..., None]


class ZenohSession:
    """A Zenoh session, opened as soon as the other end listens.

    It listens at the endpoint or connects to it. ``on_open`` declares what it offers, on the thread
    that has opened it.
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

        Raises TransportError if the endpoint cannot be listened at.
        """
        if self._listens:
            self._open()
        else:
            self._thread = threading.Thread(target=self._connect, name="zenoh-open", daemon=True)
            self._thread.start()

    def get(self, until: float) -> zenoh.Session:
        """Return the session; wait for it until this time of the monotonic clock.

        Raises TransportError if the endpoint does not answer, or this is closed.
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
        # A megabyte may wait for a slow link. After that a reader that stalls delays a message by
        # at most these times, in microseconds.
        "transport/link/tx/queue/size/data": 16,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 50_000,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 200_000,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000,
    }
    for key, value in settings.items():
        configuration.insert_json5(key, json.dumps(value))
    return configuration


def zenoh_module() -> ModuleType:
    """Return the module zenoh, which is imported only if it is needed.

    Raises InvalidValueError if it is not installed; the message says what mends it.
    """
    try:
        import zenoh
    except ImportError as error:
        raise InvalidValueError(
            f"ROS 2's wire needs eclipse-zenoh: pip install 'holdfast[ros]' ({error})"
        ) from error
    return zenoh


def ignore_event(_name: str, **_fields: object) -> None:
    """Do nothing."""
