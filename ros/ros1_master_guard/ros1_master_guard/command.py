"""The command: guards a ROS 1 master until a signal comes."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from ros1_master_guard.errors import GuardError
from ros1_master_guard.events import EventLog, json_line
from ros1_master_guard.guard import MasterGuard
from ros1_master_guard.settings import GuardSettings, MasterAddress

_ABOUT = """\
Guard the ROS 1 master: when it dies, the next one knows all that it knew.

Start it instead of roscore. It starts a master, or guards the one that runs on this machine, and
/rosout. When the master is killed or hangs, a new one takes its place, with all services,
publishers, subscribers and parameters. No node is started again, and connections between nodes go
on meanwhile. Ctrl-C or SIGTERM ends the guard and the master that it started.

If the guard is killed, the master lives on: start another guard. If both are killed, the next guard
goes on where they stopped, if a node of theirs still runs.

Exit codes: 0 after SIGTERM; 2 an error; 128 + N ended by the signal N."""


def _between(least: float, most: float, read: Callable[[str], float]) -> Callable[[str], float]:
    def checked(text: str) -> float:
        with contextlib.suppress(ValueError):
            if least <= (value := read(text)) <= most:
                return value
        kind = "whole numbers" if read is int else "numbers"
        allowed = f"allowed are {kind} from {least:g} to {most:g}"
        raise argparse.ArgumentTypeError(f"is {text!r:.80}; {allowed}")

    return checked


def _directory(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("is empty; it must name a directory")
    return Path(text).absolute()


def _parser(program: str) -> argparse.ArgumentParser:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        program, description=_ABOUT, formatter_class=form, allow_abbrev=False
    )
    add = parser.add_argument
    text = "the master's port (default: that of ROS_MASTER_URI, or 11311)"
    add("--port", metavar="N", type=_between(1, 65_535, int), help=text)
    text = "a master that has not answered for this long is killed and replaced (default: 3)"
    add("--silent-s", metavar="S", type=_between(0.5, 3600.0, float), default=3.0, help=text)
    text = "run /rosout, too, as roscore does"
    add("--rosout", action=argparse.BooleanOptionalAction, default=True, help=text)
    text = "ROS's Python, which has rosmaster (default: /usr/bin/python3)"
    add("--python", metavar="FILE", default="/usr/bin/python3", help=text)
    text = "where registrations are written (default: a directory that a reboot removes)"
    add("--directory", metavar="DIR", type=_directory, help=text)
    text = "form of the ready line and of the log on standard error (default: text)"
    add("--log", choices=("text", "json"), default="text", help=text)
    return parser


def main(arguments: Sequence[str] | None = None, program: str = "ros1_master_guard") -> int:
    """Guard until a signal comes, and return the exit code."""
    given = _parser(program).parse_args(arguments)
    events = EventLog(sys.stderr, as_json=given.log == "json")
    try:
        address = MasterAddress.of(os.environ, given.port)
        options = given.python, given.directory, given.silent_s, given.rosout
        number = asyncio.run(_guard(GuardSettings(address, *options), events))
    except GuardError as error:
        if events.as_json:
            events.event("error", reason=str(error))
        else:
            sys.stderr.write(f"{program}: error: {error}\n")
        return 2
    finally:
        events.close()
    return 0 if number is signal.SIGTERM else 128 + number


async def _guard(settings: GuardSettings, events: EventLog) -> signal.Signals:
    loop = asyncio.get_running_loop()
    ended: asyncio.Future[signal.Signals] = loop.create_future()

    def end(number: signal.Signals) -> None:
        if not ended.done():
            ended.set_result(number)

    def ready(how: str) -> None:
        uri = settings.address.uri
        told = {"service": uri, "pid": os.getpid(), "master": how}
        text = f"guards the master at {uri}, which was {how}"
        line = json_line("ready", told) if events.as_json else text
        # A closed standard output is no reason not to guard.
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()

    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            loop.add_signal_handler(number, end, number)
    guarding = asyncio.create_task(MasterGuard(settings, events).run(ready))
    await asyncio.wait((ended, guarding), return_when=asyncio.FIRST_COMPLETED)
    if guarding.done():
        await guarding
    events.event("stopping", reason=ended.result().name)
    guarding.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await guarding
    return ended.result()
