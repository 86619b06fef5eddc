"""Schedules drawn by seed: which faults a run has, how many, and when."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import TypeVar

import msgspec

from holdfast_lab.simulation.schedule import (
    LOCAL_SERVICE,
    NUM_TRIALS,
    Crash,
    Crowd,
    Cut,
    Direction,
    DiskStall,
    KillRobot,
    Late,
    LaunchFault,
    MessageFault,
    PauseRobot,
    RunSettings,
    SimulatedFault,
    SimulationSchedule,
    Slow,
    Stop,
)

_SPAN_S = 0.7
"""Faults begin within this time: a run without any takes about half a second."""

_MESSAGES = 60
"""Messages of each service and direction that may be struck; a run without faults has fewer."""

_SHOW_OTHERWISE = 0.2
"""Share of the runs in which observations come late, moves show something, or sensing may be left
out."""

_FEW_TRIALS = 4
_PATTERNS = 16
"""Patterns of lateness. Each trial has one run without faults for each: few, so that they are
remembered."""

_SENSING_STEPS = range(0, 40, 9)

_T = TypeVar("_T")


def draw_schedule(seed: int) -> SimulationSchedule:
    """Draw a run and its faults.

    Each seed allows some kinds of faults only, so that what one kind hides another does not, and
    some seeds have many faults of few kinds (swarm testing; Groce et al., ISSTA 2012).
    """
    schedule = _Draw(seed).schedule()
    # Generators of their own: what the first one draws is as it was without them.
    what = random.Random(f"holdfast simulation {seed}: what is asked").choice(("sensing", "all"))
    run = msgspec.structs.replace(schedule.run, what=what)
    apart = random.Random(f"holdfast simulation {seed}: what is shown, and when")
    if apart.random() >= _SHOW_OTHERWISE:
        return SimulationSchedule(run, schedule.faults)
    run = msgspec.structs.replace(
        run,
        trial=apart.randrange(_FEW_TRIALS),
        moves_show=apart.random() < 0.3,
        sensing_is_optional=apart.random() < 0.2,
        remembers=apart.random() < 0.5,
        senses_on=apart.random() < 0.5,
        on_lost="reinitialise" if apart.random() < 0.3 else "continue",
    )
    late: tuple[Late, ...] = ()
    if not (run.moves_show or run.sensing_is_optional) or apart.random() < 0.7:
        late = _lateness(apart.randrange(_PATTERNS))
    return SimulationSchedule(run, (*late, *schedule.faults))


def _lateness(pattern: int) -> tuple[Late, ...]:
    """Return when observations come."""
    chance = random.Random(f"holdfast lateness {pattern}")
    late = []
    for step in _SENSING_STEPS:
        if chance.random() < 0.2:
            continue
        for _ in range(2 if chance.random() < 0.15 else 1):
            moves = chance.choice((None, 0, 1, 2, 3, 5, 8, 9, 10, 12, 18, 20, 30))
            late.append(Late(step=step, moves=moves))
    return tuple(late)


class _Draw:
    """One draw; see :func:`draw_schedule`."""

    def __init__(self, seed: int) -> None:
        # Another generator than the planning's: the world must not be of one mind with the robot.
        self._chance = random.Random(f"holdfast simulation {seed}")
        self._run = self._draw_run()
        self._services = [*self._run.services, LOCAL_SERVICE]

    def schedule(self) -> SimulationSchedule:
        kinds: list[Callable[[], Iterable[SimulatedFault]]] = [
            self._crash,
            self._crash,
            self._stop,
            self._slow,
            self._cut,
            self._kill,
            self._kill,
            self._pause,
            self._stall,
            self._launch,
            self._crowd,
        ]
        allowed = [kind for kind in kinds if self._sometimes(0.5)]
        faults: list[SimulatedFault] = []
        if allowed:
            for _ in range(self._any(1, 2, 3, 5, 8)):
                faults += self._any(*allowed)()
        share = self._any(0.0, 0.0, 0.02, 0.1, 0.3)
        if any(isinstance(fault, Crash) and fault.for_good for fault in faults):
            # The robot has nobody but the local service now, and is patient with that: what goes
            # from one process to another of the same machine is not lost again and again.
            self._services.remove(LOCAL_SERVICE)
        faults += self._messages(share)
        return SimulationSchedule(self._run, tuple(faults))

    def _any(self, *choices: _T) -> _T:
        return self._chance.choice(choices)

    def _between(self, low: float, high: float) -> float:
        return round(self._chance.uniform(low, high), 6)

    def _sometimes(self, share: float) -> bool:
        return self._chance.random() < share

    def _at(self) -> float:
        return self._between(0.0, _SPAN_S)

    def _draw_run(self) -> RunSettings:
        any_of, between, sometimes = self._any, self._between, self._sometimes
        skewed = sometimes(0.3)
        return RunSettings(
            trial=self._chance.randrange(NUM_TRIALS),
            num_trials=2 if sometimes(0.15) else 1,
            replicas=any_of(1, 1, 2, 2, 3),
            launch=any_of("on_failure", "on_failure", "on_failure", "at_start", "never"),
            deadline_ms=any_of(None, None, 5.0, 15.0),
            rate_hz=any_of(None, None, 100.0),
            act_s=any_of(0.0, 0.005, 0.01, 0.01, 0.02, 0.1),
            latency_s=any_of(0.0002, 0.001, 0.001, 0.01, 0.04),
            jitter_s=any_of(0.0, 0.0, 0.005),
            sensing_s=any_of(0.003, 0.003, 0.03),
            launch_s=any_of(0.02, 0.15, 0.15, 0.6),
            workers=any_of(1, 2),
            sessions_kept=any_of(2, 100),
            answers_kept=any_of(1, 8, 8),
            certificates=sometimes(0.5),
            forgets_after_s=any_of(600.0, 600.0, 600.0, 0.03),
            environment=any_of("counting", "counting", "simulated", "not_counting"),
            journal_survives=any_of("process_crash", "process_crash", "power_cut"),
            lease_s=any_of(0.4, 0.4, 0.1),
            bytes_per_s=any_of(None, None, None, None, 1e5),
            lost_in_cut=sometimes(0.5),
            robot_clock_offset_s=between(0.0, 1e6) if skewed else 0.0,
            robot_clock_rate=any_of(0.97, 1.0, 1.03) if skewed else 1.0,
            services_clock_offset_s=between(0.0, 1e6) if skewed else 0.0,
            services_clock_rate=any_of(0.97, 1.0, 1.03) if skewed else 1.0,
        )

    def _crash(self) -> Iterable[SimulatedFault]:
        crash = Crash(
            service=self._any(*self._services),
            at=self._at(),
            found_after_s=self._any(0.0, 0.002, 0.002, 0.05, 10.0),
            down_s=self._any(0.005, 0.05, 0.3, 0.3, 1.0),
            keeps_memory=self._sometimes(0.25),
        )
        if self._run.launch == "never" or self._sometimes(0.8):
            return [crash]
        # The robot is left alone with what it has aboard.
        gone = msgspec.structs.replace(crash, for_good=True, keeps_memory=False, down_s=0.0)
        return [msgspec.structs.replace(gone, service=name) for name in self._run.services]

    def _stop(self) -> Iterable[SimulatedFault]:
        node = "robot" if self._sometimes(0.3) else self._any(*self._services)
        return [Stop(node=node, at=self._at(), for_s=self._any(0.01, 0.1, 0.3, 0.8))]

    def _slow(self) -> Iterable[SimulatedFault]:
        service, at = self._any(*self._services), self._at()
        for_s, factor = self._between(0.05, 0.6), self._any(3.0, 20.0, 100.0)
        return [Slow(service=service, at=at, for_s=for_s, factor=factor)]

    def _cut(self) -> Iterable[SimulatedFault]:
        direction: Direction = self._any("both", "both", "to", "from")
        at, for_s = self._at(), self._any(0.02, 0.1, 0.3, 0.3, 1.0)
        # All of the cloud at once, as when the robot's own link fails, or a part of it.
        struck = self._run.services if self._sometimes(0.5) else (self._any(*self._services),)
        return [Cut(service=each, at=at, for_s=for_s, direction=direction) for each in struck]

    def _crowd(self) -> Iterable[SimulatedFault]:
        service, robots = self._any(*self._run.services), self._any(1, 5, 20, 60)
        return [Crowd(service=service, at=self._at(), robots=robots)]

    def _kill(self) -> Iterable[SimulatedFault]:
        power_cut = self._sometimes(0.3)
        at = self._at() if self._sometimes(0.3) else None
        yield KillRobot(
            boundary=0 if at is not None else self._chance.randrange(150),
            at=at,
            down_s=self._any(0.001, 0.05, 0.2, 0.6),
            power_cut=power_cut,
            lost_appends=self._any(0, 1, 2, 5, 100) if power_cut else 0,
            body_goes_on=self._sometimes(0.5),
            before=self._any("anything", "anything", "journal", "send", "sense", "act"),
        )
        if self._sometimes(0.3):
            # What the process has asked may arrive when the next one lives.
            for service in self._run.services:
                yield MessageFault(
                    service=service,
                    direction="to",
                    number=self._chance.randrange(8),
                    what="delay",
                    seconds=self._any(0.1, 0.3, 0.6),
                )

    def _pause(self) -> Iterable[SimulatedFault]:
        return [PauseRobot(at=self._at(), down_s=self._any(0.001, 0.2))]

    def _stall(self) -> Iterable[SimulatedFault]:
        return [DiskStall(at=self._at(), for_s=self._any(0.004, 0.03, 0.3))]

    def _launch(self) -> Iterable[SimulatedFault]:
        return [
            LaunchFault(
                number=self._any(1, 1, 2, 3),
                what=self._any("late", "fails", "silent"),
                seconds=self._any(0.0, 0.01, 0.3, 2.0),
            )
        ]

    def _messages(self, share: float) -> Iterable[SimulatedFault]:
        every = ("drop", "delay", "duplicate", "corrupt", "misroute")
        kinds = [kind for kind in every if self._sometimes(0.6)]
        if not share or not kinds:
            return
        for service in self._services:
            for direction in ("to", "from"):
                count = self._chance.randint(0, round(2 * share * _MESSAGES))
                for number in sorted(self._chance.sample(range(_MESSAGES), count)):
                    what = self._any(*kinds)
                    if what == "misroute" and direction == "to":
                        what = "delay"
                    late = what in ("delay", "duplicate", "misroute")
                    yield MessageFault(
                        service=service,
                        direction=direction,
                        number=number,
                        what=what,  # type: ignore[arg-type]
                        seconds=self._any(0.0, 0.002, 0.02, 0.3) if late else 0.0,
                        bit=self._chance.randrange(1 << 16) if what == "corrupt" else 0,
                    )
