"""An attacker, written from classes of attacks, and an honest robot that must not notice it.

    python -m tests.fuzz.attacker --minutes 10 --transport tcp

A real ``holdfast serve --processes 2`` is attacked while a real robot without local recovery
decides. The report, as JSON, says whether the service's processes are the same as at the beginning,
whether each decision of the robot is that of its own planner, and how long it waited at most. Exit
code 0 if the service lives, says nothing of a defect and ends in order, no decision differs, and
the service was attacked in all ways; in a long run, nothing that a process holds may grow either.

With a certificate of its own (``tls``, ``udp``) the attacker is another robot of the same fleet.

Attacker, service and robot share this machine's cores. Where the kernel groups processes by session
(``kernel.sched_autogroup_enabled``, reported as ``grouped``), one that mostly sleeps, as the robot
does, is woken up to 0.2 s late beside others that never sleep. That is no wait for the service.
"""

import argparse
import asyncio
import collections
import contextlib
import csv
import itertools
import json
import random
import select
import signal
import socket
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import msgspec
from tests.fuzz import corpus, neighbours
from tests.fuzz.attack_messages import (
    checkpoints_in_obstacles,
    hostile_settings,
    odd_requests,
    spoilt_requests,
)
from tests.fuzz.honest_robots import HonestRobots
from tests.fuzz.measuring import Watch, flatness
from tests.ports import free_port
from tests.processes.faults import Service, Site
from tests.wire import CALL, PING, RawClient, RawLink, frame_of, hello_of

from holdfast.planning.settings import OffloadSettings
from holdfast.protocol.messages import encode
from holdfast.transport.credentials import load_credentials
from holdfast.transport.datagram_links import RobotDatagramLink
from holdfast.transport.robot_end import StreamRobotTransport

TRANSPORTS = ("tcp", "tls", "udp")
PROCESSES = 2

_OUTSTANDING = 32
_ROOM_S = 0.5
_CALLS_OF_A_LINK = 400
_LONG_S = 120.0
"""Shorter runs end before the service's tables are full, and so may grow all the time."""

_SIGNS_OF_A_DEFECT = ("Traceback", "panicked", "Warning")
_RESET = struct.pack("ii", 1, 0)
_GROUPING = Path("/proc/sys/kernel/sched_autogroup_enabled")


class Target(NamedTuple):
    """What is attacked, with which credentials, and until when."""

    endpoint: str
    keys: Path | None
    until: threading.Event
    counts: collections.Counter[str]

    @property
    def goes_on(self) -> bool:
        return not self.until.is_set()

    def link(self) -> RawClient:
        """Return a link that has said hello."""
        return RawClient(self.endpoint, self.keys)


Way: TypeAlias = Callable[[Target, random.Random], None]

# -- ways of attacking ---------------------------------------------------------------------------


def _conversation(name: str, draw: Callable[[random.Random], Iterator[bytes]]) -> Way:
    """Return what sends drawn calls over one link after the other, and reads what comes."""

    def attack(target: Target, chance: random.Random) -> None:
        numbers, payloads = itertools.count(1), draw(chance)
        while target.goes_on:
            with contextlib.suppress(OSError, AssertionError), target.link() as link:
                open_calls = 0
                for payload in itertools.islice(payloads, _CALLS_OF_A_LINK):
                    if target.until.is_set():
                        return
                    link.send(CALL, next(numbers) % 2**32, payload)
                    open_calls += 1
                    target.counts[name] += 1
                    while select.select([link.socket], [], [], 0)[0] or open_calls >= _OUTSTANDING:
                        try:
                            frame = link.receive(_ROOM_S)
                        except TimeoutError:
                            open_calls = 0  # what was asked is hard
                            break
                        if frame is None:
                            raise ConnectionError
                        open_calls -= frame.kind not in (PING,)

    return attack


