"""What is to go wrong in one simulated run: plain data, and readable text.

All that happens to a run is written down before, to the single message that is lost, so a run can
be repeated, and made smaller by leaving lines out. A schedule as text has one line for each item:
what it is, and its values. Times are seconds::

    run trial=3 replicas=2 deadline_ms=15
    crash service=cloud-1 at=0.12 down_s=0.4
    message service=cloud-1 direction=from number=7 what=delay seconds=0.05
    kill_robot boundary=57 down_s=0.2

What is left out has the value that it has in a run without faults. docs/reliability.md explains all
keys.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias, get_args

import msgspec

from holdfast_lab.errors import ScheduleError

LOCAL_SERVICE = "local"
"""Name of the service that the robot launches for itself."""

NUM_TRIALS = 64
"""Trials to choose from; each has one run without faults, that all others are compared with."""

_LONG_S, _MANY_SESSIONS = 60.0, 100
"""A run is shorter, and has fewer robots at a time."""

Seconds = Annotated[float, msgspec.Meta(ge=0.0, le=3600.0)]
Offset = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Count = Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]
Node = Annotated[str, msgspec.Meta(pattern="^(robot|local|cloud-[1-9])$")]
Service = Annotated[str, msgspec.Meta(pattern="^(local|cloud-[1-9])$")]
Direction = Literal["to", "from", "both"]


class _Item(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    @property
    def kind(self) -> str:
        """The word that its line begins with; of a message, what happens to it."""
        return str(self.__struct_config__.tag)


class RunSettings(_Item, frozen=True, kw_only=True, tag="run", tag_field="item"):
    """What a run is like as long as nothing goes wrong."""

    trial: Annotated[int, msgspec.Meta(ge=0, lt=NUM_TRIALS)] = 0
    num_trials: Annotated[int, msgspec.Meta(ge=1, le=4)] = 1
    replicas: Annotated[int, msgspec.Meta(ge=1, le=9)] = 1
    launch: Literal["on_failure", "at_start", "never"] = "on_failure"
    what: Literal["sensing", "all"] = "all"
    deadline_ms: Annotated[float, msgspec.Meta(gt=0.0, le=1e6)] | None = None
    rate_hz: Annotated[float, msgspec.Meta(ge=0.1, le=1e6)] | None = None
    sense_s: Seconds = 0.001
    act_s: Seconds = 0.01
    latency_s: Seconds = 0.001
    jitter_s: Seconds = 0.0
    task_s: Seconds = 0.001
    sensing_s: Seconds = 0.003
    launch_s: Seconds = 0.15
    workers: Annotated[int, msgspec.Meta(ge=1, le=64)] = 2
    sessions_kept: Annotated[int, msgspec.Meta(ge=1)] = 100
    answers_kept: Annotated[int, msgspec.Meta(ge=1)] = 8
    certificates: bool = False
    forgets_after_s: Seconds = 600.0
    environment: Literal["simulated", "counting", "not_counting"] = "counting"
    remembers: bool = False
    senses_on: bool = False
    moves_show: bool = False
    sensing_is_optional: bool = False
    on_lost: Literal["continue", "reinitialise"] = "continue"
    journal_survives: Literal["process_crash", "power_cut"] = "process_crash"
    lease_s: Annotated[float, msgspec.Meta(gt=0.0, le=3600.0)] = 0.4
    bytes_per_s: Annotated[float, msgspec.Meta(ge=1000.0, le=1e12)] | None = None
    lost_in_cut: bool = True
    robot_clock_offset_s: Offset = 0.0
    robot_clock_rate: Annotated[float, msgspec.Meta(ge=0.1, le=10.0)] = 1.0
    services_clock_offset_s: Offset = 0.0
    services_clock_rate: Annotated[float, msgspec.Meta(ge=0.1, le=10.0)] = 1.0

    @property
    def services(self) -> tuple[str, ...]:
        """The cloud's services in order of preference."""
        return tuple(f"cloud-{number}" for number in range(1, self.replicas + 1))

    @property
    def services_forget(self) -> bool:
        """Whether services forget a robot that was not heard, or where there are many."""
        return self.forgets_after_s < _LONG_S or self.sessions_kept < _MANY_SESSIONS


class Crash(_Item, frozen=True, kw_only=True, tag="crash", tag_field="item"):
    """The process of a service dies and, unless it is the local one, a new one is started."""

    service: Service
    at: Seconds
    found_after_s: Seconds = 0.002
    down_s: Seconds = 0.3
    keeps_memory: bool = False
    for_good: bool = False


class Stop(_Item, frozen=True, kw_only=True, tag="stop", tag_field="item"):
    """A process is stopped (SIGSTOP) and goes on later (SIGCONT)."""

    node: Node
    at: Seconds
    for_s: Seconds


class Slow(_Item, frozen=True, kw_only=True, tag="slow", tag_field="item"):
    """A service computes more slowly, by a factor, for a while."""

    service: Service
    at: Seconds
    for_s: Seconds
    factor: Annotated[float, msgspec.Meta(ge=1.0, le=2000.0)]


class OutOfMemory(_Item, frozen=True, kw_only=True, tag="out_of_memory", tag_field="item"):
    """A service has no memory for one part of an answer, for a while.

    No seed draws it, only written schedules have it: a long one ends a run.
    """

    service: Service
    at: Seconds
    for_s: Seconds
    part: Literal["task", "sensing"] = "sensing"


class Cut(_Item, frozen=True, kw_only=True, tag="cut", tag_field="item"):
    """Nothing gets through between the robot and a service, in one direction or both."""

    service: Service
    at: Seconds
    for_s: Seconds
    direction: Direction = "both"


