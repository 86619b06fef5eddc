"""Robots in this process, the production code with a notebook: when it sent, decided, logged.

The robot is :class:`holdfast.robot.process.RobotProcess`, with its journal and the links
that the configuration asks for. All that is added stands outside of it: whatever it hands to a
transport, a log or a table goes through here and gets the time of one clock written on it.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from time import time
from typing import NamedTuple

from holdfast.config.loader import Configuration, load
from holdfast.journal.run_directory import RunDirectory
from holdfast.planning.outcome import TrialResult
from holdfast.protocol.robot_events import Timing, TransportEvent
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.links import make_links
from holdfast.robot.process import RobotProcess
from holdfast.transport.contract import RobotTransport

__all__ = ["Notebook", "configuration_for", "robot_in_thread", "run_robot"]

_CONFIGURATION = """\
problem: peg_in_hole_2d
particle_filter: {{num_particles: {num_particles}}}
simulator:
  num_trials: {num_trials}
  max_steps: 500
  sensing_intervals: {sensing_interval}
  seed: 0
recovery: {{launch: {launch}}}
offload: {{services: {services}, what: {what}}}
"""

_PATIENCE_S = 30.0


def configuration_for(
    directory: Path,
    *,
    num_trials: int,
    services: tuple[str, ...] = (),
    launch: str = "never",
    num_particles: int = 100,
    sensing_interval: int = 8,
    what: str = "all",
) -> Configuration:
    """Return the published settings (M = 10, k = 5, H = 1, interval 8), with services.

    ``what`` they decide: ``all``, or ``sensing`` alone.
    """
    path = directory / "robot.yaml"
    path.write_text(
        _CONFIGURATION.format(
            num_particles=num_particles,
            sensing_interval=sensing_interval,
            num_trials=num_trials,
            launch=launch,
            services=list(services),
            what=what,
        )
    )
    return load(path)


class _Event(NamedTuple):
    at: float
    name: str
    fields: dict[str, object]


class _Decided(NamedTuple):
    at: float
    timing: Timing


class _Finished(NamedTuple):
    at: float
    result: TrialResult


class _EnoughError(Exception):
    """The robot has run long enough."""


class Notebook:
    """What happened to a robot, with times in seconds since the epoch.

    Attributes
    ----------
    events : list
        Events: ``at``, ``name``, ``fields``.
    decided : list
        Decisions that were used: ``at``, ``timing``.
    finished : list
        Trials: ``at``, ``result``.
    num_sent : int
        Requests.
    on_decided : callable or None
        Is called with each decision that is used.
    on_sent : callable or None
        Is called with the service's name right after a request to it.
    """

    def __init__(self) -> None:
        self.events: list[_Event] = []
        self.decided: list[_Decided] = []
        self.finished: list[_Finished] = []
        self.num_sent = 0
        self.on_decided: Callable[[Timing], None] | None = None
        self.on_sent: Callable[[str], None] | None = None
        self._changed = threading.Condition()
        self._ending = False
        self._error: BaseException | None = None

    def event(self, name: str, /, **fields: object) -> None:
        """Note an event."""
        with self._changed:
            self.events.append(_Event(time(), name, fields))
            self._changed.notify_all()

    def close(self) -> None:
        """Do nothing: it is a sink of events."""

    def add_timing(self, timing: Timing) -> None:
        """Note a decision."""
        with self._changed:
            self.decided.append(_Decided(time(), timing))
            self._changed.notify_all()
        if self.on_decided is not None:
            self.on_decided(timing)
        if self._ending:
            raise _EnoughError

    def add_result(self, result: TrialResult) -> None:
        """Note a trial."""
        with self._changed:
            self.finished.append(_Finished(time(), result))
            self._changed.notify_all()

    def sent(self, service: str) -> None:
        """Note a request."""
        self.num_sent += 1
        if self.on_sent is not None:
            self.on_sent(service)

    def end(self) -> None:
        """Let the robot run no longer than to its next decision."""
        self._ending = True

    def failed(self, error: BaseException) -> None:
        """Note that the robot cannot go on."""
        with self._changed:
            self._error = error
            self._changed.notify_all()

    def wait_for(self, seen: Callable[[], bool], what: str) -> None:
        """Wait until something has been noted."""
        with self._changed:
            self._changed.wait_for(lambda: self._error is not None or seen(), _PATIENCE_S)
            if self._error is not None:
                raise self._error
            if not seen():
                raise RuntimeError(f"{what}: did not happen within {_PATIENCE_S:g} s")

    def first_event(self, name: str, since: float, **fields: object) -> _Event | None:
        """Return the first event of a name and with these fields since some time."""
        return next(
            (
                each
                for each in self.events
                if each.at >= since and each.name == name and fields.items() <= each.fields.items()
            ),
            None,
        )

    def first_decided(self, service: str, since: float) -> _Decided | None:
        """Return the first decision of a service that was used since some time."""
        late = (each for each in self.decided if each.at >= since)
        return next((each for each in late if each.timing.service == service), None)


class _NotedTransport:
    """Passes everything on to a transport, and notes the requests."""

    def __init__(self, transport: RobotTransport, notebook: Notebook) -> None:
        self._transport = transport
        self._notebook = notebook
        self.start: Callable[[Callable[[TransportEvent], None]], None] = transport.start
        self.abandon: Callable[[int], None] = transport.abandon

    def call(self, service: str, call: int, payload: bytes) -> None:
        self._transport.call(service, call, payload)
        self._notebook.sent(service)

    async def close(self, timeout_s: float = 1.0) -> None:
        await self._transport.close(timeout_s)


def run_robot(
    configuration: Configuration,
    directory: Path,
    notebook: Notebook,
    rate_hz: float | None = None,
) -> RobotProcess:
    """Run all trials of a configuration, as ``holdfast run`` does, into an empty directory.

    Parameters
    ----------
    rate_hz : float or None
        Task actions a second.
    """
    links = make_links(configuration, directory / "recovery.log", notebook)
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(RunDirectory.create(directory / "run", configuration))

        def on_result(result: TrialResult) -> None:
            run.add(result)
            notebook.add_result(result)

        robot = RobotProcess(
            configuration,
            links
            if links.transport is None
            else links._replace(transport=_NotedTransport(links.transport, notebook)),
            run.journal,
            load_environment(configuration),
            notebook,
            on_result,
            notebook.add_timing,
            lambda _: None,
            rate_hz,
        )
        with contextlib.suppress(_EnoughError):
            robot.run(run.journal.finished())
        return robot


@contextlib.contextmanager
def robot_in_thread(configuration: Configuration, directory: Path) -> Iterator[Notebook]:
    """Have a robot run, as fast as it goes, while something is done to its services."""
    notebook = Notebook()

    def run() -> None:
        try:
            run_robot(configuration, directory, notebook)
        except BaseException as error:  # noqa: BLE001 - it is raised where the robot is watched
            notebook.failed(error)

    thread = threading.Thread(target=run, name="robot")
    thread.start()
    try:
        yield notebook
    finally:
        notebook.end()
        thread.join(_PATIENCE_S)
