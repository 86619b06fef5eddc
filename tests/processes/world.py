"""The robot's world in the test's own process, and a gate before its computations.

Every time the robot senses or moves, a test may hold it there and do something: so a fault is
injected at a step, not after a time. The world also counts and keeps what it was made to do.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tests.ports import free_port

from holdfast.config.loader import Configuration
from holdfast.journal.journal import Journal
from holdfast.planning.inputs import ActingRecord
from holdfast.robot.environment import SimulatedEnvironment

PATIENCE_S = 180.0
"""For whatever must happen; on a machine that is not busy it takes a fraction of a second."""

Hook = Callable[[], object]


class World:
    """What the robots of one run act on, and the witness of what they did."""

    def __init__(self, configuration: Configuration) -> None:
        self._problem = configuration.problem
        self._seed = configuration.simulator.seed
        self._trial = -1
        self._environment: SimulatedEnvironment | None = None
        self._hooks: dict[tuple[int, str, int, bool], Hook] = {}
        self._lock = threading.Lock()
        self._operator: socket.socket | None = None
        self._threads: list[threading.Thread] = []
        self._connections: list[socket.socket] = []
        self._failures: list[BaseException] = []
        self.performed: dict[int, list[bytes]] = {}
        self.wrongs: list[str] = []
        self._listener = socket.create_server(("127.0.0.1", free_port()))
        self.port: int = self._listener.getsockname()[1]
        self._start(self._accept)

    def on(
        self, what: str, step: int, hook: Hook, *, trial: int = 0, afterwards: bool = False
    ) -> None:
        """Do something, once, when a robot begins (``begin``), senses or performs at a step.

        Before it is carried out, or afterwards; in any case before the robot has an answer. If the
        robot has died by then, what it asked for is not carried out any more.
        """
        self._hooks[trial, what, step, afterwards] = hook

    @property
    def step(self) -> int:
        """How many task actions were carried out in this trial."""
        return 0 if self._environment is None else self._environment.step

    def become(self, other: World) -> None:
        """Take on the state of another world, as it is now."""
        self._trial = other._trial
        self.performed = {trial: actions.copy() for trial, actions in other.performed.items()}
        actions = [np.frombuffer(action) for action in self.performed[self._trial]]
        self._environment = SimulatedEnvironment.after(
            self._problem, self._seed, self._trial, actions
        )

    def close(self) -> None:
        """Hang up, and raise what a hook has raised."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self._connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(PATIENCE_S)
        self.check()

    def check(self) -> None:
        """Raise what a hook has raised."""
        failures = self._failures.copy()
        self._failures.clear()
        if failures:
            raise failures[0]

    def assert_each_once(self, reference: Path) -> None:
        """Compare with a run without faults: every action was performed once, in its order."""
        assert not self.wrongs
        with Journal.read(reference / "journal.bin") as journal:
            for trial in sorted(journal.finished()):
                expected = [
                    decision.action
                    for decision in journal.decisions(trial)
                    if isinstance(decision, ActingRecord)
                ]
                assert self.performed[trial] == expected
        assert not self._hooks, "the run has passed by without these"

    def _start(self, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connections.append(connection)
            # Who connected last operates it, as with a real controller.
            self._operator = connection
            self._start(self._serve, connection)

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("r") as lines:
                for line in lines:
                    with self._lock:
                        if connection is not self._operator:
                            return
                        answer = self._do(connection, json.loads(line))
                    if answer is None:
                        return
                    connection.sendall(json.dumps(answer).encode() + b"\n")
        except OSError:
            pass
        except BaseException as error:  # noqa: BLE001 - for the test's own thread to raise
            self._failures.append(error)

    def _do(self, connection: socket.socket, command: dict[str, Any]) -> dict[str, Any] | None:
        what = command["do"]
        if what == "begin":
            self._begin(command["trial"], resumed=command["resumed"])
            self._call_hook("begin", afterwards=False)
            return {}
        environment = self._environment
        assert environment is not None
        if what == "is_done":
            return {"done": environment.is_done()}
        if what == "count":
            return {"count": environment.step}
        step = environment.step
        self._call_hook(what, afterwards=False, step=step)
        if _has_hung_up(connection):
            return None
        answer: dict[str, Any]
        if what == "sense":
            shown = environment.perform_sensing(command["sensing_action"])
            answer = {"observation": shown.tolist()}
        else:
            action = np.array(command["task_action"])
            answer = {"reward": environment.perform(action)}
            self.performed[self._trial].append(action.tobytes())
        self._call_hook(what, afterwards=True, step=step)
        return answer

    def _begin(self, trial: int, *, resumed: bool) -> None:
        if resumed and trial != self._trial:
            self.wrongs.append(f"trial {trial} is resumed in the midst of trial {self._trial}")
        if not resumed:
            if self.performed.get(trial):
                self.wrongs.append(f"trial {trial} is begun again")
            self._trial = trial
            self._environment = SimulatedEnvironment(self._problem, self._seed, trial)
            self.performed[trial] = []

    def _call_hook(self, what: str, *, afterwards: bool, step: int | None = None) -> None:
        assert self._environment is not None
        at = self._environment.step if step is None else step
        hook = self._hooks.pop((self._trial, what, at, afterwards), None)
        if hook is not None:
            hook()


def _has_hung_up(connection: socket.socket) -> bool:
    try:
        return connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


class Gate:
    """Stands before each longer computation of ``gated_problem`` in the processes that have it."""

    def __init__(self, holds_at: int) -> None:
        self._holds_at = holds_at
        self._opened = threading.Event()
        self._reached = threading.Event()
        self._arrivals = 0
        self._listener = socket.create_server(("127.0.0.1", free_port()))
        self.port: int = self._listener.getsockname()[1]
        self._held: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept)
        self._thread.start()

    def wait(self) -> None:
        """Wait until a computation is held."""
        assert self._reached.wait(PATIENCE_S), f"only {self._arrivals} computations were begun"

    def open(self) -> None:
        """Hold nothing any more."""
        self._opened.set()
        for held in self._held:
            held.close()

    def close(self) -> None:
        self.open()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(PATIENCE_S)

    def _accept(self) -> None:
        while True:
            try:
                passing, _ = self._listener.accept()
            except OSError:
                return
            passing.recv(100)  # what is closed with unread data is reset
            if self._arrivals >= self._holds_at and not self._opened.is_set():
                self._held.append(passing)
                self._reached.set()
            else:
                passing.close()
            self._arrivals += 1
