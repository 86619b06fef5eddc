"""``holdfast ros1-guard``: a ROS 1 master that may die."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.printable import printable
from holdfast.runtime.command_line import (
    Options,
    flag,
    location,
    number,
    option,
    whole_number,
)
from holdfast.runtime.log_lines import LogFormat
from holdfast.runtime.logs import log_option

if TYPE_CHECKING:
    from holdfast.ros.master.settings import GuardSettings
    from holdfast.runtime.logs import LogFormat

__all__ = ["main"]


_COMPONENT = "ros1-guard"


class GuardOptions(Options):
    """Guard the ROS 1 master: when it dies, the next one knows all that it knew.

    Start it instead of roscore. It starts a master, or guards the one that runs on this machine,
    and /rosout. When the master is killed or hangs, a new one takes its place, with all services,
    publishers, subscribers and parameters. No node is started again, and connections between nodes
    go on meanwhile. Ctrl-C or SIGTERM ends the guard and the master that it started.

    If the guard is killed, the master lives on: start another guard. If both are killed, the next
    guard goes on where they stopped, if a node of theirs still runs.
    """

    exit_codes: ClassVar = {0: "after SIGTERM"}

    port: int | None = option(
        metavar="N",
        read=whole_number(1, 65_535),
        help="The master's port (default: that of ROS_MASTER_URI, or 11311).",
    )
    silent_s: float = option(
        metavar="S",
        read=number(0.5, 3600.0, "s"),
        default=3.0,
        help="A master that has not answered for this long is killed and replaced.",
    )
    rosout: bool = flag(default=True, help="Run /rosout, too, as roscore does.")
    python: str = option(
        metavar="FILE",
        default="/usr/bin/python3",
        help="ROS's Python, which has rosmaster.",
    )
    directory: Path | None = option(
        metavar="DIR",
        read=location,
        help="Where the master's registrations are written (default: a directory of this user that "
        "is gone after a restart of the machine).",
    )
    log: LogFormat = log_option()


def main(arguments: Sequence[str]) -> int:
    """Guard until a signal comes, and return the exit code."""
    options = GuardOptions.parse("ros1-guard", arguments)
    from holdfast.ros.master.settings import GuardSettings, MasterAddress

    settings = GuardSettings(
        MasterAddress.of(os.environ, options.port),
        options.python,
        options.directory,
        options.silent_s,
        options.rosout,
    )
    return _guard(settings, options.log)


def _guard(settings: GuardSettings, log: LogFormat) -> int:
    import asyncio
    import signal

    from holdfast.ros.master.guard import MasterGuard
    from holdfast.runtime.logs import EventLog
    from holdfast.runtime.service_manager import ServiceManager

    manager = ServiceManager()
    events = EventLog(sys.stderr, format=log, component=_COMPONENT)

    def ready(how: str) -> None:
        _say_ready(settings, log, how)
        manager.ready()

    async def run() -> signal.Signals:
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[signal.Signals] = loop.create_future()

        def end(number: signal.Signals) -> None:
            if not ended.done():
                ended.set_result(number)

        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                loop.add_signal_handler(number, end, number)
        manager.watch(loop, lambda: f"guards {settings.address.uri}")
        guarding = asyncio.create_task(MasterGuard(settings, events).run(ready))
        await asyncio.wait((ended, guarding), return_when=asyncio.FIRST_COMPLETED)
        if guarding.done():
            await guarding
        events.event("stopping", reason=ended.result().name)
        manager.stopping()
        guarding.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await guarding
        return ended.result()

    try:
        number = asyncio.run(run())
        return 0 if number is signal.SIGTERM else 128 + number
    finally:
        manager.close()
        events.close()


def _say_ready(settings: GuardSettings, log: LogFormat, how: str) -> None:
    uri = settings.address.uri
    if log == "json":
        from holdfast.runtime.logs import EventLog

        with EventLog(sys.stdout, format="json", component=_COMPONENT) as line:
            line.event("ready", service=uri, pid=os.getpid(), master=how)
        return
    # A closed standard output is no reason not to guard.
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.write(printable(f"guards the master at {uri}, which was {how}\n"))
        sys.stdout.flush()