def _cut_frames(target: Target, chance: random.Random) -> None:
    """Streams of valid frames that are cut, glued, doubled and interleaved."""
    requests = [encode(each) for each in corpus.requests(b"cuts its frames.")]
    while target.goes_on:
        with contextlib.suppress(OSError), RawLink(target.endpoint, target.keys) as link:
            calls = b"".join(
                frame_of(chance.choice((CALL, CALL, CALL, PING, 1, 3, 7, 8, 9, 255)), k, each)
                for k, each in enumerate(chance.sample(requests, 5))
            )
            stream = hello_of(incarnation="cut") * chance.choice((1, 1, 1, 2)) + calls
            for _ in range(chance.choice((0, 1, 3))):
                start = chance.randrange(len(stream) + 1)  # which may be cut to nothing
                part = stream[start : start + chance.choice((1, 4, 9, 100))]
                stream = chance.choice(
                    (
                        stream[:start] + stream[start + len(part) :],
                        stream[:start] + part + stream[start:],
                        stream[:start] + chance.randbytes(len(part)) + stream[start + len(part) :],
                        stream[:start],
                    )
                )
            while stream and target.goes_on:
                size = chance.choice((1, 8, 9, 10, 50, len(stream)))
                link.say(stream[:size])
                stream = stream[size:]
                if select.select([link.socket], [], [], 0)[0]:
                    link.receive(_ROOM_S)
            target.counts["cut streams"] += 1


def _abandoned(target: Target, chance: random.Random) -> None:
    """Sessions that are opened, asked something, and left at once, in order or not."""
    while target.goes_on:
        with contextlib.suppress(OSError, AssertionError), target.link() as link:
            for _ in range(chance.choice((1, 5, 20))):
                request = chance.choice(corpus.requests(chance.randbytes(16)))
                link.send(CALL, chance.randrange(2**32), encode(request))
                target.counts["sessions left"] += 1
            if chance.random() < 0.5:
                link.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)


def _as_neighbour(kind: str) -> Way:
    """Return what a bad neighbour does: clients that never read, scanners, browsers, slow bytes."""

    def attack(target: Target, _: random.Random) -> None:
        visit = neighbours.Visit(target.endpoint, target.keys, target.until)
        try:
            neighbours.KINDS[kind](visit)
        finally:
            target.counts[kind] += visit.done

    return attack


def _datagrams(target: Target, chance: random.Random) -> None:
    """Calls as datagrams, and sealed datagrams with anything in them, also never acknowledged."""
    asyncio.run(_send_datagrams(target, chance))


async def _send_datagrams(target: Target, chance: random.Random) -> None:
    assert target.keys is not None
    payloads = itertools.chain.from_iterable(
        zip(odd_requests(chance), hostile_settings(chance), strict=False)
    )
    calls = itertools.count(1)
    while target.goes_on:
        robot = StreamRobotTransport(
            {"cloud": target.endpoint},
            incarnation=chance.randbytes(4).hex(),
            tls=load_credentials(target.keys, "robot").files,
        )
        robot.start(lambda _: None)
        for _ in range(200):
            await asyncio.sleep(0.01)
            if not target.goes_on or robot.sends_datagrams("cloud"):
                break
        link = robot._services["cloud"].current
        for number in range(1, 600):
            if not target.goes_on or not isinstance(link, RobotDatagramLink) or link.ended:
                break
            if chance.random() < 0.5:
                robot.call("cloud", next(calls), next(payloads))
                target.counts["datagram calls"] += 1
            else:
                link._send_datagram(_exchange_message(chance, number))
                target.counts["sealed datagrams"] += 1
            await asyncio.sleep(0.002)
        await robot.close(0.1)


def _exchange_message(chance: random.Random, number: int) -> bytes:
    """Return a message of an exchange of any kind and content.

    Most are requests of a robot that says that it has got no answer yet.
    """
    kind = chance.choice((1, 1, 1, 6, 2, 3, 4, 5, 0, 7, 255))
    content = chance.choice(corpus.requests(chance.randbytes(16)))
    head = struct.pack(
        ">IIH", chance.choice((number, 2**32 - 1, 0)), 1, chance.choice((0, 2**16 - 1))
    )
    body = chance.choice((encode(content)[:1000], chance.randbytes(chance.choice((0, 1, 8, 500)))))
    return bytes((kind, chance.randrange(256))) + head[: chance.choice((10, 10, 10, 5))] + body


