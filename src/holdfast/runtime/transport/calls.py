"""What both wires' ends have in common: the table of calls in flight, and a thread for errands.

A call that has ended must stay ended, although its end can come from four sides at once: the
service ends it, the service vanishes, the robot abandons it, the transport closes. The table
settles that: whoever takes the call out of it delivers its end, and what comes later finds nothing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from queue import SimpleQueue

from holdfast.errors import InvalidValueError
from holdfast.runtime.last_threads import join_until
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent, Vanished

__all__ = ["DEFAULT_MAX_MESSAGE_BYTES", "CallTable", "Courier", "PendingCall", "too_large"]

DEFAULT_MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""Bound on a message, unless told otherwise: a state of a million particles fills 56 MB."""


def too_large(size_bytes: int, max_message_bytes: int) -> bytes:
    """Return the reply to a request that is larger than allowed, which therefore nobody reads."""
    # Imported here because it brings NumPy along, which a transport does not need otherwise.
    from holdfast.session.messages import Refused, encode

    return encode(
        Refused(
            0,
            "too_large",
            f"a request of {size_bytes} bytes: at most {max_message_bytes} are allowed",
        )
    )


class PendingCall:
    """A call in flight.

    Attributes
    ----------
    number : int
        The robot's name for it.
    peer : hashable
        Whom it was sent to.
    """

    __slots__ = ("number", "peer")

    def __init__(self, number: int, peer: Hashable) -> None:
        self.number = number
        self.peer = peer


class CallTable:
    """Calls in flight of one robot's end; delivers each one's events in order and one end.

    Events are delivered while the table is locked. So an event that is on its way when a call is
    abandoned or the table is closed has either arrived by then or never does.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._calls: dict[int, PendingCall] = {}
        self._deliver: Callable[[TransportEvent], None] | None = None

    @property
    def lock(self) -> threading.RLock:
        """Held during every delivery; for what must not change meanwhile."""
        return self._lock

    def open(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to deliver."""
        with self._lock:
            self._deliver = deliver

    def begin(self, call: PendingCall) -> bool:
        """Enter a call; return False if the table is closed.

        Raises
        ------
        InvalidValueError
            If a call of this number is in flight.
        """
        with self._lock:
            if self._deliver is None:
                return False
            if call.number in self._calls:
                raise InvalidValueError(f"call {call.number} is in flight already")
            self._calls[call.number] = call
            return True

    def is_pending(self, call: PendingCall) -> bool:
        """Whether a call has neither ended nor been abandoned."""
        return self._calls.get(call.number) is call

    def replied(self, call: PendingCall, payload: bytes) -> None:
        """Deliver a reply, if the call is still in flight."""
        with self._lock:
            if self._deliver is not None and self._calls.get(call.number) is call:
                self._deliver(Replied(call.number, payload))

    def ended(self, call: PendingCall) -> None:
        """Deliver the end of a call, if it is still in flight."""
        with self._lock:
            if self._deliver is not None and self._calls.get(call.number) is call:
                del self._calls[call.number]
                self._deliver(Ended(call.number))

    def abandon(self, number: int) -> PendingCall | None:
        """Take a call out without delivering anything."""
        with self._lock:
            return self._calls.pop(number, None)

    def appeared(self, service: str, boot: str) -> None:
        """Deliver that a service is there."""
        with self._lock:
            if self._deliver is not None:
                self._deliver(Appeared(service, boot))

    def vanished(self, service: str, boot: str, peer: Hashable) -> None:
        """Deliver that a service is gone, then the ends of its calls."""
        with self._lock:
            if self._deliver is None:
                return
            self._deliver(Vanished(service, boot))
            for call in [call for call in self._calls.values() if call.peer == peer]:
                del self._calls[call.number]
                self._deliver(Ended(call.number))

    def close(self) -> None:
        """Forget all calls and deliver nothing more."""
        with self._lock:
            self._deliver = None
            self._calls.clear()


class Courier:
    """A thread that runs errands one after another, and does not keep the process alive.

    It starts with the first errand. After :meth:`stop` further errands are dropped.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._errands: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._stopped = False
        self._waiting = 0

    @property
    def is_idle(self) -> bool:
        """Whether no errand is waiting or under way."""
        return self._waiting == 0

    def post(self, errand: Callable[[], object]) -> None:
        """Run this after all that was posted before."""
        with self._lock:
            if self._stopped:
                return
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
            self._waiting += 1
            self._errands.put(errand)

    def stop(self, until: float) -> None:
        """Let the thread end after what it is doing; that is not waited for beyond this time."""
        with self._lock:
            if not self._stopped:
                self._stopped = True
                self._errands.put(None)
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            join_until((thread,), until)

    def _run(self) -> None:
        while (errand := self._errands.get()) is not None:
            if not self._stopped:
                errand()
            with self._lock:
                self._waiting -= 1
