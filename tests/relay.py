"""A line for datagrams alone, between one robot and one service of this machine."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Iterator
from typing import Any

__all__ = ["Relay", "relay"]


class Relay:
    """Hands datagrams on between one robot and one service, and counts them.

    To the service they come from an address of the relay's own, which can change; each may be
    repeated, and the last ones may come again at any time.
    """

    def __init__(self, port: int, target: int) -> None:
        self._target = target
        self._entry = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._entry.bind(("127.0.0.1", port))
        self._robot: Any = None
        self._kept: list[bytes] = []
        self._lock = threading.Lock()
        self._ending = False
        self._exit = self._new_exit()
        self.carried = {"to_service": 0, "to_robot": 0}
        self.repeat = False
        self.addresses = 1
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _new_exit(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.connect(("127.0.0.1", self._target))
        return made

    def change_address(self) -> None:
        """Send to the service from another port from now on, as after a change of networks."""
        with self._lock:
            old, self._exit = self._exit, self._new_exit()
            old.close()
            self.addresses += 1

    def replay(self) -> None:
        """Send the last datagrams to the service again, from an address that nobody has had."""
        with self._lock, self._new_exit() as stranger:
            for datagram in self._kept:
                stranger.send(datagram)

    def close(self) -> None:
        """Carry no more, and let the port go. May be repeated."""
        self._ending = True
        self._thread.join()
        self._entry.close()
        self._exit.close()

    def _run(self) -> None:
        while not self._ending:
            with self._lock:
                sources = [self._entry, self._exit]
            # A socket that was replaced meanwhile is closed, and another one is looked at next.
            with contextlib.suppress(OSError, ValueError):
                for ready in select.select(sources, [], [], 0.01)[0]:
                    self._carry(ready)

    def _carry(self, source: socket.socket) -> None:
        datagram, sender = source.recvfrom(65_536)
        with self._lock:
            for _ in range(1 + self.repeat):
                if source is self._entry:
                    self._robot = sender
                    self._kept = [*self._kept[-49:], datagram]
                    self.carried["to_service"] += 1
                    self._exit.send(datagram)
                else:
                    self.carried["to_robot"] += 1
                    self._entry.sendto(datagram, self._robot)


@contextlib.contextmanager
def relay(port: int, target: int) -> Iterator[Relay]:
    made = Relay(port, target)
    try:
        yield made
    finally:
        made.close()
