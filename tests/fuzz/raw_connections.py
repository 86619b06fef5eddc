"""Bytes at a service's port that are not ours, or only the beginning of it: scanners and worse."""

from __future__ import annotations

import contextlib
import random
import socket
import struct
import threading

from tests.wire import CALL, frame_of, hello_of

_MAX_OPEN = 40
_PAUSE_S = 0.01

_HTTP = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
_TLS = b"\x16\x03\x01\x00\xf4\x01\x00\x00\xf0\x03\x03" + bytes(244)
_RESET = struct.pack("ii", 1, 0)


class RawConnections:
    """Connects, says something that it should not, and hangs up, in order or not, or keeps silent.

    Some send what they have byte by byte. Of those that stay open, the oldest are left first.
    """

    def __init__(self, port: int, seed: int) -> None:
        self._port = port
        self._chance = random.Random(seed)
        self._greeting = hello_of() + frame_of(CALL, 1, b"no request")
        self._open: list[socket.socket] = []
        self._dripping: list[tuple[socket.socket, bytearray]] = []
        self._stopped = threading.Event()
        self.made = self.held = self.bytes_sent = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Hang up."""
        self._stopped.set()
        self._thread.join()
        for connection in (*self._open, *(each for each, _ in self._dripping)):
            connection.close()

    def _run(self) -> None:
        while not self._stopped.wait(_PAUSE_S * self._chance.random()):
            with contextlib.suppress(OSError):
                self._connect()
            self._drip()
            while len(self._open) > _MAX_OPEN:
                self._open.pop(self._chance.randrange(len(self._open))).close()

    def _drip(self) -> None:
        """Send one more byte of each that is slow."""
        for each in list(self._dripping):
            connection, left = each
            try:
                connection.sendall(bytes([left.pop(0)]))
            except OSError:
                left.clear()
            self.bytes_sent += 1
            if not left or len(self._dripping) > _MAX_OPEN:
                self._dripping.remove(each)
                connection.close()

    def _connect(self) -> None:
        chance = self._chance
        connection = socket.create_connection(("127.0.0.1", self._port), timeout=5.0)
        self.made += 1
        greeting = self._greeting
        match chance.choice(
            ("random", "half", "spoilt", "whole", "length", "other", "slow", "nothing")
        ):
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
                size = chance.choice((0, 1, 40_000, 2**26, 2**32 - 1))
                said = hello_of() + struct.pack("<IBI", size, chance.randrange(9), 1)
                said += chance.randbytes(chance.choice((0, 5)))
                self.held += 1
            case "other":
                said = chance.choice((_HTTP, _TLS))
            case "slow":
                self._dripping.append((connection, bytearray(greeting)))
                self.held += 1
                return
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
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        except OSError:
            pass
        connection.close()
