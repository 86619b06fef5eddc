"""A ROS 1 graph of its own: a guard, masters, and nodes of others, each of which ends with it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests.ros.conftest import PATIENCE_S, left_out
from tests.ros.ros1_processes import SYSTEM_PYTHON, AtMaster, wait_for

TOPIC_TOOLS = Path("/usr/lib/topic_tools")
"""Stock roscpp nodes; /opt/ros has them elsewhere."""

NODES = {
    # Publishes 1, 2, 3, ... fifty times a second.
    "talker": """
import sys, rospy
from std_msgs.msg import UInt64
rospy.init_node(sys.argv[1].strip("/"))
publisher = rospy.Publisher(sys.argv[2], UInt64, queue_size=1000)
rate, number = rospy.Rate(50), 0
while not rospy.is_shutdown():
    number += 1
    publisher.publish(number)
    rate.sleep()
""",
    # Prints what it hears.
    "listener": """
import sys, rospy
from std_msgs.msg import UInt64
rospy.init_node(sys.argv[1].strip("/"))
rospy.Subscriber(sys.argv[2], UInt64, lambda said: print(said.data, flush=True))
rospy.spin()
""",
    # Has services; ends one of them when told on standard input.
    "server": """
import sys, rospy
from roscpp.srv import Empty, EmptyResponse
rospy.init_node(sys.argv[1].strip("/"))
services = [rospy.Service(name, Empty, lambda _: EmptyResponse()) for name in sys.argv[2:]]
print("offers", flush=True)
for line in sys.stdin:
    services.pop().shutdown()
    print("ended one", flush=True)
rospy.spin()
""",
    # Calls over one connection, all the time.
    "caller": """
import sys, rospy
from roscpp.srv import Empty
rospy.init_node(sys.argv[1].strip("/"))
rospy.wait_for_service(sys.argv[2])
call = rospy.ServiceProxy(sys.argv[2], Empty, persistent=True)
while not rospy.is_shutdown():
    call()
    print("answered", flush=True)
    rospy.sleep(0.01)
""",
    # A newcomer: one message, and one call over a connection of its own.
    "newcomer": """
import sys, rospy
from roscpp.srv import Empty
from std_msgs.msg import UInt64
rospy.init_node("newcomer", anonymous=True)
rospy.wait_for_message(sys.argv[1], UInt64, timeout=20)
rospy.wait_for_service(sys.argv[2], timeout=20)
rospy.ServiceProxy(sys.argv[2], Empty)()
""",
    # Prints a parameter that it keeps a copy of whenever it has another value.
    "watcher": """
import sys, rospy
rospy.init_node(sys.argv[1].strip("/"))
seen = None
while not rospy.is_shutdown():
    now = rospy.get_param_cached(sys.argv[2], None)
    if now != seen:
        print(now, flush=True)
        seen = now
    rospy.sleep(0.02)
