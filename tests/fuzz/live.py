"""A service under fire: hostile clients, bytes that are no frames, and honest robots among them.

    python -m tests.fuzz.live --messages 1000000 --seed 1

Real processes on this machine's own address: `holdfast serve`, robots (`holdfast run`), and the
hostile clients. At the end every decision of every robot is compared with the planner's own, and
what the service held is compared over time. Exit code 0 if nothing was found.
"""

from __future__ import annotations

import argparse
import collections
import csv
import json
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
from tests.fuzz.measuring import Watch, flatness
from tests.fuzz.raw_connections import RawConnections
from tests.processes.faults import PROBLEMS, Process, Robot, Service, Site, document_of, events_of

from holdfast.config.loader import load
from holdfast.planning.planner import Planner
from holdfast.planning.settings import OffloadSettings
from holdfast.recording.journal import Journal
from holdfast.robot.trial import run_trial

__all__ = ["HonestRobots", "main", "run_live"]

_RATE_HZ = 50.0
_CALM_S = 6.0
"""For so long the robots are alone with the service, for comparison."""

_DEAF_SHARE = 0.01
_DEAF_S = 1.5
_PAUSE_S = 1.0
_BETWEEN_PAUSES_S = 8.0

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
    """Robots that use the service all the time, one run after another, each with its own seed.

    Parameters
    ----------
    trials : int
        Of each run.
    problems : sequence of str
        For each a robot.
    options : sequence of str
        Further ones of ``holdfast run``.
    """

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

    def compare(self) -> dict[str, Any]:
        """Compare every decision with that of the planner by itself."""
        trials = decisions = 0
        for file, out in self.runs:
            configuration = load(file)
            with Journal.read(out / "journal.sqlite") as journal:
                for result in journal.results(with_decisions=True):
                    expected = run_trial(
                        Planner(configuration.problem, configuration.planning),
                        configuration.simulator.seed,
                        result.trial,
                        max_steps=configuration.simulator.max_steps,
                    )
                    trials += 1
                    decisions += result.steps + result.sensing_decisions
                    alike = (result.digest, result.reward, result.steps, result.success) == (
                        expected.digest,
                        expected.reward,
                        expected.steps,
                        expected.success,
                    )
                    if not alike:
                        self.failures.append(f"{out.name}, trial {result.trial}: other decisions")
        return {"runs": len(self.runs), "trials": trials, "decisions": decisions}

    def waits_ms(self, since: float, until: float) -> list[float]:
        """Return how long robots waited for each decision of the runs begun within that time."""
        found = []
        for _, out in self.runs:
            if since <= (out / "config.yaml").stat().st_mtime <= until:
                with (out / "timings.csv").open() as file:
                    found += [float(row["waited_ms"]) for row in csv.DictReader(file)]
        return found

    def told(self) -> dict[str, int]:
        """Count what the robots tell of the service's not being there for them."""
        counted: collections.Counter[str] = collections.Counter()
        for _, out in self.runs:
            for event in events_of(out):
                if event["event"] in _DISTURBANCES:
                    counted[event["event"]] += 1
        return dict(counted)


def _quantiles(values: Sequence[float]) -> dict[str, float]:
    if len(values) < 2:
        return {}
    cut = statistics.quantiles(values, n=1000, method="inclusive")
    return {
        "median": round(cut[499], 2),
        "p99": round(cut[989], 2),
        "p99.9": round(cut[998], 2),
        "most": round(max(values), 2),
    }


class _Attack:
    """Hostile clients, one of which does not always read, and one that is stopped now and then."""

    def __init__(
        self, site: Site, service: Service, messages: int, seed: int, clients: int
    ) -> None:
        deaf = max(500, int(messages * _DEAF_SHARE))
        shares = [messages // clients] * clients
        shares[0] += messages - sum(shares)
        self.clients = [
            self._client(site, service, share, seed * 100 + index)
            for index, share in enumerate(shares)
        ]
        # What it sends is not counted on: it may not come to an end.
        self.deaf = self._client(
            site, service, deaf, seed * 100 + 99, "--deaf", str(_DEAF_S), "--outstanding", "200"
        )
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._pause, daemon=True)
        self._thread.start()

    @staticmethod
    def _client(site: Site, service: Service, messages: int, seed: int, *options: str) -> Process:
        return site.process(
            sys.executable,
            *("-m", "tests.fuzz.hostile_client", service.endpoint),
            *("--messages", str(messages), "--seed", str(seed), *options),
            variables={"PYTHONPATH": str(Path(__file__).parents[2])},
        )

    def _pause(self) -> None:
        """Stop the deaf one altogether, now and then: its link stays, and nobody is behind it."""
        while not self._stopped.wait(_BETWEEN_PAUSES_S):
            if self.deaf.process.poll() is None:
                self.deaf.signal(signal.SIGSTOP)
                self._stopped.wait(_PAUSE_S)
                self.deaf.signal(signal.SIGCONT)

    def wait(self, limit_s: float, tell: Callable[[str], None]) -> list[dict[str, Any]]:
        """Return the clients' reports once all have sent what they had to."""
        deadline = time.monotonic() + limit_s
        everyone = [*self.clients, self.deaf]
        told_at = time.monotonic()
        while any(each.process.poll() is None for each in self.clients):
            if time.monotonic() > deadline:
                break
            time.sleep(0.2)
            if time.monotonic() > told_at + 15.0:
                told_at = time.monotonic()
                tell(f"sent {sum(self._sent(each) for each in everyone)}")
        # The deaf one has done its part when the others have.
        grace = time.monotonic() + 20.0
        while self.deaf.process.poll() is None and time.monotonic() < grace:
            time.sleep(0.2)
        self._stopped.set()
        self._thread.join()
        reports = []
        for each in everyone:
            if each.process.poll() is None:
                each.process.kill()
            each.wait()
            reports.append(self._report(each))
        return reports

    @staticmethod
    def _lines(client: Process) -> list[dict[str, Any]]:
        return [json.loads(line) for line in client.output.splitlines() if line.startswith('{"se')]

    def _sent(self, client: Process) -> int:
        lines = self._lines(client)
        return int(lines[-1]["sent"]) if lines else 0

    def _report(self, client: Process) -> dict[str, Any]:
        lines = self._lines(client)
        if not lines or "kinds" not in lines[-1]:
            return {
                "sent": self._sent(client),
                "unfinished": True,
                "error": client.output[-1500:] if client.process.returncode not in (0, -9) else "",
            }
        return lines[-1]


