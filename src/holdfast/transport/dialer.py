"""Connects to an endpoint, and retries until a peer is there.

A restarted service should be used at once, however far away it is. So a new attempt begins every 20
ms, in parallel to earlier ones, which may hang on a cut path or a stopped process. The pauses grow
with the outage (:class:`RetryPauses`).

A name may have several addresses, each of another process. Each robot tries them in its own order.
So robots spread over the processes, and a robot that loses a link returns to the process that knows
it. An address that refuses leads to the next one at once. Failures are reported with their reasons.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import math
import random
import socket
import threading
from collections.abc import Callable
from typing import Any, Final, TypeAlias

from holdfast.runtime.addresses import system_words
from holdfast.transport.endpoints import Endpoint
from holdfast.transport.links import Link

_FIRST_PAUSE_S: Final = 0.02
_LAST_PAUSE_S: Final = 10.0
_SHARE_OF_OUTAGE: Final = 0.02
_JITTER: Final = 0.25

_LAST_PAUSE_AFTER_NOTHING_S: Final = 0.2
_LASTING_S: Final = 1.0
"""A link that ends sooner, without an answer, counts as failed."""

_CONNECT_TIMEOUT_S: Final = 2.0
"""For one attempt; later ones run in parallel."""

_NEXT_LINK_S: Final = 0.25
_LAST_LINK_S: Final = 2.0
"""After a connection, no second one is made for so long: it may wait for its handshake."""

_LOOKUP_INTERVAL_S = 1.0
"""Between two look-ups of a host while no peer is reached."""

_REFUSED_PAUSE_S: Final = 1.0
_REFUSED_SHARE: Final = 0.1
"""After one end has refused the other, which has cost both a handshake."""

_Address: TypeAlias = str | tuple[Any, ...]


class RetryPauses:
    """How long to wait before each attempt: the longer, the longer the peer is gone.

    Waiting for the next attempt adds two per cent to an outage, and ten seconds at most. Pauses are
    up to a quarter longer by chance: robots that have lost one service do not stay in step.

    A peer that soon ends its connections is tried less often: the pause doubles with each, up to
    0.2 s. (It may be a proxy that accepts while its service starts.) A link that brought an answer,
    or lasted, resets the pause, so that a service that dies and restarts is found as fast as ever.

    A connection without a hello may hang, or wait behind a thousand others. So a second one follows
    after 0.25 s, and further ones after twice the time each, up to 2 s.
    """

    def __init__(self, chance: Callable[[], float] = random.random) -> None:
        self._chance = chance
        self._absent_since = math.inf
        self._next_link_s = _NEXT_LINK_S
        self.least_s = _FIRST_PAUSE_S

    def begin(self, now: float) -> None:
        """Note that the peer is gone."""
        self._absent_since = min(self._absent_since, now)

    def succeeded(self) -> None:
        """Note that the right peer is there: the outage is over."""
        self._absent_since = math.inf
        self._next_link_s = _NEXT_LINK_S

    def ended(self, *, useful: bool) -> None:
        """Note the end of a link, and whether it had answered or lasted."""
        self.least_s = min(2.0 * self.least_s, _LAST_PAUSE_AFTER_NOTHING_S)
        if useful:
            self.least_s = _FIRST_PAUSE_S

    def next_attempt_s(self, now: float) -> float:
        """Return the pause after an attempt."""
        return self._pause_s(now, self.least_s, _SHARE_OF_OUTAGE)

    def refused_s(self, now: float) -> float:
        """Return the pause after a refusal."""
        return self._pause_s(now, _REFUSED_PAUSE_S, _REFUSED_SHARE)

    def next_link_s(self) -> float:
        """Return how long a new connection may take to its hello before there is another."""
        pause_s, self._next_link_s = self._next_link_s, min(2.0 * self._next_link_s, _LAST_LINK_S)
        return self._spread(pause_s)

    def _pause_s(self, now: float, least_s: float, share: float) -> float:
        share_s = share * max(0.0, now - self._absent_since)
        return self._spread(max(least_s, min(share_s, _LAST_PAUSE_S)))

    def _spread(self, seconds: float) -> float:
        return seconds * (1.0 + _JITTER * self._chance())


class Dialer:
    """Makes links to an endpoint, from :meth:`start` to :meth:`stop`.

    ``on_failed`` is called with the reasons when an attempt has failed at each of the endpoint's
    addresses. The identity of this end determines the order of a name's addresses.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        make_link: Callable[[], Link],
        on_failed: Callable[[str], None] = lambda _: None,
        identity: str = "",
    ) -> None:
        self._endpoint = endpoint
        self._identity = identity
        self._make_link = make_link
        self._on_failed = on_failed
        # Why the last attempt at each address failed, since the last success.
        self._failures: dict[_Address, str] = {}
        self._loop = asyncio.get_running_loop()
        self._attempts: set[asyncio.Task[None]] = set()
        self._links: set[Link] = set()
        self._winner: Link | None = None
        self._pauses = RetryPauses()
        self._next: asyncio.TimerHandle | None = None
        self._attempted_at = self._next_link_at = float("-inf")
        self._next_address = 0
        self._resolve_at = float("-inf")
        self._addresses: list[tuple[socket.AddressFamily, _Address]] = []
        if endpoint.is_local_socket:
            self._addresses = [(socket.AF_UNIX, endpoint.host)]
        elif "%" not in endpoint.host:  # the interface that it names may come later
            with contextlib.suppress(ValueError):
                version = ipaddress.ip_address(endpoint.host).version
                family = socket.AF_INET if version == 4 else socket.AF_INET6
                self._addresses = [(family, (endpoint.host, endpoint.port))]
        self._is_name = not self._addresses

    def start(self, *, refused: bool = False) -> None:
        """Begin to connect, or go on; after a refusal with a pause."""
        now = self._loop.time()
        self._pauses.begin(now)
        if self._next is not None:
            if not refused:
                return
            self._next.cancel()
        self._next_link_at = float("-inf")
        # A flapping service is not tried more often than an absent one.
        pause_s = self._pauses.refused_s(now) if refused else 0.0
        at = max(now + pause_s, self._attempted_at + self._pauses.least_s)
        self._next = self._loop.call_at(at, self._attempt)

    def selected(self, winner: Link) -> None:
        """Stop connecting, and end all other links that were made."""
        self.stop()
        for link in list(self._links):
            if link is not winner:
                link.end("was not needed: another connection was first", goodbye="")
        self._links.clear()
        self._winner = winner

    def stop(self) -> None:
        """Stop connecting; existing links go on."""
        if self._next is not None:
            self._next.cancel()
            self._next = None
        for attempt in self._attempts:
            attempt.cancel()

    def succeeded(self) -> None:
        """Note that the right peer is there: the outage is over."""
        self._pauses.succeeded()
        self._failures.clear()

    def ended(self, link: Link) -> None:
        """Note that a link has ended."""
        if link not in self._links and link is not self._winner:
            return  # it was not needed
        has_lasted = self._loop.time() >= link.began_at + _LASTING_S
        self._pauses.ended(useful=link.has_answered or (link.hello is not None and has_lasted))
        if link in self._links:
            self._links.discard(link)
            if not self._links:
                self._next_link_at = float("-inf")
        if self._next is not None:
            self._next.cancel()
            at = max(self._next.when(), self._attempted_at + self._pauses.least_s)
            self._next = self._loop.call_at(at, self._attempt)

    # -- attempts --------------------------------------------------------------------------------

    def _attempt(self) -> None:
        now = self._loop.time()
        self._next = self._loop.call_later(self._pauses.next_attempt_s(now), self._attempt)
        if self._is_name and now >= self._resolve_at:
            self._resolve_at = float("inf")
            # A look-up can take many seconds and cannot be cancelled.
            threading.Thread(target=self._resolve, name="holdfast-resolve", daemon=True).start()
        if not self._addresses or now < self._next_link_at:
            return
        self._attempted_at = now
        family, address = self._addresses[self._next_address % len(self._addresses)]
        self._next_address += 1
        attempt = self._loop.create_task(self._connect(family, address))
        self._attempts.add(attempt)
        attempt.add_done_callback(self._attempts.discard)

    async def _connect(self, family: socket.AddressFamily, address: _Address) -> None:
        stream = None
        try:
            stream = socket.socket(family, socket.SOCK_STREAM)
            stream.setblocking(False)
            async with asyncio.timeout(_CONNECT_TIMEOUT_S):
                if family == socket.AF_UNIX:
                    # At once, or not at all: asyncio takes a full queue for a beginning.
                    stream.connect(address)
                else:
                    await self._loop.sock_connect(stream, address)
        except BaseException as error:
            if stream is not None:
                stream.close()
            if not isinstance(error, OSError):
                raise
            no_answer = isinstance(error, TimeoutError)
            self._failed(address, None if no_answer else error.errno)
            return
        now = self._loop.time()
        if now < self._next_link_at:
            stream.close()
            return
        self._next_link_at = now + self._pauses.next_link_s()
        link = self._make_link()
        self._links.add(link)
        link.begin(stream)

    def _failed(self, address: _Address, number: int | None) -> None:
        # A host may have IPv4 and IPv6 addresses, and be reachable over one kind only.
        failures = {
            **self._failures,
            address: system_words(number) if number else "nothing answers",
        }
        reasons = [failures.get(address) for _, address in self._addresses]
        # The addresses of a name may change with each look-up.
        self._failures = {each: failures[each] for _, each in self._addresses if each in failures}
        if None not in reasons:
            self._on_failed("; ".join(dict.fromkeys(filter(None, reasons))))
        elif self._next is not None and not self._links:
            self._next.cancel()
            self._next = self._loop.call_later(0.0, self._attempt)

    def _rank_of(self, address: _Address) -> bytes:
        import hashlib  # most endpoints are no names

        return hashlib.blake2b(f"{self._identity} {address}".encode(), digest_size=8).digest()

    def _resolve(self) -> None:
        """Look up the host's addresses; on a thread of its own."""
        _, host, port = self._endpoint
        reason = ""
        found: list[Any] = []
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            reason = f"host name not found: {host}"
        except Exception as error:  # noqa: BLE001 - look-ups must go on
            reason = f"{type(error).__name__}: {error}"
        addresses: list[tuple[socket.AddressFamily, _Address]] = [
            (entry[0], entry[4]) for entry in found
        ]
        # The system orders the kinds by preference; within a kind, the order is this robot's.
        kinds = [family for family, _ in addresses]
        addresses.sort(key=lambda each: (kinds.index(each[0]), self._rank_of(each[1])))

        def take() -> None:
            self._resolve_at = self._loop.time() + _LOOKUP_INTERVAL_S
            self._addresses = addresses or self._addresses
            if not self._addresses:
                self._on_failed(reason)
            elif self._next is not None and not self._attempts and not self._links:
                self._next.cancel()
                self._attempt()

        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(take)
