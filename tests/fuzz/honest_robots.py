"""Robots that use a service under attack; each decision is compared with the planner's own."""

import collections
import threading
from collections.abc import Sequence
from pathlib import Path

from tests.processes.faults import PROBLEMS, Robot, Service, Site, document_of, events_of

from holdfast.config.loader import load
from holdfast.journal.journal import Journal
from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial

_RATE_HZ = 50.0

_DISTURBANCES = (
    "busy",
    "service_suspected",
    "service_vanished",
    "restore",
    "retry",
    "waiting",
    "holding",
    "malformed_reply",
    "disagreement",
    "refused",
)
"""What a robot tells when its service is not there for it; each costs time and nothing else."""


class HonestRobots:
    """Robots that use the service all the time, one run after another, each with its own seed."""

    def __init__(
        self,
        site: Site,
        service: Service,
        seed: int,
        trials: int,
        max_steps: int = 60,
        problems: Sequence[str] = PROBLEMS,
        options: Sequence[str] = (),
    ) -> None:
        self._site = site
        self._service = service
        self._problems = problems
        self._options = options
        self._stopped = threading.Event()
        self.failures: list[str] = []
        self.runs: list[tuple[Path, Path]] = []
        self._threads = [
            threading.Thread(target=self._series, args=(index, seed, trials, max_steps))
            for index in range(len(problems))
        ]
        for thread in self._threads:
            thread.start()

    def finish(self) -> None:
        """Let the runs that have begun come to their ends, and begin no more."""
        self._stopped.set()
        for thread in self._threads:
            thread.join()

    def _series(self, index: int, seed: int, trials: int, max_steps: int) -> None:
        count = 0
        while not self._stopped.is_set() and not self.failures:
            name = f"robot-{seed}-{index}-{count}"
            document = document_of(
                self._problems[index],
                trials=trials,
                max_steps=max_steps,
                seed=1000 * seed + 100 * index + count,
            )
            file = self._site.configure(document, name, recovery={"launch": "never"})
            robot: Robot = self._site.run(
                file,
                *("--rate", str(_RATE_HZ), *self._options),
                services=[self._service],
                out=f"{name}-out",
            )
            code = robot.wait()
            if code != 0:
                self.failures.append(f"{name}: {robot.account()[-3000:]}")
            self.runs.append((file, robot.out))
            count += 1

    def compare(self) -> dict[str, int]:
        """Compare every decision with that of the planner by itself."""
        trials = 0
        for file, out in self.runs:
            count, others = compared(file, out)
            trials += count
            self.failures += others
        return {"runs": len(self.runs), "trials": trials}

    def told(self) -> dict[str, int]:
        """Count what the robots tell of the service's not being there for them."""
        counted: collections.Counter[str] = collections.Counter()
        for _, out in self.runs:
            for event in events_of(out):
                if event["event"] in _DISTURBANCES:
                    counted[event["event"]] += 1
        return dict(counted)


def compared(file: Path, out: Path, most: int | None = None) -> tuple[int, list[str]]:
    """Compare the (last) trials of a run with the planner by itself; return how many, and which."""
    configuration = load(file)
    planner = Planner(configuration.problem, configuration.planning)
    others = []
    with Journal.read(out / "journal.bin") as journal:
        results = list(journal.results())[-(most or 0) :]
    for result in results:
        expected = run_trial(
            planner,
            configuration.simulator.seed,
            result.trial,
            max_steps=configuration.simulator.max_steps,
        )
        if (result.digest, result.reward) != (expected.digest, expected.reward):
            others.append(f"{out.name}, trial {result.trial}: other decisions")
    return len(results), others
