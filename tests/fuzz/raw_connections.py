"""Bytes at a service's port that are no Zenoh, or only the beginning of it."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import struct
import threading

import zenoh

__all__ = ["RawConnections", "captured_greeting"]

_MAX_OPEN = 40
_PAUSE_S = 0.01


def captured_greeting() -> bytes:
    """Return what a client of Zenoh says first, as it said it to a listener of ours."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(10.0)
    port = listener.getsockname()[1]

    def open_session() -> None:
        configuration = zenoh.Config.from_json5(
            json.dumps(
                {
                    "mode": "client",
                    "scouting": {"multicast": {"enabled": False}},
                    "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 500},
                }
            )
        )
        with contextlib.suppress(zenoh.ZError):
            zenoh.open(configuration).close()

    thread = threading.Thread(target=open_session)
    thread.start()
    with listener:
        connection, _ = listener.accept()
        with connection:
            connection.settimeout(10.0)
            greeting = connection.recv(65_536)
    thread.join(10.0)
    return greeting


class RawConnections:
    """Connects, says something that it should not, and hangs up, in order or not, or keeps silent.

    Attributes
    ----------
    made, held : int
        Connections that were made, and those of them that said the first half of a greeting and
        were left open.
    bytes_sent : int
    """

    def __init__(self, port: int, seed: int) -> None:
        self._port = port
        self._chance = random.Random(seed)
        self._greeting = captured_greeting()
        self._open: list[socket.socket] = []
        self._stopped = threading.Event()
        self.made = self.held = self.bytes_sent = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Hang up."""
        self._stopped.set()
        self._thread.join()
        for connection in self._open:
            connection.close()

    def _run(self) -> None:
        while not self._stopped.wait(_PAUSE_S * self._chance.random()):
            with contextlib.suppress(OSError):
                self._connect()
            while len(self._open) > _MAX_OPEN:
                self._open.pop(self._chance.randrange(len(self._open))).close()

    def _connect(self) -> None:
        chance = self._chance
        connection = socket.create_connection(("127.0.0.1", self._port), timeout=5.0)
        self.made += 1
        greeting = self._greeting
        match chance.choice(("random", "half", "spoilt", "whole", "length", "nothing")):
            case "random":
                said = chance.randbytes(chance.choice((1, 2, 100, 70_000)))
            case "half":
                said = greeting[: chance.randrange(len(greeting))]
                self.held += 1
            case "spoilt":
                spoilt = bytearray(greeting)
                for _ in range(chance.choice((1, 3))):
                    spoilt[chance.randrange(len(spoilt))] ^= 1 << chance.randrange(8)
                said = bytes(spoilt) + chance.randbytes(chance.choice((0, 200)))
            case "whole":
                said = greeting * chance.choice((1, 2))
                self.held += 1
            case "length":
                # What follows has so many bytes, it says; then hardly any come.
                said = struct.pack("<H", chance.choice((0, 1, 40_000, 65_535)))
                said += chance.randbytes(chance.choice((0, 5)))
                self.held += 1
            case _:
                said = b""
        self.bytes_sent += len(said)
        try:
            connection.sendall(said)
            if chance.random() < 0.5:
                self._open.append(connection)
                return
            if chance.random() < 0.5:
                # With a reset instead of an orderly end.
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        except OSError:
            pass
        connection.close()
