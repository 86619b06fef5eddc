"""What happens to a run, drawn from the seed and the number of the trial.

A schedule is data: which faults, when, how hard, for how long, and what robot they strike. The same
seed, trial, kind and wire give the same schedule on every machine. When a fault strikes is said in
steps of the robot and not in seconds, so that it strikes a run on a slow machine at the same place;
how long it lasts is said in seconds, because that is what the timeouts of the robot are.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from enum import StrEnum
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from holdfast.chaos.proxy import Direction

__all__ = [
    "DESCRIPTIONS",
    "NEEDS_NAMESPACE",
    "NEEDS_PROXY",
    "WIRES",
    "Fault",
    "FaultKind",
    "Schedule",
    "Wire",
    "draw_schedule",
    "kinds_over",
]


Wire: TypeAlias = Literal["tcp", "tls", "unix", "udp"]
"""Over which robots reach their services."""

WIRES: tuple[Wire, ...] = ("tcp", "tls", "unix", "udp")
"""Of a series."""


class FaultKind(StrEnum):
    """Kinds of fault, and of trials."""

    CLOUD_KILLED = "cloud_killed"
    CLOUD_STOPPED = "cloud_stopped"
    LOCAL_KILLED = "local_killed"
    ROBOT_KILLED = "robot_killed"
    ROBOT_STOPPED = "robot_stopped"
    REPLICAS_KILLED = "replicas_killed"
    LINK_DELAYED = "link_delayed"
    LINK_LOSSY = "link_lossy"
    LINK_SILENT = "link_silent"
    LINK_SILENT_ONE_WAY = "link_silent_one_way"
    LINK_CUT = "link_cut"
    PACKETS_LOST = "packets_lost"
    PACKETS_DROPPED = "packets_dropped"
    PACKETS_DROPPED_ONE_WAY = "packets_dropped_one_way"
    COMBINATION = "combination"


DESCRIPTIONS = {
    FaultKind.CLOUD_KILLED: "the cloud service is killed (SIGKILL) and started again",
    FaultKind.CLOUD_STOPPED: "the cloud service stands still (SIGSTOP, SIGCONT)",
    FaultKind.LOCAL_KILLED: "the local service is killed while the cloud is away",
    FaultKind.ROBOT_KILLED: "the robot's process is killed and resumed",
    FaultKind.ROBOT_STOPPED: "the robot's process stands still",
    FaultKind.REPLICAS_KILLED: "of two cloud services, one after the other is killed",
    FaultKind.LINK_DELAYED: "a proxy adds latency and jitter",
    FaultKind.LINK_LOSSY: "a proxy delivers late, as lost packets are",
    FaultKind.LINK_SILENT: "a proxy lets nothing through, and breaks no connection",
    FaultKind.LINK_SILENT_ONE_WAY: "a proxy lets nothing through in one direction",
    FaultKind.LINK_CUT: "a proxy resets all connections and refuses new ones",
    FaultKind.PACKETS_LOST: "nftables drops some packets, at random",
    FaultKind.PACKETS_DROPPED: "nftables drops all packets",
    FaultKind.PACKETS_DROPPED_ONE_WAY: "nftables drops all packets in one direction",
    FaultKind.COMBINATION: "several of these at once",
}

NEEDS_NAMESPACE = frozenset(
    {FaultKind.PACKETS_LOST, FaultKind.PACKETS_DROPPED, FaultKind.PACKETS_DROPPED_ONE_WAY}
)
"""Kinds that need nftables and a network of the trial's own."""

NEEDS_PROXY = frozenset(
    {
        FaultKind.LINK_DELAYED,
        FaultKind.LINK_LOSSY,
        FaultKind.LINK_SILENT,
        FaultKind.LINK_SILENT_ONE_WAY,
        FaultKind.LINK_CUT,
    }
)