def run_live(
    messages: int,
    seed: int,
    *,
    directory: Path,
    clients: int = 2,
    trials: int = 6,
    limit_s: float = 1800.0,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[dict[str, Any], list[str]]:
    """Let robots be honest and others not; return the figures, and what was found.

    Parameters
    ----------
    messages : int
        That the hostile clients send, besides the one that does not read.
    seed : int
        Of what they send, and of the robots.
    clients : int
        Hostile ones, beside the one that does not read.
    trials : int
        Of each robot's run.
    limit_s : float
        After which the clients are ended.
    tell : callable
        Is told how far it is.
    """
    findings: list[str] = []
    with Site(directory) as site:
        service = site.service(lease_ms=OffloadSettings().lease_ms).start()
        pid = service.process.pid
        watch = Watch(pid)
        calm_from = time.time()
        calm = HonestRobots(site, service, seed + 500, trials=2)
        time.sleep(_CALM_S)
        calm.finish()
        calm_until = time.time()
        tell(f"the service alone with its robots: {calm.told()}")
        robots = HonestRobots(site, service, seed, trials)
        began = time.monotonic()
        raw = RawConnections(int(service.endpoint.rpartition(":")[2]), seed)
        attacked_from = time.time()
        # What is held from here on is compared; before, the service had nothing to do.
        watch.stop()
        watch = Watch(pid)
        attack = _Attack(site, service, messages, seed, clients)
        reports = attack.wait(limit_s, tell)
        seconds = time.monotonic() - began
        samples = watch.stop()
        raw.stop()
        robots.finish()
        attacked_until = time.time()
        time.sleep(1.0)
        alive = service.process.process.poll() is None
        if not alive:
            findings.append(f"the service has ended: {service.process.account()[-3000:]}")
        said = service.process.output
        if any(word in said for word in ("Traceback", "defect", "panicked", "Warning")):
            findings.append(f"the service says: {said[-3000:]}")
        if alive:
            service.process.signal(signal.SIGTERM)
            if service.process.wait() != 0:
                findings.append(f"the service ends badly: {service.process.account()[-2000:]}")
        tell("comparing decisions")
        compared = robots.compare()
        compared_calm = calm.compare()
        findings += robots.failures + calm.failures
        held, faults = flatness(samples)
        findings += faults
        sent = sum(report["sent"] for report in reports)
        if sent < messages:
            findings.append(f"only {sent} of {messages} messages were sent")
        findings += [str(each["error"]) for each in reports if each.get("error")]
        replies: collections.Counter[str] = collections.Counter()
        kinds: collections.Counter[str] = collections.Counter()
        for report in reports:
            replies.update(report.get("replies", {}))
            kinds.update(report.get("kinds", {}))
        if replies["MALFORMED REPLY"]:
            findings.append(f"{replies['MALFORMED REPLY']} replies do not decode")
        figures = {
            "messages_sent_live": sent,
            "seconds": round(seconds, 1),
            "messages_per_second": round(sent / seconds),
            "kinds": dict(kinds.most_common()),
            "replies": dict(replies.most_common()),
            "links_of_clients": sum(report.get("links", 0) for report in reports),
            "raw_connections": {
                "made": raw.made,
                "half_open": raw.held,
                "bytes": raw.bytes_sent,
            },
            "service": held,
            "service_events": dict(
                collections.Counter(event["event"] for event in service.process.events)
            ),
            "robots": compared,
            "robots_calm": compared_calm,
            "robots_tell": robots.told(),
            "robots_tell_calm": calm.told(),
            "waited_ms": _quantiles(robots.waits_ms(attacked_from - 1.0, attacked_until)),
            "waited_ms_calm": _quantiles(calm.waits_ms(calm_from - 1.0, calm_until + 1.0)),
        }
    return figures, findings


def main() -> int:
    """Run it, and print the figures as JSON and what was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--messages", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--clients", type=int, default=2)
    parser.add_argument("--limit", type=float, default=1800.0, metavar="SECONDS")
    options = parser.parse_args()

    def tell(text: str) -> None:
        print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory(prefix="holdfast-fuzz-") as directory:
        figures, findings = run_live(
            options.messages,
            options.seed,
            directory=Path(directory),
            clients=options.clients,
            limit_s=options.limit,
            tell=tell,
        )
    print(msgspec.json.format(msgspec.json.encode(figures), indent=2).decode())
    for finding in findings:
        print(f"FOUND: {finding}")
    print("nothing was found" if not findings else f"{len(findings)} findings")
    return min(1, len(findings))


if __name__ == "__main__":
    sys.exit(main())