def _flood(target: Target, chance: random.Random) -> None:
    """Datagrams that nobody has sealed."""
    host, _, port = target.endpoint.partition("/")[2].rpartition(":")
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.connect((host, int(port)))
        while target.goes_on:
            for _ in range(50):
                with contextlib.suppress(OSError):
                    sender.send(chance.randbytes(chance.choice((0, 3, 40, 1200))))
                target.counts["foreign datagrams"] += 1
            time.sleep(0.02)


WAYS: dict[str, Way] = {
    "odd": _conversation("odd values", odd_requests),
    "settings": _conversation("hostile settings", hostile_settings),
    "checkpoints": _conversation("checkpoints in obstacles", checkpoints_in_obstacles),
    "messages": _conversation("messages", spoilt_requests),
    "cut": _cut_frames,
    "abandoned": _abandoned,
    **{kind: _as_neighbour(kind) for kind in ("deaf", "slow", "scanner", "greetings")},
    "datagrams": _datagrams,
    "flood": _flood,
}

_OVER_UDP = frozenset({"datagrams", "flood"})


def _ways_over(transport: str) -> list[str]:
    return [way for way in WAYS if transport == "udp" or way not in _OVER_UDP]


def _known_ways(text: str) -> list[str]:
    """Return the ways that an option names."""
    ways = text.split(",")
    for way in ways:
        if way not in WAYS:
            raise argparse.ArgumentTypeError(f"{way!r} is none of {','.join(WAYS)}")
    return ways


def _attack(endpoint: str, keys: Path | None, seconds: float, seed: int, ways: list[str]) -> None:
    """Attack in all ways at once, and say how often in each, as a line of JSON."""
    until = threading.Event()
    over = _ways_over(endpoint.partition("/")[0])
    counts: dict[str, collections.Counter[str]] = {
        way: collections.Counter() for way in ways if way in over
    }

    def go_on(way: str) -> None:
        target = Target(endpoint, keys, until, counts[way])
        chance = random.Random(f"{seed} {way}")
        while target.goes_on:
            # A service that is too busy for another link is no reason to give up.
            with contextlib.suppress(OSError, AssertionError):
                WAYS[way](target, chance)

    with ThreadPoolExecutor(len(WAYS)) as pool:
        attacks = [pool.submit(go_on, way) for way in counts]
        until.wait(seconds)
        until.set()
    print(json.dumps(counts), flush=True)
    for attack in attacks:
        attack.result()  # raises what ended it


# -- the attacked --------------------------------------------------------------------------------


def _children_of(pid: int) -> list[int]:
    folder = Path(f"/proc/{pid}/task")
    return sorted(
        int(child) for task in folder.iterdir() for child in (task / "children").read_text().split()
    )


def _credentials(site: Site) -> tuple[Path, Path, Path]:
    """Return the credentials of the service, the honest robot and the attacker, of one fleet."""
    directory = site.directory / "keys"
    for options in ((), ("--robot", "mallory")):
        made = site.holdfast("keys", directory, *options)
        assert made.process.returncode == 0, made.account()
    return directory / "service", directory / "robot", directory / "mallory"


def _longest_wait_ms(robots: HonestRobots) -> tuple[float, float]:
    """Return the longest wait for any decision but each run's first ones, and for those.

    A run's first decisions include its links, and its problem is built at the service.
    """
    first, later = [0.0], [0.0]
    for _, out in robots.runs:
        with (out / "timings.csv").open() as file:
            for index, row in enumerate(csv.DictReader(file)):
                (first if index < 2 else later).append(float(row["waited_ms"]))
    return max(later), max(first)