""",
}


class Process:
    """A process, what it printed, and its end."""

    def __init__(
        self, words: list[str], environment: Mapping[str, str], place: Path, *, reads: bool = False
    ) -> None:
        self._out, self._errors = place.with_suffix(".out"), place.with_suffix(".err")
        with self._out.open("wb") as out, self._errors.open("wb") as errors:
            self.process = subprocess.Popen(
                words,
                env=dict(environment),
                stdin=subprocess.PIPE if reads else subprocess.DEVNULL,
                stdout=out,
                stderr=errors,
                cwd=place.parent,
                start_new_session=True,
            )

    @property
    def lines(self) -> list[str]:
        """The whole lines that it has printed."""
        return self._out.read_text().split("\n")[:-1]

    @property
    def size(self) -> int:
        """How many bytes it has printed."""
        return self._out.stat().st_size

    @property
    def errors(self) -> str:
        return self._errors.read_text()

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()

    def account(self) -> str:
        return "\n".join(
            (
                f"{self.process.args!r}: {self.process.poll()}",
                self._out.read_text()[-2000:],
                self.errors[-6000:],
            )
        )

    def end(self, number: int = signal.SIGKILL) -> int:
        if self.process.poll() is None:
            self.process.send_signal(number)
        code = self.process.wait(PATIENCE_S)
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):
                self.process.stdin.close()
        return code


class Graph(AtMaster):
    """Everything at one master's port."""

    def __init__(self, directory: Path, environment: Mapping[str, str]) -> None:
        super().__init__(
            environment,
            directory,
            ROS_HOME=str(directory / "home"),
            XDG_RUNTIME_DIR=str(directory / "run"),
        )
        (directory / "run").mkdir()
        self.journal = directory / "run" / "ros1_master_guard" / f"master-{self.port}.journal"
        self._processes: list[Process] = []
        self._masters: set[int] = set()
        self._guard: Process | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for process in reversed(self._processes):
            process.end(signal.SIGTERM if process is self._guard else signal.SIGKILL)
        # A master that outlived its guard, and a /rosout.
        for pid in self._left():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _left(self) -> list[int]:
        """Return the processes that still have this graph's environment."""
        mine = f"ROS_LOG_DIR={self.environment['ROS_LOG_DIR']}".encode()
        found = []
        for path in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if path.name.isdigit() and mine in (path / "environ").read_bytes().split(b"\0"):
                    found.append(int(path.name))
        return found

    def start(self, *words: str, name: str = "", reads: bool = False) -> Process:
        """Start a process in this graph."""
        place = self.directory / f"{len(self._processes):02}-{name or Path(words[0]).name}"
        process = Process(list(words), self.environment, place, reads=reads)
        self._processes.append(process)
        return process

    def node(self, kind: str, *words: str) -> Process:
        """Start a stock rospy node."""
        return self.start(
            SYSTEM_PYTHON, "-c", NODES[kind], *words, name=kind, reads=kind == "server"
        )

    def guard(self, *words: str, before: Sequence[str] = ()) -> Process:
        """Start a guard, and wait until it guards."""
        command = [*before, sys.executable, "-m", "holdfast", "ros1-guard", "--log", "json", *words]
        self._guard = guard = self.start(*command, name="guard")
        wait_for(lambda: guard.lines or guard.process.poll() is not None, guard.account)
        assert guard.process.poll() is None, guard.account()
        return guard

    def events(self, guard: Process, name: str) -> list[dict[str, Any]]:
        """Return a guard's events of one kind."""
        events = [json.loads(line) for line in guard.errors.split("\n")[:-1] if line[:1] == "{"]
        return [event for event in events if event["event"] == name]

    def master_pid(self) -> int:
        pid = self.ask("getPid")[2]
        assert isinstance(pid, int)
        return pid

    def rosout_pid(self) -> int:
        with xmlrpc.client.ServerProxy(self.ask("lookupNode", "/rosout")[2]) as node:
            pid = node.getPid("/test")[2]  # type: ignore[index]
        assert isinstance(pid, int)
        return pid

    def incoming(self, name: str, topic: str) -> list[tuple[int, str]]:
        """Return a node's connections to publishers: its number for each, and whose it is."""
        with xmlrpc.client.ServerProxy(self.ask("lookupNode", name)[2]) as node:
            connections: Any = node.getBusInfo("/test")[2]  # type: ignore[index]
        return sorted(
            (each[0], each[1]) for each in connections if (each[2], each[4]) == ("i", topic)
        )

    def kill_master(self) -> int:
        """Kill the master -9, and return which process it was."""
        pid = self.master_pid()
        os.kill(pid, signal.SIGKILL)
        return pid

    def newcomer(self, topic: str, service: str) -> None:
        """Have a new node hear a topic and call a service."""
        self.run(SYSTEM_PYTHON, "-c", NODES["newcomer"], topic, service)

    def listed(self) -> dict[str, list[str]]:
        """Return what ROS's own commands list."""
        found = {}
        for words in (
            ("rosservice", "list"),
            ("rostopic", "list", "-v"),
            ("rosnode", "list"),
            ("rosparam", "get", "/"),
        ):
            lines = self.run(*words).splitlines()
            found[" ".join(words)] = lines if words[0] == "rosparam" else sorted(lines)
        return found

    def registered(self) -> dict[str, Any]:
        """Return what the master knows, names and addresses alike."""
        publishers, subscribers, services = self.ask("getSystemState")[2]
        names = {
            name
            for table in (publishers, subscribers, services)
            for _, registered in table
            for name in registered
        }
        return {
            "publishers": {topic: sorted(registered) for topic, registered in publishers},
            "subscribers": {topic: sorted(registered) for topic, registered in subscribers},
            "services": {name: self.ask("lookupService", name)[2] for name, _ in services},
            "nodes": {name: self.ask("lookupNode", name)[2] for name in names},
            "types": dict(self.ask("getTopicTypes")[2]),
            "parameters": self.ask("getParam", "/")[2],
        }

    def wait_for_node(self, name: str) -> None:
        wait_for(lambda: self.ask("lookupNode", name)[0] == 1, lambda: f"no {name}")


def topic_tool(name: str) -> str:
    path = TOPIC_TOOLS / name
    if not path.exists():
        left_out(f"no {path}: apt-get install topic-tools")
    return str(path)


def count(process: Process) -> int:
    return len(process.lines)


def keeps_on(process: Process, more: int = 5) -> None:
    """Wait until a process has printed some more lines."""
    before = count(process)
    wait_for(
        lambda: count(process) >= before + more or process.process.poll() is not None,
        process.account,
    )
    assert process.process.poll() is None, process.account()


def replaced(graph: Graph, killed: int) -> None:
    """Wait until another master answers."""
    wait_for(lambda: graph.master_pid() != killed)


def known_to_guard(graph: Graph) -> None:
    """Wait until the guard knows all that a master of others, which it asks, knows by now."""
    for mark in (b"asked", b"asked_again"):  # the first may come between two of its questions
        assert graph.ask("setParam", f"/{mark.decode()}", 1)[0] == 1
        wait_for(lambda: mark in graph.journal.read_bytes())  # noqa: B023


def start_everything(graph: Graph) -> tuple[Process, Process]:
    """Start nodes of others; return one that calls, and one that hears, all the time."""
    graph.node("talker", "/talker", "/chatter")
    graph.node("server", "/server", "/work", "/more_work")
    graph.start(topic_tool("relay"), "/chatter", "/relayed", "__name:=relay")
    graph.start(topic_tool("mux"), "/muxed", "/chatter", "/relayed", "__name:=mux")
    listener = graph.node("listener", "/listener", "/relayed")
    caller = graph.node("caller", "/caller", "/work")
    keeps_on(listener)
    keeps_on(caller)
    for node in ("/mux", "/relay", "/talker", "/rosout"):
        graph.wait_for_node(node)
    graph.run(
        "rosparam", "set", "/robot", "{name: Ada, joints: [1, 2.5, x], gripper: {open: true}}"
    )
    return caller, listener


def settled(graph: Graph) -> dict[str, list[str]]:
    """Return the listing once it has not changed for a moment."""
    listing: dict[str, list[str]] = unchanged(graph.listed, 0.2)
    return listing


def unchanged(read: Callable[[], Any], for_s: float) -> Any:
    """Return a value that has been the same for so long."""
    before = None
    while before != (before := read()):
        time.sleep(for_s)
    return before
