"""Bad neighbours of a robot: whatever else may come to a service's port, one kind at a time.

    python -m tests.fuzz.neighbours scanner tcp/127.0.0.1:7447 --seconds 5

It prints a line when it has begun, and how often it did what it does when it ends; SIGTERM ends it.
"""

import argparse
import contextlib
import itertools
import random
import select
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
from tests.fuzz import corpus
from tests.wire import CALL, RawClient, RawLink, frame_of, hello_of

from holdfast.planning.belief import Belief
from holdfast.planning.planner import PlanningState, encode_checkpoint
from holdfast.protocol.messages import encode

_RESET = struct.pack("ii", 1, 0)
_HTTP = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
_TLS = b"\x16\x03\x01\x00\xf4\x01\x00\x00\xf0\x03\x03" + bytes(244)
_OPEN = 200
_PARTICLES = 1_900_000


class Visit:
    """What a neighbour knows: where to go, with which certificate, and when to leave."""

    def __init__(self, endpoint: str, keys: Path | None, until: threading.Event) -> None:
        self.endpoint = endpoint
        self.keys = keys
        self._until = until
        self.done = 0

    @property
    def goes_on(self) -> bool:
        return not self._until.is_set()

    def connect(self) -> socket.socket:
        """Return a connection on which nothing was said."""
        host, _, port = self.endpoint.partition("/")[2].rpartition(":")
        return socket.create_connection((host, int(port)), 10.0)

    def pause(self, often_hz: float, began: float) -> None:
        """Wait until it is time to do it again."""
        due = began + self.done / often_hz
        time.sleep(max(0.0, due - time.monotonic()))


def _deaf(visit: Visit) -> None:
    """Two clients that ask, and never read what they are sent."""
    request = msgspec.structs.replace(corpus.requests()[1], session=b"never reads it..")
    numbers = itertools.count(1)
    links: list[RawLink | None] = [None, None]
    while visit.goes_on:
        for place, link in enumerate(links):
            try:
                if link is None:
                    links[place] = link = RawLink(visit.endpoint, visit.keys)
                    link.say(hello_of(incarnation=f"deaf-{place}"))
                number = next(numbers)
                asked = msgspec.structs.replace(request, number=number)
                # Never more than the service takes: it would be this end that waits.
                if select.select([], [link.socket], [], 0.001)[1]:
                    link.say(frame_of(CALL, number, encode(asked)))
                    visit.done += 1
            except OSError:
                links[place] = None
        time.sleep(0.0005)


def _slow(visit: Visit) -> None:
    """Connections that say a byte now and then, and never come to an end."""
    greeting = hello_of()
    connections: list[tuple[socket.socket, bytearray]] = []
    while visit.goes_on:
        while len(connections) < _OPEN:
            connections.append((visit.connect(), bytearray(greeting)))
        for each in list(connections):
            connection, left = each
            try:
                connection.sendall(bytes([left.pop(0)]))
                visit.done += 1
            except OSError:
                left.clear()
            if not left:
                connections.remove(each)
                connection.close()
        time.sleep(0.1)


def _scanner(visit: Visit) -> None:
    """Connections that are closed, or reset, as soon as they are there: 500 a second."""
    began = time.monotonic()
    while visit.goes_on:
        with visit.connect() as connection:
            if visit.done % 2:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        visit.done += 1
        visit.pause(500.0, began)


def _greetings(visit: Visit) -> None:
    """Browsers, and clients of TLS, at a port where neither belongs: 200 a second."""
    began = time.monotonic()
    while visit.goes_on:
        with contextlib.suppress(OSError), visit.connect() as connection:
            connection.sendall(_HTTP if visit.done % 2 else _TLS)
            connection.recv(1000)
        visit.done += 1
        visit.pause(200.0, began)


def _hasty(visit: Visit) -> None:
    """2,000 connections, as fast as they come about, closed before their handshake."""
    while visit.done < 2000:
        visit.connect().close()
        visit.done += 1


def _trickle(visit: Visit) -> None:
    """50 connections a second, closed before their handshake."""
    began = time.monotonic()
    while visit.goes_on:
        visit.connect().close()
        visit.done += 1
        visit.pause(50.0, began)


def _silent(visit: Visit) -> None:
    """2,000 connections that are held, and on which nothing is ever said."""
    held: list[socket.socket] = []
    while visit.goes_on:
        if len(held) == 2000:
            held.pop(0).close()
        held.append(visit.connect())
        visit.done += 1
        time.sleep(0.0005)


def _large(visit: Visit) -> None:
    """A robot that hands over a belief as large as a message can be, again and again."""
    belief = Belief(np.zeros((_PARTICLES, 3)), np.full(_PARTICLES, 1.0 / _PARTICLES))
    request = next(
        each for each in corpus.requests() if each.session_configuration and each.checkpoint
    )
    state = PlanningState(request.session_configuration.seed, 0, 0, 0, False, belief)  # type: ignore[union-attr]
    request = msgspec.structs.replace(
        request, session=b"has a large one.", checkpoint=encode_checkpoint(state)
    )
    with RawClient(visit.endpoint, visit.keys) as client:
        while visit.goes_on:
            asked = msgspec.structs.replace(request, number=request.number + visit.done)
            client.replies_to(client.send_call(encode(asked)))
            visit.done += 1


def _flood(visit: Visit) -> None:
    """Datagrams to a port for udp as fast as they go: nonsense, and some in a robot's name."""
    host, _, port = visit.endpoint.partition("/")[2].rpartition(":")
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.connect((host, int(port)))
        content = random.Random(1).randbytes(100)
        while visit.goes_on:
            for association in range(256):
                with contextlib.suppress(OSError):
                    sender.send(association.to_bytes(4, "big") + content)
                visit.done += 1


KINDS: dict[str, Callable[[Visit], None]] = {
    "deaf": _deaf,
    "slow": _slow,
    "scanner": _scanner,
    "greetings": _greetings,
    "silent": _silent,
    "hasty": _hasty,
    "trickle": _trickle,
    "large": _large,
    "flood": _flood,
}


def main() -> None:
    """Be a bad neighbour for so long."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("endpoint")
    parser.add_argument("--tls", type=Path, help="directory of a robot's credentials")
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    corpus.requests()
    until = threading.Event()
    timer = threading.Timer(options.seconds, until.set)
    timer.daemon = True
    timer.start()
    visit = Visit(options.endpoint, options.tls, until)
    signal.signal(signal.SIGTERM, lambda *_: until.set())
    print("begins", flush=True)
    KINDS[options.kind](visit)
    print(visit.done, flush=True)


if __name__ == "__main__":
    main()