class Fault(msgspec.Struct, frozen=True, kw_only=True):
    """One fault.

    Attributes
    ----------
    kind : FaultKind
    at : float
        When, as a fraction of the run's steps.
    duration_s : float
        How long until what was killed is started again, what was stopped goes on, or the line is
        healed.
    cloud : int
        Which cloud service, or whose line.
    direction : {"both", "to_service", "to_robot"}
    latency_ms, jitter_ms : float
    loss : float
        Share of packets, or of the pieces that a proxy carries.
    """

    kind: FaultKind
    at: float
    duration_s: float
    cloud: int = 0
    direction: Direction = "both"
    latency_ms: float = 0.0
    jitter_ms: float = 0.0
    loss: float = 0.0


class Schedule(msgspec.Struct, frozen=True, kw_only=True):
    """One trial: a robot, its services, and what happens to them.

    Attributes
    ----------
    seed, trial : int
    kind : FaultKind
    wire : {"tcp", "tls", "unix", "udp"}
    world_seed : int
        Of the robot's run.
    num_particles : int
    num_clouds : int
    launch : {"on_failure", "at_start", "never"}
        When the robot launches its local service.
    decision_deadline_ms : float or None
        After which it asks that one as well.
    faults : tuple of Fault
        In order of time.
    """

    seed: int
    trial: int
    kind: FaultKind
    wire: Wire
    world_seed: int
    num_particles: int
    num_clouds: int
    launch: Literal["on_failure", "at_start", "never"]
    decision_deadline_ms: float | None
    faults: tuple[Fault, ...]

    @property
    def needs_namespace(self) -> bool:
        """Whether it needs a network of its own."""
        return any(fault.kind in NEEDS_NAMESPACE for fault in self.faults)

    @property
    def needs_proxy(self) -> bool:
        """Whether the robot reaches its services over proxies."""
        return any(fault.kind in NEEDS_PROXY for fault in self.faults)


class _Times(NamedTuple):
    """When faults of a kind strike, at the earliest and at the latest, and how long they last."""

    strikes: tuple[tuple[float, float], ...]
    duration_s: tuple[float, float]


_EARLY, _LATE = (0.06, 0.16), (0.46, 0.56)

_TWICE = _Times((_EARLY, _LATE), (0.3, 0.55))
_ONCE = _Times(((0.08, 0.3),), (0.4, 0.8))
"""For lines that need a while to be used again."""

_TIMES = {
    FaultKind.CLOUD_KILLED: _TWICE,
    # Some of them are shorter than the robot's timeout.
    FaultKind.CLOUD_STOPPED: _Times((_EARLY, _LATE), (0.1, 0.7)),
    FaultKind.LOCAL_KILLED: _Times(((0.06, 0.2),), (0.9, 1.2)),
    FaultKind.ROBOT_KILLED: _Times(((0.05, 0.3), (0.4, 0.6), (0.7, 0.9)), (0.0, 0.1)),
    FaultKind.ROBOT_STOPPED: _Times((_EARLY, _LATE), (0.1, 0.8)),
    FaultKind.REPLICAS_KILLED: _Times(((0.06, 0.12), (0.15, 0.4), (0.55, 0.65)), (0.3, 0.55)),
    FaultKind.LINK_DELAYED: _Times((_EARLY, _LATE), (0.5, 0.8)),
    FaultKind.LINK_LOSSY: _Times((_EARLY, _LATE), (0.5, 0.8)),
    FaultKind.LINK_SILENT: _ONCE,
    FaultKind.LINK_SILENT_ONE_WAY: _ONCE,
    FaultKind.LINK_CUT: _TWICE,
    FaultKind.PACKETS_LOST: _Times((_EARLY, _LATE), (0.5, 0.8)),
    FaultKind.PACKETS_DROPPED: _ONCE,
    FaultKind.PACKETS_DROPPED_ONE_WAY: _ONCE,
}

_NOT_COMBINED = (FaultKind.COMBINATION, FaultKind.REPLICAS_KILLED)
_COMBINED_STRIKES = (0.05, 0.75)
_COMBINED_DURATION_S = (0.05, 0.8)
_MOST_COMBINED = 5
_FEWEST_COMBINED = 2


