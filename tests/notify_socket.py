"""The socket of a service manager, as systemd has one for each unit with ``Type=notify``."""

import contextlib
import secrets
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

PATIENCE_S = 60.0
_MARK = b"X_HEARD_UP_TO_HERE=1"


class NotifySocket:
    """Hears what processes tell."""

    def __init__(self, *, abstract: bool = False) -> None:
        self._directory = tempfile.TemporaryDirectory()  # with a short name, unlike those of tests
        name = f"holdfast-{secrets.token_hex(8)}"
        path = str(Path(self._directory.name) / name)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(f"\0{name}" if abstract else path)
        self._messages: list[list[str]] = []
        self._marks = 0
        self._heard = threading.Condition()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        self.address = f"@{name}" if abstract else path
        self.variables = {"NOTIFY_SOCKET": self.address}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._reader.join(PATIENCE_S)
        self._socket.close()
        self._directory.cleanup()

    def _read(self) -> None:
        # Shut down, it has an empty message; nobody sends one.
        while data := self._socket.recv(65536):
            with self._heard:
                if data == _MARK:
                    self._marks += 1
                else:
                    self._messages.append(data.decode().split("\n"))
                self._heard.notify_all()

    def hear_out(self) -> None:
        """Wait until everything that was sent before this call has been heard."""
        with self._heard, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            wanted = self._marks + 1
            sender.sendto(_MARK, self._socket.getsockname())
            assert self._heard.wait_for(lambda: self._marks >= wanted, PATIENCE_S)

    @property
    def messages(self) -> list[list[str]]:
        """All messages so far, each as its lines."""
        return self._messages.copy()

    @property
    def lines(self) -> list[str]:
        """The lines of all messages so far."""
        return [line for message in self.messages for line in message]

    def count(self, line: str) -> int:
        """Return how often a line has come."""
        return self.lines.count(line)

    def wait(self, reached: Callable[[list[str]], bool], what: str) -> None:
        """Wait until the lines so far are as they should be."""
        deadline = time.monotonic() + PATIENCE_S
        with self._heard:
            while not reached(self.lines):
                left = deadline - time.monotonic()
                assert left > 0.0, f"waited in vain for {what}: {self.messages}"
                self._heard.wait(left)

    def wait_for(self, line: str, count: int = 1) -> None:
        """Wait until a line has come so often."""
        self.wait(lambda lines: lines.count(line) >= count, f"{line} (number {count})")
