"""Masters as their guard sees them: a process that waits to be one, and all that one tells."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import threading
from pathlib import Path
from typing import Any, Self

from ros1_master_guard import process as master_process
from ros1_master_guard.errors import GuardError
from ros1_master_guard.process import HEAD, MasterState, decoded, encoded
from ros1_master_guard.settings import GuardSettings

_START_S, _END_S = 30.0, 2.0
_READ_BYTES = 1 << 20


class MasterLink:
    """A connection to a master, which tells what changes in its ``state``.

    ``following`` ends with the connection, when all that was told is in the state.
    """

    def __init__(self, socket_: socket.socket) -> None:
        socket_.setblocking(False)
        self._socket = socket_
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self.state = MasterState()
        self.following: asyncio.Task[None] | None = None

    @classmethod
    async def to(cls, name: str) -> Self:
        """Connect to a running master by the name of its socket; raise OSError if it has ended."""
        stream = socket.socket(socket.AF_UNIX)
        try:
            stream.connect(f"\0{name}")
            link = cls(stream)
            await link.begin()
        except BaseException:
            stream.close()
            raise
        return link

    async def begin(self) -> None:
        """Take the whole state, and follow it from now on; raise OSError if none comes."""
        told = await self.hear()
        if not isinstance(told, dict):
            raise ConnectionError(f"the master has not begun ({told or 'it ended'})")
        self.state = MasterState(**told)
        self.following = asyncio.create_task(self._follow())

    async def _follow(self) -> None:
        while change := await self._next():
            self.state.apply(*change)

    async def _opened(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        if self._streams is None:
            opening = asyncio.open_unix_connection(sock=self._socket, limit=_READ_BYTES)
            self._streams = await opening
        return self._streams

    async def hear(self) -> Any:
        """Return the next message; a text of its own if none comes."""
        try:
            async with asyncio.timeout(_START_S):
                return await self._next()
        except TimeoutError:
            return f"it said nothing for {_START_S:g} s"

    async def say(self, message: Any) -> None:
        """Send a message."""
        _, writer = await self._opened()
        with contextlib.suppress(OSError):
            writer.write(encoded(message))
            await writer.drain()

    def close(self) -> None:
        """End the connection."""
        if self.following is not None:
            self.following.cancel()
        (self._socket if self._streams is None else self._streams[1]).close()

    async def _next(self) -> Any:
        """Return the next message; None at the end."""
        reader, _ = await self._opened()
        try:
            (size,) = HEAD.unpack(await reader.readexactly(HEAD.size))
            return decoded(await reader.readexactly(size))
        except (OSError, EOFError):
            return None


class MasterProcess:
    """A process that is a master, or waits to become one; it survives this one.

    It inherits ``listening``, which need not be bound yet. ``ended`` is its exit code, or the
    negative number of the signal that ended it. Raises GuardError if it cannot be started.
    """

    def __init__(self, settings: GuardSettings, listening: socket.socket) -> None:
        self._python = settings.python
        self._loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[int] = self._loop.create_future()
        self._warm = False
        mine, its = socket.socketpair()
        script = str(Path(master_process.__file__).resolve())
        descriptors = (listening.fileno(), its.fileno())
        try:
            self._process = subprocess.Popen(
                (settings.python, script, *map(str, descriptors)),
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Ctrl-C is for the guard alone.
                start_new_session=True,
                env={**os.environ, "ROS_MASTER_URI": settings.address.uri},
            )
        except OSError as error:
            mine.close()
            reason = f"--python {settings.python}: cannot be run: {error.strerror}"
            raise GuardError(reason) from error
        finally:
            its.close()
        self.link = MasterLink(mine)
        self.pid = self._process.pid
        # The standard library's subprocess coroutines would end it with the loop.
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        code = self._process.wait()
        # The loop may be closed by then.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self.ended.set_result, code)

    async def warm(self) -> None:
        """Wait until it has loaded what it needs; raise GuardError if it cannot."""
        if not self._warm and (said := await self.link.hear()) != "warm":
            missing = str(said or "it ended at once").removeprefix("missing ")
            raise GuardError(
                f"{self._python} cannot run a ROS 1 master ({missing}); install ROS 1 (on Debian: "
                "apt-get install python3-rosmaster rosout), or name ROS's Python with --python"
            )
        self._warm = True

    async def serve(self, state: MasterState) -> None:
        """Make it the master, with this state; raise GuardError if it does not begin."""
        await self.warm()
        await self.link.say(vars(state))
        try:
            await self.link.begin()
        except OSError as error:
            raise GuardError(f"the next master: {error}") from error

    async def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End it by a signal, and by SIGKILL if that does not help; may be repeated."""
        for each in (number, signal.SIGKILL):
            if not self.ended.done():
                self._process.send_signal(each)
                await asyncio.wait((self.ended,), timeout=_END_S)
        self.link.close()
