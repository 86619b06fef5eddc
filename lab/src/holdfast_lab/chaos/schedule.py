"""The faults of a trial, drawn from the seed and the number of the trial.

The same seed, trial, kind and wire give the same schedule on every machine. The time of a fault is
in steps of the robot, so it is the same on a slow machine; its duration is in seconds, like the
robot's timeouts.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias, get_args

import msgspec

from holdfast_lab.testbed.bad_line import Direction
from holdfast_lab.testbed.faults import NEEDS_NAMESPACE, NEEDS_PROXY, Fault, FaultKind

Wire: TypeAlias = Literal["tcp", "tls", "unix", "udp"]
"""The transport between robot and services."""

WIRES: tuple[Wire, ...] = get_args(Wire)
"""All of them, in the order in which trials use them."""

Launch: TypeAlias = Literal["on_failure", "at_start", "never"]
"""When the robot launches its local service."""


class Schedule(msgspec.Struct, frozen=True, kw_only=True):
    """One trial: a robot, its services, and their faults."""

    seed: int
    trial: int
    kind: FaultKind
    wire: Wire
    world_seed: int  # of the robot's run
    num_particles: int
    num_clouds: int
    launch: Launch
    decision_deadline_ms: float | None  # after which the robot asks its local service as well
    what: Literal["sensing", "all"]
    faults: tuple[Fault, ...]  # in order of time

    @property
    def needs_namespace(self) -> bool:
        """Whether it needs a network namespace."""
        return any(fault.kind in NEEDS_NAMESPACE for fault in self.faults)

    @property
    def needs_proxy(self) -> bool:
        """Whether the robot reaches its services over proxies."""
        return any(fault.kind in NEEDS_PROXY for fault in self.faults)


class _Times(NamedTuple):
    """Between which fractions of the run faults of a kind come, and how long they last."""

    at: tuple[tuple[float, float], ...]
    duration_s: tuple[float, float]


_TWO = (0.06, 0.16), (0.46, 0.56)
_TWICE = _Times(_TWO, (0.3, 0.55))
_TWICE_FOR_LONG = _Times(_TWO, (0.5, 0.8))
_ONCE = _Times(((0.08, 0.3),), (0.4, 0.8))
"""For lines that need a while to be used again."""

_TIMES = {
    FaultKind.CLOUD_KILLED: _TWICE,
    # Some of them are shorter than the robot's timeout.
    FaultKind.CLOUD_STOPPED: _Times(_TWO, (0.1, 0.7)),
    FaultKind.LOCAL_KILLED: _Times(((0.06, 0.2),), (0.9, 1.2)),
    FaultKind.ROBOT_KILLED: _Times(((0.05, 0.3), (0.4, 0.6), (0.7, 0.9)), (0.0, 0.1)),
    FaultKind.ROBOT_STOPPED: _Times(_TWO, (0.1, 0.8)),
    FaultKind.REPLICAS_KILLED: _Times(((0.06, 0.12), (0.15, 0.4), (0.55, 0.65)), (0.3, 0.55)),
    FaultKind.LINK_DELAYED: _TWICE_FOR_LONG,
    FaultKind.LINK_LOSSY: _TWICE_FOR_LONG,
    FaultKind.LINK_SILENT: _ONCE,
    FaultKind.LINK_SILENT_ONE_WAY: _ONCE,
    FaultKind.LINK_CUT: _TWICE,
    FaultKind.PACKETS_LOST: _TWICE_FOR_LONG,
    FaultKind.PACKETS_DROPPED: _ONCE,
    FaultKind.PACKETS_DROPPED_ONE_WAY: _ONCE,
}

_NOT_COMBINED = (FaultKind.COMBINATION, FaultKind.REPLICAS_KILLED)
_COMBINED = _Times(((0.05, 0.75),), (0.05, 0.8))
_FEWEST_COMBINED, _MOST_COMBINED = 2, 5


def kinds_over(wire: Wire, kinds: Sequence[FaultKind]) -> tuple[FaultKind, ...]:
    """Return the kinds that a wire can have: a local socket has no packets."""
    return tuple(kind for kind in kinds if wire != "unix" or kind not in NEEDS_NAMESPACE)


def draw_schedule(
    seed: int, trial: int, kind: FaultKind, wire: Wire, combinable: Sequence[FaultKind]
) -> Schedule:
    """Draw the faults of a trial; a combination is of kinds that this machine can inject."""
    chance = random.Random(f"holdfast chaos {seed} {trial} {kind.value}")
    faults: list[Fault] = []
    if kind is FaultKind.COMBINATION:
        # A proxy is in the machine's own network, which a namespace cannot reach.
        others = chance.choice((NEEDS_NAMESPACE, NEEDS_PROXY))
        singles = [
            each for each in kinds_over(wire, combinable) if each not in {*_NOT_COMBINED, *others}
        ]
        for _ in range(chance.randint(_FEWEST_COMBINED, _MOST_COMBINED)):
            single = chance.choice(singles)
            at = chance.uniform(*_COMBINED.at[0])
            faults.append(_fault(chance, single, at, _COMBINED.duration_s, chance.randrange(2)))
        num_clouds = chance.choice((1, 1, 2))
    else:
        times = _TIMES[kind]
        num_clouds = 2 if kind is FaultKind.REPLICAS_KILLED else 1
        for index, between in enumerate(times.at):
            at = chance.uniform(*between)
            faults.append(_fault(chance, kind, at, times.duration_s, index % num_clouds))
    launches: list[Launch] = [
        "on_failure",
        "on_failure",
        "on_failure",
        "at_start",
        "at_start",
        "never",
    ]
    if any(fault.kind is FaultKind.LOCAL_KILLED for fault in faults):
        launches.remove("never")
    launch = chance.choice(launches)
    # Without a local service there is no other to ask.
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
        what=chance.choice(("sensing", "all")),
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
