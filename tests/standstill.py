"""Runs a command on a machine that stands still now and then, as shared ones do.

All processes of the command, and all that they start, are frozen together for a moment while the
clocks go on: leases run out, timeouts pass, and nobody has done anything wrong. What is not about
time must still come out the same::

    python -m tests.standstill -- .venv/bin/pytest -q tests/processes

It takes Linux with version 2 of the control groups mounted (5.2 or newer), and root's rights.
"""

import argparse
import contextlib
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


def run(command: list[str], every_s: float, longest_s: float, chance: random.Random) -> int:
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
                with frozen(group):
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
    parser.add_argument("command", nargs="+", metavar="COMMAND")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    return run(options.command, options.every_ms / 1e3, options.longest_ms / 1e3, chance)


if __name__ == "__main__":
    sys.exit(main())
