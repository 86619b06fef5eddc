"""A real ROS 1 master, and processes around it, each of which ends with its test."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.ports import free_port
from tests.ros.conftest import ROOT, left_out

PATIENCE_S = 30.0
SYSTEM_PYTHON = "/usr/bin/python3"
HOLDFAST = str(Path(sys.executable).with_name("holdfast"))


def until(condition: Callable[[], object], what: str) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"not in {PATIENCE_S} s: {what}")
        time.sleep(0.02)


def line_of(process: subprocess.Popen[str]) -> str:
    """Return the next line that a process writes; one that writes none in time is ended."""
    assert process.stdout is not None
    timer = threading.Timer(PATIENCE_S, process.kill)
    timer.start()
    try:
        return process.stdout.readline()
    finally:
        timer.cancel()


class Ros1:
    """ROS 1 around one master.

    Attributes
    ----------
    environment : dict of str
        For its processes.
    python : str
        The system's Python with rospy and holdfast.
    """

    def __init__(
        self, environment: Mapping[str, str], directory: Path, port: int | None = None
    ) -> None:
        made = Path(os.environ.get("ROS1", ROOT / ".ros1"))
        if not (made / ".built").exists():
            left_out(f"nothing for ROS 1 in {made}: make test-ros makes it")
        self.port = free_port() if port is None else port
        self.directory = directory
        self.python = str(made / "venv" / "bin" / "python")
        self.environment = {
            **environment,
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_LOG_DIR": str(directory / "ros"),
            "PYTHONPATH": str(made / "python"),
        }
        self.master: subprocess.Popen[bytes] | None = None
        self._stack = contextlib.ExitStack()

    def start_master(self) -> None:
        """Start one that knows nothing."""
        self.master = self.start("rosmaster", "--core", "-p", str(self.port))
        until(self.knows_anything, "the master answers")

    def start(
        self, *command: str, environment: Mapping[str, str] | None = None, **options: Any
    ) -> subprocess.Popen[Any]:
        """Start a process of this ROS."""
        process = subprocess.Popen(
            command,
            env={**self.environment, **(environment or {})},
            **{"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **options},
        )
        self._stack.callback(_end, process)
        return process

    def run(self, *command: str) -> str:
        """Run a tool to its end and return what it writes."""
        done = subprocess.run(
            command,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    def serve(self, name: str, configuration: Path, *more: str) -> subprocess.Popen[bytes]:
        """Start a typed service, and wait until the master knows it."""
        before = self.service_uri(name)
        process = self.start(
            *(HOLDFAST, "serve", "--ros1", "--ros1-name", name),
            *("--configuration", str(configuration), *more),
        )
        until(lambda: self.service_uri(name) not in (None, before), f"the master knows {name}")
        return process

    def service_uri(self, name: str) -> str | None:
        """Return where the master says that a service is."""
        code, _, uri = self.ask("lookupService", f"/{name}")
        return str(uri) if code == 1 else None

    def knows_anything(self) -> bool:
        """Whether the master answers."""
        with contextlib.suppress(OSError):
            return bool(self.ask("getPid")[0] == 1)
        return False

    def ask(self, method: str, *arguments: object) -> Sequence[Any]:
        """Ask the master."""
        with xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"]) as master:
            return list(getattr(master, method)("/test", *arguments))

    def close(self) -> None:
        """End all processes."""
        self._stack.close()


def _end(process: subprocess.Popen[Any]) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.kill()
    process.communicate()


def ros1_in(environment: Mapping[str, str], directory: Path) -> Iterator[Ros1]:
    """Give ROS 1 with a master; end all of its processes."""
    around = Ros1(environment, directory)
    try:
        around.start_master()
        yield around
    finally:
        around.close()