def kinds_over(wire: Wire, kinds: Sequence[FaultKind]) -> tuple[FaultKind, ...]:
    """Return those kinds of trial that there are over a wire: a local socket has no packets."""
    return tuple(kind for kind in kinds if wire != "unix" or kind not in NEEDS_NAMESPACE)


def draw_schedule(
    seed: int, trial: int, kind: FaultKind, wire: Wire, combinable: Sequence[FaultKind]
) -> Schedule:
    """Draw what happens in a trial.

    Parameters
    ----------
    seed, trial : int
    kind : FaultKind
    wire : {"tcp", "tls", "unix", "udp"}
    combinable : sequence of FaultKind
        All kinds that can be done on this machine: what a combination is made of.

    Returns
    -------
    Schedule
    """
    chance = random.Random(f"holdfast chaos {seed} {trial} {kind.value}")
    faults: list[Fault] = []
    if kind is FaultKind.COMBINATION:
        # A proxy stands in the machine's own network, and a namespace has no way there.
        others = chance.choice((NEEDS_NAMESPACE, NEEDS_PROXY))
        singles = [
            each for each in kinds_over(wire, combinable) if each not in {*_NOT_COMBINED, *others}
        ]
        for _ in range(chance.randint(_FEWEST_COMBINED, _MOST_COMBINED)):
            single = chance.choice(singles)
            at, duration_s = chance.uniform(*_COMBINED_STRIKES), _COMBINED_DURATION_S
            faults.append(_fault(chance, single, at, duration_s, chance.randrange(2)))
        num_clouds = chance.choice((1, 1, 2))
    else:
        times = _TIMES[kind]
        num_clouds = 2 if kind is FaultKind.REPLICAS_KILLED else 1
        for index, between in enumerate(times.strikes):
            at = chance.uniform(*between)
            faults.append(_fault(chance, kind, at, times.duration_s, index % num_clouds))
    launches: list[Literal["on_failure", "at_start", "never"]]
    launches = ["on_failure", "on_failure", "on_failure", "at_start", "at_start", "never"]
    if any(fault.kind is FaultKind.LOCAL_KILLED for fault in faults):
        launches.remove("never")
    launch = chance.choice(launches)
    # Where there is no local service, there is nobody else to be asked.
    deadlines = (None, None, None, None if launch == "never" else 50.0)
    return Schedule(
        seed=seed,
        trial=trial,
        kind=kind,
        wire=wire,
        world_seed=chance.getrandbits(31),
        num_particles=chance.randint(30, 100),
        num_clouds=num_clouds,
        launch=launch,
        decision_deadline_ms=chance.choice(deadlines),
        faults=tuple(
            msgspec.structs.replace(fault, cloud=fault.cloud % num_clouds)
            for fault in sorted(faults, key=lambda fault: fault.at)
        ),
    )


def _fault(
    chance: random.Random, kind: FaultKind, at: float, duration_s: tuple[float, float], cloud: int
) -> Fault:
    direction: Direction = "both"
    if kind in (FaultKind.LINK_SILENT_ONE_WAY, FaultKind.PACKETS_DROPPED_ONE_WAY):
        direction = chance.choice(("to_service", "to_robot"))
    latency_ms = jitter_ms = loss = 0.0
    if kind is FaultKind.LINK_DELAYED:
        latency_ms, jitter_ms = chance.uniform(5.0, 150.0), chance.uniform(0.0, 100.0)
    elif kind in (FaultKind.LINK_LOSSY, FaultKind.PACKETS_LOST):
        loss = chance.uniform(0.05, 0.4)
    return Fault(
        kind=kind,
        at=round(at, 4),
        duration_s=round(chance.uniform(*duration_s), 3),
        cloud=cloud,
        direction=direction,
        latency_ms=round(latency_ms, 1),
        jitter_ms=round(jitter_ms, 1),
        loss=round(loss, 3),
    )
