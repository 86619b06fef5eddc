"""Processes that survive this one: masters, and processes that wait to become one."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from ros1_master_guard import process as master_process
from ros1_master_guard.errors import GuardError
from ros1_master_guard.process import MasterState
from ros1_master_guard.settings import GuardSettings

__all__ = ["DetachedProcess", "MasterProcess"]

_START_S = 30.0
_END_S = 2.0


class DetachedProcess:
    """A process whose end is noticed at once, and which survives the event loop.

    The standard library's subprocess coroutines would end it with the loop.

    ``environment`` is added to this process's. Without ``errors`` its standard error is this
    process's.

    Attributes
    ----------
    ended : asyncio.Future of int
        Its exit code, or the negative number of the signal that ended it.

    Raises
    ------
    OSError
        If it cannot be started.
    """

    def __init__(
        self,
        words: Sequence[str],
        environment: Mapping[str, str],
        *,
        pass_fds: Sequence[int] = (),
        errors: int | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[int] = self._loop.create_future()
        self._process = subprocess.Popen(
            words,
            pass_fds=pass_fds,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            # Ctrl-C is for the guard alone.
            start_new_session=True,
            env={**os.environ, **environment},
        )
        self.pid = self._process.pid
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        code = self._process.wait()
        # The loop may be closed by then.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._tell, code)

    def _tell(self, code: int) -> None:
        if not self.ended.done():
            self.ended.set_result(code)

    async def wait(self) -> int:
        """Wait for its end; may be cancelled."""
        return await asyncio.shield(self.ended)

    async def end(self, number: signal.Signals) -> None:
        """End it by a signal, and by SIGKILL if that does not help; may be repeated."""
        for each in (number, signal.SIGKILL):
            if not self.ended.done():
                with contextlib.suppress(ProcessLookupError):
                    self._process.send_signal(each)
                await asyncio.wait((self.ended,), timeout=_END_S)


class MasterProcess:
    """A process that is a master, or waits to become one.

    It inherits ``listening``, which need not be bound yet.

    Raises GuardError if it cannot be started.
    """

    def __init__(self, settings: GuardSettings, listening: socket.socket, journal: Path) -> None:
        self._python = settings.python
        self._warm = False
        self._control, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setblocking(False)
        script = str(Path(master_process.__file__).resolve())
        # In memory, because the disk may be full.
        self._state = open(os.memfd_create("master-state"), "wb", buffering=0)  # noqa: PTH123, SIM115
        descriptors = (listening.fileno(), its.fileno(), self._state.fileno())
        try:
            self.process = DetachedProcess(
                (settings.python, script, *map(str, descriptors), str(journal)),
                {"ROS_MASTER_URI": settings.address.uri},
                pass_fds=descriptors,
            )
        except OSError as error:
            self._control.close()
            self._state.close()
            raise GuardError(
                f"--python {settings.python}: cannot be run: {error.strerror}"
            ) from error
        finally:
            its.close()

    async def warm(self) -> None:
        """Wait until it has loaded what it needs.

        Raises GuardError if it cannot.
        """
        if self._warm:
            return
        said = await self._hear()
        if said != "warm":
            missing = said.removeprefix("missing ") or "it ended at once"
            raise GuardError(
                f"{self._python} cannot run a ROS 1 master ({missing}); install ROS 1 (on Debian: "
                "apt-get install python3-rosmaster rosout), or name ROS's Python with --python"
            )
        self._warm = True

    async def serve(self, state: MasterState) -> None:
        """Make it the master, with this state.

        Raises GuardError if it does not begin, or if there is no room for the state.
        """
        await self.warm()
        content = memoryview(master_process.journal_of(state))
        try:
            while content:
                content = content[self._state.write(content) :]
        except OSError as error:
            raise GuardError(f"the new master's state: {error.strerror}") from error
        with contextlib.suppress(OSError):
            await asyncio.get_running_loop().sock_sendall(self._control, b"go")
        if (said := await self._hear()) != "serving":
            raise GuardError(f"the new master has not begun ({said or 'it ended'})")
        self._control.close()
        self._state.close()

    async def _hear(self) -> str:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_START_S):
                return (await loop.sock_recv(self._control, 4096)).decode(errors="replace")
        except TimeoutError:
            return f"it said nothing for {_START_S:g} s"
        except OSError:
            return ""

    async def end(self, *, at_once: bool = False) -> None:
        """End it; may be repeated."""
        self._control.close()
        self._state.close()
        await self.process.end(signal.SIGKILL if at_once else signal.SIGTERM)
