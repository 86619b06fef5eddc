"""A real ROS 1 master, and processes around it, each of which ends with its test."""

import contextlib
import os
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tests.ports import free_port
from tests.programs import completed
from tests.ros.conftest import PATIENCE_S, ROOT, left_out

SYSTEM_PYTHON = "/usr/bin/python3"
HOLDFAST = str(Path(sys.executable).with_name("holdfast"))


def wait_for(true: Callable[[], object], what: str | Callable[[], str] = "") -> None:
    """Wait until something is true; a connection that breaks is not."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        with contextlib.suppress(OSError, xmlrpc.client.Error, EOFError):
            if true():
                return
        if time.monotonic() > deadline:
            raise AssertionError(what if isinstance(what, str) else what())
        time.sleep(0.01)


class AtMaster:
    """What is said to the master at one port."""

    def __init__(
        self,
        environment: Mapping[str, str],
        directory: Path,
        port: int | None = None,
        **variables: str,
    ) -> None:
        self.port = free_port() if port is None else port
        self.directory = directory
        self.environment = {
            **environment,
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_LOG_DIR": str(directory / "log"),
            **variables,
        }

    def ask(self, method: str, *arguments: object, caller: str = "/test") -> Any:
        """Return the master's whole answer: a code, a text and a value."""
        with xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"]) as master:
            return getattr(master, method)(caller, *arguments)

    def run(self, *words: str) -> str:
        """Run a command to its end, and return what it prints."""
        done = completed(words, env=self.environment, cwd=self.directory, timeout=PATIENCE_S)
        assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done.stdout


class Ros1(AtMaster):
    """ROS 1 around one master."""

    def __init__(
        self, environment: Mapping[str, str], directory: Path, port: int | None = None
    ) -> None:
        made = Path(os.environ.get("ROS1", ROOT / ".ros1"))
        if not (made / ".built").exists():
            left_out(f"nothing for ROS 1 in {made}: make test-ros makes it")
        super().__init__(environment, directory, port, PYTHONPATH=str(made / "python"))
        self.python = str(made / "venv" / "bin" / "python")
        self.master: subprocess.Popen[bytes] | None = None
        self._stack = contextlib.ExitStack()

    def start_master(self) -> None:
        """Start one that knows nothing."""
        self.master = self.start("rosmaster", "--core", "-p", str(self.port))
        wait_for(lambda: self.ask("getPid")[0] == 1, "the master answers")

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

    def serve(self, name: str, configuration: Path, *more: str) -> subprocess.Popen[bytes]:
        """Start a typed service, and wait until the master knows it."""
        before = self.service_uri(name)
        process = self.start(
            *(HOLDFAST, "ros1-serve", "--ros1-name", name),
            *("--configuration", str(configuration), *more),
        )
        wait_for(lambda: self.service_uri(name) not in (None, before), f"the master knows {name}")
        return process

    def service_uri(self, name: str) -> str | None:
        """Return where the master says that a service is."""
        code, _, uri = self.ask("lookupService", f"/{name}")
        return str(uri) if code == 1 else None

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
