"""Ports for tests, at each of which nobody has been for a long while.

A port that the system chooses may have been another test's a moment ago, whose robot still tries to
reach the service that was killed there; and while a service is away, the system may give its port
to somebody else, if only to connect from. So tests take theirs from below those that the system
chooses from, each worker of pytest-xdist its own, one after another.
"""

from __future__ import annotations

import itertools
import os
import random
import socket

FIRST, END = 10_000, 20_000
"""Linux chooses from 32768 on, unless it is told otherwise; chaos trials from 20000 on."""

WORKERS = 4
"""So many of them share no port."""

_size = (END - FIRST) // WORKERS
_block = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % WORKERS
# A run that begins when another one has just ended begins elsewhere.
_numbers = itertools.count(random.SystemRandom().randrange(_size))


def free_port(host: str = "127.0.0.1") -> int:
    """Return a port at which nobody listens, for streams or datagrams, nor soon will."""
    for number in itertools.islice(_numbers, _size):
        port = FIRST + _block * _size + number % _size
        try:
            for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                with socket.socket(type=kind) as probe:
                    probe.bind((host, port))
        except OSError:
            continue
        return port
    raise RuntimeError(f"no port of {host} is free in this worker's block")
