"""Schedules drawn by seed: which faults a run has, how many, and when."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import ClassVar, TypeVar

import msgspec

from holdfast.lab.simulation.schedule import (
    LOCAL_SERVICE,
    NUM_TRIALS,
    Crash,
    Crowd,
    Cut,
    Direction,
    DiskStall,
    KillRobot,
    LaunchFault,
    MessageFault,
    PauseRobot,
    RunSettings,
    SimulatedFault,
    SimulationSchedule,
    Slow,
    Stop,
)

__all__ = ["draw_schedule"]

_T = TypeVar("_T")


def draw_schedule(seed: int) -> SimulationSchedule:
    """Draw a run and its faults.

    Each seed allows some kinds of faults only, so that what one kind hides another does not, and
    some seeds have many faults of few kinds (swarm testing; Groce et al., ISSTA 2012).
    """
    return _Draw(seed).schedule()


class _Draw:
    """One draw; see :func:`draw_schedule`."""

    _SPAN_S: ClassVar[float] = 0.7
    """Faults begin within this time: a run without any takes about half a second."""

    def __init__(self, seed: int) -> None:
        # Another generator than the planning's: the world must not be of one mind with the robot.
        self._chance = random.Random(f"holdfast simulation {seed}")
        # Each by a name of its own, so that the other draws of a seed are what they were before.
        self._losses, self._bodies, self._aims, self._certificates = (
            random.Random(f"holdfast simulation {seed}: {name}")
            for name in ("losses", "bodies", "aims", "certificates")
        )

    def schedule(self) -> SimulationSchedule:
        run = self._run()
        chance = self._chance
        services = [*run.services, LOCAL_SERVICE]
        kinds: list[Callable[[RunSettings, list[str]], Iterable[SimulatedFault]]] = [
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
        allowed = [kind for kind in kinds if chance.random() < 0.5]
        faults: list[SimulatedFault] = []
        if allowed:
            for _ in range(self._any((1, 2, 3, 5, 8))):
                faults += self._any(allowed)(run, services)
        share = self._any((0.0, 0.0, 0.02, 0.1, 0.3))
        if any(isinstance(fault, Crash) and fault.for_good for fault in faults):
            # The robot has nobody but the local service now, and is patient with that: what goes
            # from one process to another of the same machine is not lost again and again.
            services.remove(LOCAL_SERVICE)
        faults += self._messages(services, share)
        return SimulationSchedule(run, tuple(faults))

    def _any(self, choices: Iterable[_T]) -> _T:
        return self._chance.choice(tuple(choices))

    def _between(self, low: float, high: float) -> float:
        return round(self._chance.uniform(low, high), 6)

    def _sometimes(self, share: float) -> bool:
        return self._chance.random() < share

    def _run(self) -> RunSettings:
        any_of, between, sometimes = self._any, self._between, self._sometimes
        skewed = sometimes(0.3)
        return RunSettings(
            trial=self._chance.randrange(NUM_TRIALS),
            num_trials=2 if sometimes(0.15) else 1,
            replicas=any_of((1, 1, 2, 2, 3)),
            launch=any_of(("on_failure", "on_failure", "on_failure", "at_start", "never")),
            deadline_ms=any_of((None, None, 5.0, 15.0)),
            rate_hz=any_of((None, None, 100.0)),
            act_s=any_of((0.0, 0.005, 0.01, 0.01, 0.02, 0.1)),
            latency_s=any_of((0.0002, 0.001, 0.001, 0.01, 0.04)),
            jitter_s=any_of((0.0, 0.0, 0.005)),
            sensing_s=any_of((0.003, 0.003, 0.03)),
            launch_s=any_of((0.02, 0.15, 0.15, 0.6)),
            workers=any_of((1, 2)),
            sessions_kept=any_of((2, 100)),
            answers_kept=any_of((1, 8, 8)),
            certificates=self._certificates.random() < 0.5,
            forgets_after_s=any_of((600.0, 600.0, 600.0, 0.03)),
            environment=any_of(("counting", "counting", "simulated", "not_counting")),
            journal_survives=any_of(("process_crash", "process_crash", "power_cut")),
            lease_s=any_of((0.4, 0.4, 0.1)),
            bytes_per_s=any_of((None, None, None, None, 1e5)),
            lost_in_cut=sometimes(0.5),
            robot_clock_offset_s=between(0.0, 1e6) if skewed else 0.0,
            robot_clock_rate=any_of((0.97, 1.0, 1.03)) if skewed else 1.0,
            services_clock_offset_s=between(0.0, 1e6) if skewed else 0.0,
            services_clock_rate=any_of((0.97, 1.0, 1.03)) if skewed else 1.0,
        )

    def _at(self) -> float:
        return self._between(0.0, self._SPAN_S)

    def _crash(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        crash = Crash(
            service=self._any(services),
            at=self._at(),
            found_after_s=self._any((0.0, 0.002, 0.002, 0.05, 10.0)),
            down_s=self._any((0.005, 0.05, 0.3, 0.3, 1.0)),
            keeps_memory=self._sometimes(0.25),
        )
        if run.launch == "never" or self._losses.random() < 0.8:
            yield crash
            return
        # The robot is left alone with what it has aboard.
        for service in run.services:
            yield msgspec.structs.replace(
                crash, service=service, for_good=True, keeps_memory=False, down_s=0.0
            )

    def _stop(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        del run
        node = "robot" if self._sometimes(0.3) else self._any(services)
        yield Stop(node=node, at=self._at(), for_s=self._any((0.01, 0.1, 0.3, 0.8)))

    def _slow(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        del run
        yield Slow(
            service=self._any(services),
            at=self._at(),
            for_s=self._between(0.05, 0.6),
            factor=self._any((3.0, 20.0, 100.0)),
        )

    def _cut(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        direction: Direction = self._any(("both", "both", "to", "from"))
        at, for_s = self._at(), self._any((0.02, 0.1, 0.3, 0.3, 1.0))
        # All of the cloud at once, as when the robot's own link fails, or a part of it.
        together = self._sometimes(0.5)
        for service in run.services if together else (self._any(services),):
            yield Cut(service=service, at=at, for_s=for_s, direction=direction)

    def _crowd(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        del services
        robots = self._any((1, 5, 20, 60))
        yield Crowd(service=self._any(run.services), at=self._at(), robots=robots)

    def _kill(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        del services
        power_cut = self._sometimes(0.3)
        at = self._at() if self._sometimes(0.3) else None
        yield KillRobot(
            boundary=0 if at is not None else self._chance.randrange(150),
            at=at,
            down_s=self._any((0.001, 0.05, 0.2, 0.6)),
            power_cut=power_cut,
            lost_appends=self._any((0, 1, 2, 5, 100)) if power_cut else 0,
            body_goes_on=self._bodies.random() < 0.5,
            before=self._aims.choice(("anything", "anything", "journal", "send", "sense", "act")),
        )
        if self._aims.random() < 0.3:
            # What the process has asked may arrive when the next one lives.
            for service in run.services:
                yield MessageFault(
                    service=service,
                    direction="to",
                    number=self._aims.randrange(8),
                    what="delay",
                    seconds=self._aims.choice((0.1, 0.3, 0.6)),
                )

    def _pause(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        del run, services
        yield PauseRobot(at=self._at(), down_s=self._any((0.001, 0.2)))

    def _stall(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        del run, services
        yield DiskStall(at=self._at(), for_s=self._any((0.004, 0.03, 0.3)))

    def _launch(self, run: RunSettings, services: list[str]) -> Iterable[SimulatedFault]:
        del run, services
        yield LaunchFault(
            number=self._any((1, 1, 2, 3)),
            what=self._any(("late", "fails", "silent")),
            seconds=self._any((0.0, 0.01, 0.3, 2.0)),
        )

    def _messages(self, services: list[str], share: float) -> Iterable[SimulatedFault]:
        if not share:
            return
        kinds = [
            kind
            for kind in ("drop", "delay", "duplicate", "corrupt", "misroute")
            if self._chance.random() < 0.6
        ]
        if not kinds:
            return
        among = 60
        for service in services:
            for direction in ("to", "from"):
                count = self._chance.randint(0, round(2 * share * among))
                for number in sorted(self._chance.sample(range(among), count)):
                    what = self._any(kinds)
                    if what == "misroute" and direction == "to":
                        what = "delay"
                    late = what in ("delay", "duplicate", "misroute")
                    yield MessageFault(
                        service=service,
                        direction=direction,
                        number=number,
                        what=what,  # type: ignore[arg-type]
                        seconds=self._any((0.0, 0.002, 0.02, 0.3)) if late else 0.0,
                        bit=self._chance.randrange(1 << 16) if what == "corrupt" else 0,
                    )
