"""Sessions come and go for a long time, and nothing grows.

    python -m tests.fuzz.soak --minutes 10 --seed 1

Two services, one that may remember eight robots and one that may remember a thousand, have visitors
without end (the attacker's sessions that are left at once, in order or in the midst of a call).
Beside them one robot runs all the time, and its two services are killed and started again. What the
processes hold is measured from outside; when it counts as flat is said in ``measuring.py``.
"""

import argparse
import json
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from tests.fuzz.honest_robots import compared
from tests.fuzz.measuring import Watch, flatness
from tests.processes.faults import Service, Site, document_of, events_of

_SMALL, _BIG = "8", "1000"
_LIVES_S = (1.5, 6.0)
"""How long a service of the long-lived robot lives."""


class _ComeAndGo:
    """Kills services and starts them again, one at a time."""

    def __init__(self, services: list[Service], seed: int) -> None:
        self._services = services
        self._chance = random.Random(seed)
        self._stopped = threading.Event()
        self.kills = 0
        self.failures: list[str] = []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stopped.wait(self._chance.uniform(*_LIVES_S)):
                service = self._chance.choice(self._services)
                service.kill()
                self.kills += 1
                self._stopped.wait(self._chance.choice((0.0, 0.2, 1.0)))
                service.start()
        except AssertionError as error:
            self.failures.append(str(error)[-2000:])


def run_soak(
    seconds: float, seed: int, *, directory: Path, tell: Callable[[str], None] = lambda _: None
) -> tuple[dict[str, Any], list[str]]:
    """Let sessions come and go for so long; return the figures, and what was found."""
    findings: list[str] = []
    with Site(directory) as site:
        visited = {
            "small": site.service("--max-sessions", _SMALL).start(),
            "big": site.service("--max-sessions", _BIG).start(),
        }
        own = [site.service(lease_ms=400.0).start() for _ in range(2)]
        document = document_of("peg_in_hole_2d", trials=1_000_000, max_steps=40, seed=seed)
        file = site.configure(document, "long-lived")
        robot = site.run(file, "--rate", "100", services=own, out="long-lived-out")
        robot.wait_for("trial")
        watches = {name: Watch(service.process.pid) for name, service in visited.items()}
        watches["robot"] = Watch(robot.pid)
        visitors = [
            site.process(
                sys.executable,
                *("-m", "tests.fuzz.attacker", "--attack", service.endpoint, "--ways", "abandoned"),
                *("--minutes", str(seconds / 60.0), "--seed", str(seed + index)),
                variables={"PYTHONPATH": str(Path(__file__).parents[2])},
            )
            for index, service in enumerate(visited.values())
        ]
        coming = _ComeAndGo(own, seed)
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            time.sleep(min(15.0, left))
            memory = {
                name: round(watch.samples[-1].memory_bytes / 2**20, 1)
                for name, watch in watches.items()
                if watch.samples
            }
            tell(f"{left:.0f} s to go, MB held: {memory}")
        samples = {name: watch.stop() for name, watch in watches.items()}
        coming.stop()
        findings += coming.failures
        reports = []
        for visitor in visitors:
            if visitor.wait() != 0:
                findings.append(f"a visitor fails: {visitor.account()[-2000:]}")
            reports += [json.loads(line) for line in visitor.output.splitlines() if line[:1] == "{"]
        robot.signal(signal.SIGTERM)
        code = robot.wait()
        if code not in (-signal.SIGTERM, 128 + signal.SIGTERM):
            findings.append(f"the robot ends with {code}: {robot.account()[-2000:]}")
        trials, others = compared(file, robot.out, 200)
        findings += others
        for name, service in visited.items():
            said = service.process.output
            if service.process.process.poll() is not None or "Traceback" in said:
                findings.append(f"{name}: {service.process.account()[-2000:]}")
        figures: dict[str, Any] = {"visitors": reports}
        for name, held in samples.items():
            figures[name], faults = flatness(held)
            findings += [f"{name}: {fault}" for fault in faults]
        events = events_of(robot.out)
        figures |= {
            "long_lived_robot": {
                "trials": sum(event["event"] == "trial" for event in events),
                "trials_compared": trials,
                "services_killed": coming.kills,
                "recoveries": sum(
                    event["event"] == "status" and event["to"] == "local_recovery"
                    for event in events
                ),
            }
        }
    return figures, findings


def main() -> int:
    """Run it, and print the figures as JSON and what was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()

    def tell(text: str) -> None:
        print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory(prefix="holdfast-soak-") as directory:
        figures, findings = run_soak(
            60.0 * options.minutes, options.seed, directory=Path(directory), tell=tell
        )
    print(msgspec.json.format(msgspec.json.encode(figures), indent=2).decode())
    for finding in findings:
        print(f"FOUND: {finding}")
    print("nothing was found" if not findings else f"{len(findings)} findings")
    return min(1, len(findings))


if __name__ == "__main__":
    sys.exit(main())
