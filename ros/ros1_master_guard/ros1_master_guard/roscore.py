"""What ``roscore`` provides besides the master: the node ``/rosout`` and two parameters."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import subprocess
from time import monotonic

from ros1_master_guard.errors import CallError, GoneError
from ros1_master_guard.events import EventLog
from ros1_master_guard.ros1_calls import call

ROSOUT = "/rosout"

_CHECK_EVERY_S = 1.0
_PROBE_S = 1.0
_END_S = 2.0


class Rosout:
    """Keeps one ``/rosout`` running; ``own_uri`` is where this process reaches the master."""

    def __init__(self, master_uri: str, own_uri: str, events: EventLog) -> None:
        self._master_uri = master_uri
        self._own_uri = own_uri
        self._events = events
        self._process: subprocess.Popen[bytes] | None = None

    async def keep(self) -> None:
        """Start ``/rosout`` whenever there is none, until cancelled."""
        # Where catkin installs it, and Debian.
        prefixes = [*os.environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep), "/usr"]
        program = shutil.which("rosout", path=os.pathsep.join(f"{p}/lib/rosout" for p in prefixes))
        if program is None:
            self._events.event("note", reason=f"no rosout in {prefixes}, so no /rosout")
            return
        while True:
            if self._process is not None and (code := self._process.poll()) is not None:
                self._process = None
                self._events.event("rosout_ended", reason=how_it_ended(code))
            if self._process is None and not await self._exists():
                self._process = subprocess.Popen(
                    (program, "__name:=rosout"),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C is for the guard alone
                    env={**os.environ, "ROS_MASTER_URI": self._master_uri, "ROS_NAMESPACE": "/"},
                )
            await asyncio.sleep(_CHECK_EVERY_S)

    def release(self) -> None:
        """Let the process live on."""
        self._process = None

    async def end(self) -> None:
        """End the process that was started here, by SIGKILL if need be."""
        if (process := self._process) is None:
            return
        for number in (signal.SIGINT, signal.SIGKILL):
            until = monotonic() + _END_S
            process.send_signal(number)
            while process.poll() is None and monotonic() < until:
                await asyncio.sleep(0.01)

    async def _exists(self) -> bool:
        """Return whether it is there; True as well while its master is away."""
        try:
            uri = await call(self._own_uri, "lookupNode", ROSOUT, within_s=_PROBE_S)
            await call(uri, "getPid", within_s=_PROBE_S)
        except GoneError:
            return False
        except CallError as error:
            return "unknown node" not in str(error)
        return True


async def set_versions(master_uri: str) -> None:
    """Set the parameters ``/rosversion`` and ``/rosdistro``, as far as they are known."""
    for name, word in (("rosversion", "roslaunch"), ("rosdistro", "-d")):
        with contextlib.suppress(OSError, CallError):
            process = await asyncio.create_subprocess_exec(
                *("rosversion", word), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            output, _ = await process.communicate()
            if output and process.returncode == 0:
                value = output.decode(errors="replace")
                await call(master_uri, "setParam", f"/{name}", value, within_s=_PROBE_S)


def how_it_ended(code: int) -> str:
    """Describe an exit code, or the negative number of a signal."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"it was ended by {signal.Signals(-code).name}"
    return f"it ended with exit code {code}"
