"""Runs a command on a machine that stands still now and then, as shared ones do.

All processes of the command, and all that they start, are frozen together for a moment while the
clocks go on: leases run out, timeouts pass, and nobody has done anything wrong. What is not about
time must still come out the same::

    python -m tests.standstill -- .venv/bin/pytest -q tests/processes

With ``--one-core`` only those threads are held that run on one of the processors, as where a
hypervisor lends it to somebody else: the others go on, and overtake them where they never did.

It takes Linux with version 2 of the control groups mounted (5.2 or newer), and root's rights.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path


def mounted_groups() -> Path:
    """Return where the control groups are."""
    for line in Path("/proc/mounts").read_text().splitlines():
        _, place, kind, *_ = line.split()
        if kind == "cgroup2":
            return Path(place)
    raise SystemExit("standstill: no control groups of version 2 are mounted")


@contextlib.contextmanager
def frozen(group: Path) -> Iterator[None]:
    """All processes of a control group stand still."""
    (group / "cgroup.freeze").write_text("1")
    try:
        yield
    finally:
        (group / "cgroup.freeze").write_text("0")


SEIZE, INTERRUPT, DETACH = 0x4206, 0x4207, 17
"""Requests of ``ptrace``, which stops single threads, where signals stop processes."""

WAIT_ALL = 0x40000000
"""Option of ``waitpid``: for threads, too."""

trace = ctypes.CDLL(None, use_errno=True).ptrace
trace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
trace.restype = ctypes.c_long


def running_on(group: Path, core: int) -> Iterator[int]:
    """Threads of a control group that have, or wait for, a processor, or may use no other."""
    for pid in (group / "cgroup.procs").read_text().split():
        for thread in Path(f"/proc/{pid}/task").glob("*"):
            with contextlib.suppress(OSError):
                # After the name, which may hold anything: the state is the first, from 0 on.
                fields = (thread / "stat").read_text().rpartition(")")[2].split()
                name = int(thread.name)
                running = fields[0] == "R" and int(fields[36]) == core
                if running or os.sched_getaffinity(name) == {core}:
                    yield name


@contextlib.contextmanager
def held_back(group: Path, core: int) -> Iterator[None]:
    """Threads that run on a processor stand still, and all others go on."""
    held = {}
    with contextlib.suppress(OSError):  # a process that has just ended, another one's child
        for thread in list(running_on(group, core)):
            if trace(SEIZE, thread, None, None) == 0:
                trace(INTERRUPT, thread, None, None)
                _, status = os.waitpid(thread, WAIT_ALL)
                if os.WIFSTOPPED(status):
                    # A signal that came in between is handed on; else it is the interruption's.
                    held[thread] = 0 if status >> 16 else os.WSTOPSIG(status)
    try:
        yield
    finally:
        killed = {
            thread for thread, signal in held.items() if trace(DETACH, thread, None, signal) != 0
        }
        # Before its parent, it is we who have to hear of its end.
        while killed:
            for thread in list(killed):
                try:
                    ended, _ = os.waitpid(thread, WAIT_ALL | os.WNOHANG)
                except OSError:
                    ended = thread
                killed -= {ended}
            time.sleep(0.001)


def run(
    command: list[str], every_s: float, longest_s: float, chance: random.Random, *, one_core: bool
) -> int:
    """Run a command to its end; return its exit status."""
    group = mounted_groups() / f"holdfast-standstill-{os.getpid()}"
    try:
        group.mkdir()
    except OSError as error:
        raise SystemExit(f"standstill: {group}: {error.strerror}") from None
    count, total_s = 0, 0.0
    try:
        process = subprocess.Popen(
            # It puts itself there, so that whatever it starts is there too.
            ["/bin/sh", "-c", 'echo $$ >"$0" && exec "$@"', str(group / "cgroup.procs"), *command]
        )
        try:
            while process.poll() is None:
                time.sleep(every_s * chance.uniform(0.3, 1.7))
                length_s = longest_s * chance.uniform(0.5, 1.0)
                core = chance.choice(sorted(os.sched_getaffinity(0)))
                with held_back(group, core) if one_core else frozen(group):
                    time.sleep(length_s)
                count += 1
                total_s += length_s
        except KeyboardInterrupt:
            pass  # the command has heard of it too
        status = process.wait()
    finally:
        # Whoever has outlived the command would keep the group.
        for _ in range(100):
            for pid in (group / "cgroup.procs").read_text().split():
                print(f"standstill: process {pid} has outlived the command", file=sys.stderr)
                (group.parent / "cgroup.procs").write_text(pid)
            try:
                group.rmdir()
                break
            except OSError:
                time.sleep(0.01)
    print(f"standstill: {count} times, {total_s:.1f} s together", file=sys.stderr)
    return status


def main() -> int:
    """Read the command line and run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--every-ms", type=float, default=1000.0, help="on average")
    parser.add_argument("--longest-ms", type=float, default=900.0, help="the shortest is half")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--one-core", action="store_true", help="only threads that run on one")
    parser.add_argument("command", nargs="+", metavar="COMMAND")
    options = parser.parse_args()
    return run(
        options.command,
        options.every_ms / 1e3,
        options.longest_ms / 1e3,
        random.Random(options.seed),
        one_core=options.one_core,
    )


if __name__ == "__main__":
    sys.exit(main())
