"""``holdfast ros1-guard``: a ROS 1 master that may die."""

from __future__ import annotations

import contextlib
import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from holdfast.cli.options import location, number, whole_number
from holdfast.printable import printable

if TYPE_CHECKING:
    from holdfast.ros.master.settings import GuardSettings

__all__ = ["ros1_guard"]


_COMPONENT = "ros1-guard"


class _Log(StrEnum):
    text = "text"
    json = "json"


def ros1_guard(
    port: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            parser=whole_number("--port", 1, 65_535),
            show_default=False,
            help="The master's port. [default: that of ROS_MASTER_URI, or 11311]",
        ),
    ] = None,
    silent_s: Annotated[
        float,
        typer.Option(
            "--silent-s",
            metavar="S",
            parser=number("--silent-s", 0.5, 3600.0, "s"),
            help="A master that has not answered for so long is killed and replaced.",
        ),
    ] = 3.0,
    rosout: Annotated[bool, typer.Option(help="Have /rosout run, too, as roscore does.")] = True,
    python: Annotated[
        str, typer.Option(metavar="FILE", help="ROS's Python, which has rosmaster.")
    ] = "/usr/bin/python3",
    directory: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            parser=location("--directory"),
            show_default=False,
            help="Where what the master knows is written down. [default: one of this user that "
            "goes when the machine is started anew]",
        ),
    ] = None,
    log: Annotated[
        _Log, typer.Option(help="Form of the ready line and of the log on standard error.")
    ] = _Log.text,
) -> None:
    """Guard the ROS 1 master: when it dies, the next one knows all that it knew.

    Start it instead of roscore. It starts a master, or guards the one that is there, on this
    machine, and /rosout. When the master is killed or hangs, a new one takes its place, with all
    services, publishers, subscribers and parameters, whoever's they are; no node is started again,
    and connections between nodes go on meanwhile. Ctrl-C or SIGTERM ends the guard and the master
    that it started.

    If the guard is killed, the master lives on: start another guard. If both are, it goes on where
    they stopped, if a node of theirs is still there.
    """
    from holdfast.ros.master.settings import GuardSettings, MasterAddress

    address = MasterAddress.of(os.environ, port)
    raise typer.Exit(_guard(GuardSettings(address, python, directory, silent_s, rosout), log))


def _guard(settings: GuardSettings, log: _Log) -> int:
    """Guard until a signal comes, and return the exit status."""
    import asyncio
    import signal

    from holdfast.ros.master.guard import MasterGuard
    from holdfast.runtime.logs import EventLog
    from holdfast.runtime.service_manager import ServiceManager

    manager = ServiceManager()
    events = EventLog(sys.stderr, format=log.value, component=_COMPONENT)

    def ready(how: str) -> None:
        _say_ready(settings, log, how)
        manager.ready()

    async def run() -> signal.Signals:
        loop = asyncio.get_running_loop()
        told: asyncio.Future[signal.Signals] = loop.create_future()

        def tell(number: signal.Signals) -> None:
            if not told.done():
                told.set_result(number)

        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                loop.add_signal_handler(number, tell, number)
        manager.watch(loop, lambda: f"guards {settings.address.uri}")
        guarding = asyncio.create_task(MasterGuard(settings, events).run(ready))
        await asyncio.wait((told, guarding), return_when=asyncio.FIRST_COMPLETED)
        if guarding.done():
            await guarding
        events.event("stopping", reason=told.result().name)
        manager.stopping()
        guarding.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await guarding
        return told.result()

    try:
        number = asyncio.run(run())
        return 0 if number is signal.SIGTERM else 128 + number
    finally:
        manager.close()
        events.close()


def _say_ready(settings: GuardSettings, log: _Log, how: str) -> None:
    uri = settings.address.uri
    if log is _Log.json:
        from holdfast.runtime.logs import EventLog

        with EventLog(sys.stdout, format="json", component=_COMPONENT) as line:
            line.event("ready", service=uri, pid=os.getpid(), master=how)
        return
    # Nobody may be reading: that is no reason not to guard.
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.write(printable(f"guards the master at {uri}, which was {how}\n"))
        sys.stdout.flush()