def attacked(
    transport: str, seconds: float, seed: int, directory: Path, ways: list[str] | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Attack a service for so long; return the report, and what must not have happened."""
    findings: list[str] = []
    ways = ways or _ways_over(transport)
    with Site(directory) as site:
        options: tuple[str, ...] = ()
        robot_options: tuple[str, ...] = ()
        mallory: tuple[str, ...] = ()
        if transport != "tcp":
            own, honest, other = map(str, _credentials(site))
            options, robot_options, mallory = ("--tls", own), ("--tls", honest), ("--tls", other)
        service: Service = site.service(
            *("--processes", str(PROCESSES), *options),
            endpoint=f"{transport}/127.0.0.1:{free_port()}",
            lease_ms=OffloadSettings().lease_ms,
        ).start()
        before = _children_of(service.process.pid)
        robots = HonestRobots(
            site, service, seed, 6, problems=("peg_in_hole_2d",), options=robot_options
        )
        attacker = site.process(
            sys.executable,
            *("-X", "faulthandler"),  # its threads plan, decode and encode at once
            *("-m", "tests.fuzz.attacker", "--attack", service.endpoint, *mallory),
            *("--minutes", str(seconds / 60.0), "--seed", str(seed)),
            *("--ways", ",".join(ways)),
            variables={"PYTHONPATH": str(Path(__file__).parents[2])},
        )
        watches = [Watch(pid) for pid in before]
        deadline = time.monotonic() + seconds + 60.0
        while attacker.process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.2)
        if attacker.process.poll() is None:
            findings.append("the attacker does not come to its end")
            attacker.kill()
        elif attacker.wait() != 0:
            findings.append(f"the attacker fails: {attacker.account()[-3000:]}")
        robots.finish()
        held = [watch.stop() for watch in watches]
        if seconds >= _LONG_S:
            findings += [fault for samples in held for fault in flatness(samples)[1]]
        lives = service.process.process.poll() is None
        after = _children_of(service.process.pid) if lives else []
        if not lives or after != before:
            findings.append(
                f"processes {before} became {after}: {service.process.account()[-3000:]}"
            )
        events = collections.Counter(event.name for event in service.process.events)
        if any(word in service.process.output for word in _SIGNS_OF_A_DEFECT):
            findings.append(f"the service says: {service.process.output[-3000:]}")
        if lives:
            service.process.signal(signal.SIGTERM)
            if service.process.wait() != 0:
                findings.append(f"the service ends badly: {service.process.account()[-2000:]}")
        defects = service.process.matching("defect")
        findings += [f"a defect: {dict(each.fields)}" for each in defects[:5]]
        compared = robots.compare()
        findings += robots.failures
        later_ms, first_ms = _longest_wait_ms(robots)
        most_bytes = max((each.memory_bytes for samples in held for each in samples), default=0)
        sent = [line for line in attacker.output.splitlines() if line.startswith("{")]
        attacks = json.loads(sent[-1]) if sent else {}
        findings += [f"no attack: {way}" for way in ways if not any(attacks.get(way, {}).values())]
        report = {
            "transport": transport,
            "seconds": seconds,
            "grouped": _GROUPING.read_text().strip() == "1" if _GROUPING.exists() else None,
            "service_lives": lives and after == before,
            "processes": before,
            "decides_identically": not robots.failures,
            "longest_wait_ms": later_ms,
            "longest_first_wait_ms": first_ms,
            "most_memory_mb": round(most_bytes / 2**20, 1),
            "robot": compared,
            "robot_tells": robots.told(),
            "attacks": attacks,
            "service_events": dict(events),
        }
    return report, findings


def main(arguments: list[str] | None = None) -> int:
    """Attack, and print the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--transport", choices=TRANSPORTS, default="tcp")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--ways", type=_known_ways, help=f"of {','.join(WAYS)}; all of the transport unless given"
    )
    parser.add_argument("--attack", metavar="ENDPOINT", help="a service that is there already")
    parser.add_argument("--tls", type=Path, help="credentials of the attacker, with --attack")
    options = parser.parse_args(arguments)
    seconds = 60.0 * options.minutes
    if options.attack:
        _attack(options.attack, options.tls, seconds, options.seed, options.ways or list(WAYS))
        return 0
    with tempfile.TemporaryDirectory(prefix="holdfast-attacker-") as directory:
        report, findings = attacked(
            options.transport, seconds, options.seed, Path(directory), options.ways
        )
    print(msgspec.json.format(msgspec.json.encode(report), indent=2).decode())
    for finding in findings:
        print(f"FOUND: {finding}")
    return min(1, len(findings))


if __name__ == "__main__":
    sys.exit(main())