class MessageFault(_Item, frozen=True, kw_only=True, tag="message", tag_field="item"):
    """What happens to one message."""

    service: Service
    direction: Literal["to", "from"]
    number: Count
    what: Literal["drop", "delay", "duplicate", "corrupt", "misroute"]
    seconds: Seconds = 0.0
    bit: Annotated[int, msgspec.Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        if self.what == "misroute" and self.direction == "to":
            raise ValueError("a misrouted message must be a reply (direction=from)")

    @property
    def kind(self) -> str:
        """What happens to it."""
        return f"message {self.what}"


class Crowd(_Item, frozen=True, kw_only=True, tag="crowd", tag_field="item"):
    """Other robots ask a service, all at once, each for the first sensing action of a trial."""

    service: Service
    at: Seconds
    robots: Annotated[int, msgspec.Meta(ge=1, le=1000)]


class KillRobot(_Item, frozen=True, kw_only=True, tag="kill_robot", tag_field="item"):
    """The robot's process dies, between two of its effects or at any moment, and is restarted."""

    boundary: Count = 0
    at: Seconds | None = None
    before: Literal["anything", "journal", "send", "sense", "act"] = "anything"
    down_s: Seconds = 0.2
    power_cut: bool = False
    lost_appends: Count = 0
    body_goes_on: bool = False


class PauseRobot(_Item, frozen=True, kw_only=True, tag="pause_robot", tag_field="item"):
    """The robot's process is asked to end in order (SIGINT), and is started again."""

    at: Seconds
    down_s: Seconds = 0.2


class DiskStall(_Item, frozen=True, kw_only=True, tag="disk_stall", tag_field="item"):
    """The next write to the journal takes long, and the robot's process with it."""

    at: Seconds
    for_s: Seconds


class LaunchFault(_Item, frozen=True, kw_only=True, tag="launch", tag_field="item"):
    """What becomes of one launch of the local service."""

    number: Annotated[int, msgspec.Meta(ge=1, le=1000)]
    what: Literal["late", "fails", "silent"]
    seconds: Seconds = 0.1


class Late(_Item, frozen=True, kw_only=True, tag="late", tag_field="item"):
    """The observation of a step comes so many task actions later; ``none`` for never.

    It comes with the move by which it is there, at the earliest with the next one; of a step that
    has several such lines several times. ``none`` is no reading, and is reported at once.
    """

    step: Count
    moves: Count | None


SimulatedFault: TypeAlias = (
    Crash
    | Stop
    | Slow
    | OutOfMemory
    | Cut
    | Crowd
    | MessageFault
    | KillRobot
    | PauseRobot
    | Late
    | DiskStall
    | LaunchFault
)

_ITEM: TypeAlias = RunSettings | SimulatedFault


class SimulationSchedule(msgspec.Struct, frozen=True):
    """A run and its faults."""

    run: RunSettings
    faults: tuple[SimulatedFault, ...] = ()

    def text(self) -> str:
        """Return it as lines of text; :func:`parse_schedule` reads them."""
        return "".join(f"{line_of(item)}\n" for item in (self.run, *self.faults))


# -- text ------------------------------------------------------------------------------------------

_WORDS = {"true": True, "false": False, "none": None}


def line_of(item: RunSettings | SimulatedFault) -> str:
    """Return an item as one line of a schedule."""
    words = [str(item.__struct_config__.tag)]
    for field in msgspec.structs.fields(type(item)):
        value = getattr(item, field.name)
        if field.required or value != field.default:
            words.append(f"{field.name}={_written(value)}")
    return " ".join(words)


def _written(value: object) -> str:
    if isinstance(value, bool) or value is None:
        return str(value).lower()
    return f"{value:.17g}" if isinstance(value, float) and value != round(value, 9) else str(value)


_NAMES = frozenset(str(kind.__struct_config__.tag) for kind in get_args(_ITEM))


def parse_item(line: str) -> RunSettings | SimulatedFault:
    """Read one line of a schedule.

    Raises ScheduleError if it is none; the message repeats it.
    """
    name, *words = line.split()
    if name not in _NAMES:
        raise ScheduleError(f"{line!r}: {name!r} is none of {', '.join(sorted(_NAMES))}")
    fields: dict[str, object] = {"item": name}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals or key in fields:
            raise ScheduleError(f"{line!r}: {word!r} is not one value of the form key=value")
        fields[key] = _WORDS.get(text, text)
    try:
        item: RunSettings | SimulatedFault = msgspec.convert(fields, _ITEM, strict=False)
    except msgspec.ValidationError as error:
        raise ScheduleError(f"{line!r}: {error}") from error
    return item


def parse_schedule(text: str) -> SimulationSchedule:
    """Read a schedule; empty lines and those that begin with ``#`` are left out.

    Raises ScheduleError if a line is no item of a schedule, or there is more than one ``run``.
    """
    lines = [line.strip() for line in text.splitlines()]
    items = [parse_item(line) for line in lines if line and not line.startswith("#")]
    runs = [item for item in items if isinstance(item, RunSettings)]
    if len(runs) > 1:
        raise ScheduleError(f"{len(runs)} lines begin with 'run': allowed is 1")
    faults = tuple(item for item in items if not isinstance(item, RunSettings))
    run = runs[0] if runs else RunSettings()
    named = {*run.services, LOCAL_SERVICE, "robot"}
    for fault in faults:
        node = getattr(fault, "service", getattr(fault, "node", "robot"))
        if node not in named:
            raise ScheduleError(
                f"{line_of(fault)!r}: there is no {node} in a run with {run.replicas} replicas"
            )
    return SimulationSchedule(run, faults)
