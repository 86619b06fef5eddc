"""What ``roscore`` provides besides the master: the node ``/rosout`` and two parameters."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import signal
import subprocess
from time import monotonic

from ros1_master_guard.errors import CallError, GoneError
from ros1_master_guard.events import EventSink
from ros1_master_guard.ros1_calls import call
from ros1_master_guard.standby import DetachedProcess

__all__ = ["ROSOUT", "STEADY_S", "Rosout", "how_it_ended", "restart_delay_s", "set_versions"]

ROSOUT = "/rosout"

STEADY_S = 1.0
"""A process that ends earlier than this may have failed at its start."""

_FIRST_DELAY_S, _LAST_DELAY_S = 0.1, 1.0
_CHECK_EVERY_S = 1.0
_PROBE_S = 1.0
_VERSION_S = 30.0


class Rosout:
    """Keeps one ``/rosout`` running.

    Nodes reach the master at ``master_uri``, this process at ``own_uri``.
    """

    def __init__(self, master_uri: str, own_uri: str, events: EventSink) -> None:
        self._master_uri = master_uri
        self._own_uri = own_uri
        self._events = events
        self._process: DetachedProcess | None = None

    async def keep(self) -> None:
        """Start ``/rosout`` whenever there is none, until cancelled."""
        failures = 0
        while True:
            if self._process is None and not await self._exists():
                rosrun = shutil.which("rosrun")
                if rosrun is None:
                    self._events.event("note", reason="no rosrun here, so no /rosout")
                    return
                begun_at = monotonic()
                self._process = DetachedProcess(
                    (rosrun, "rosout", "rosout", "__name:=rosout"),
                    {"ROS_MASTER_URI": self._master_uri, "ROS_NAMESPACE": "/"},
                    errors=subprocess.DEVNULL,
                )
                code = await self._process.wait()
                self._process = None
                self._events.event("rosout_ended", reason=how_it_ended(code))
                failures = failures + 1 if monotonic() - begun_at < STEADY_S else 0
                await asyncio.sleep(restart_delay_s(failures))
            await asyncio.sleep(_CHECK_EVERY_S)

    def release(self) -> None:
        """Let the process live on."""
        self._process = None

    async def end(self) -> None:
        """End the process that was started here."""
        if self._process is not None:
            await self._process.end(signal.SIGINT)

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
    for name, words in (("rosversion", ("roslaunch",)), ("rosdistro", ("-d",))):
        with contextlib.suppress(OSError, CallError, TimeoutError):
            process = await asyncio.create_subprocess_exec(
                *("rosversion", *words),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
            try:
                output, _ = await asyncio.wait_for(process.communicate(), _VERSION_S)
            finally:
                if process.returncode is None:
                    process.kill()
            if output and process.returncode == 0:
                value = output.decode(errors="replace")
                await call(master_uri, "setParam", f"/{name}", value, within_s=_PROBE_S)


def restart_delay_s(failures: int) -> float:
    """Return the pause before the next start: 0.1 s, doubled with each failure, at most 1 s."""
    return float(min(_LAST_DELAY_S, _FIRST_DELAY_S * 2 ** min(failures, 16)))


def how_it_ended(code: int) -> str:
    """Describe an exit code, or the negative number of a signal."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"it was ended by {signal.Signals(-code).name}"
    return f"it ended with exit code {code}"
