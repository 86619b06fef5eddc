"""A client whose requests cost as much as they can, beside a robot that measures how long it waits.

    python -m tests.fuzz.costly ENDPOINT --seconds 60

It tries every numeric setting at its maximum, with every method, and random ones below; it hangs
up, or asks for the next thing without waiting for an answer. What an honest robot waits is printed
as JSON.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import itertools
import json
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from tests.fuzz.hostile_settings import hostile_settings, random_settings
from tests.unit.test_protocol_service import Robot, content
from tests.wire import RawClient

from holdfast.config.registry import BUILT_IN
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.errors import HoldfastError
from holdfast.planning.settings import PlanningSettings
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    PROTOCOL_VERSION,
    Request,
    SessionConfiguration,
    decode_reply,
    encode,
)

__all__ = ["Outcome", "attack", "costly_requests"]

_CODE = core_version(), problem_digest(object)
_CLIENTS = 4
_HELD_S = 0.3
_STEPS = 60
ROOT = Path(__file__).parents[2]


class Outcome(NamedTuple):
    """What came of an attack.

    Attributes
    ----------
    longest_s, median_s : float
        Waits of the honest robot for the whole of an answer.
    turns : int
        Answers that it got, each of them the right one.
    counts : dict
        Costly requests that were sent, and replies by their kind.
    """

    longest_s: float
    median_s: float
    turns: int
    counts: dict[str, int]


def costly_requests(seed: int) -> Iterator[bytes]:
    """Yield requests without end, each of a session of its own."""
    chance = random.Random(seed)
    fixed = list(hostile_settings())
    chance.shuffle(fixed)
    for number in itertools.count():
        planning: PlanningSettings
        if number % 2 and fixed:
            planning = fixed.pop().settings
        else:
            planning = random_settings(chance)
        yield encode(_request(chance, planning))


def _request(chance: random.Random, planning: PlanningSettings) -> Request:
    problem = chance.choice(tuple(BUILT_IN))
    robot = None
    if planning.particle_filter.num_particles <= 30_000:
        with contextlib.suppress(HoldfastError):
            robot = Robot(problem, planning)
    if robot is not None:
        return robot.request(session=chance.randbytes(16))
    configuration = SessionConfiguration(problem, {}, {}, planning, 5, *_CODE)
    return Request(
        version=PROTOCOL_VERSION,
        session=chance.randbytes(16),
        epoch=1,
        number=1,
        trial=0,
        step=0,
        sensed=False,
        digest=bytes(DIGEST_SIZE),
        session_configuration=configuration,
    )


def harm(endpoint: str, seconds: float, seed: int, keys: Path | None) -> dict[str, int]:
    """Send costly requests on several links for a time; return how many, and refusals by code."""
    until = time.monotonic() + seconds
    counts: collections.Counter[str] = collections.Counter()
    with ThreadPoolExecutor(_CLIENTS) as pool:
        for done in [
            pool.submit(_harm, endpoint, until, seed + number, keys) for number in range(_CLIENTS)
        ]:
            counts += done.result()
    return dict(counts)


def _harm(endpoint: str, until: float, seed: int, keys: Path | None) -> collections.Counter[str]:
    chance, requests = random.Random(seed), costly_requests(seed)
    counts: collections.Counter[str] = collections.Counter()
    while time.monotonic() < until:
        # A new link each time: its calls end with it, answered or not.
        with RawClient(endpoint, keys) as client:
            for _ in range(chance.randint(1, 6)):
                call = client.send_call(next(requests))
                counts["sent"] += 1
                with contextlib.suppress(TimeoutError):
                    frame = client.receive(_HELD_S * chance.random())
                    while frame is not None and frame.call != call:
                        frame = client.receive(_HELD_S * chance.random())
                    if frame is not None and frame.payload:
                        counts[type(decode_reply(frame.payload)).__name__] += 1
    return counts


def attack(endpoint: str, seconds: float, seed: int = 1, keys: Path | None = None) -> Outcome:
    """Have another process send costly requests for a time; ask for a robot's decisions here."""
    command = [sys.executable, "-m", "tests.fuzz.costly", endpoint, "--harm"]
    command += ["--seconds", str(seconds), "--seed", str(seed)]
    command += [] if keys is None else ["--keys", str(keys)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as other:
        waits: list[float] = []
        robot = Robot("peg_in_hole_2d", PlanningSettings(), key=12345)
        trial = 0
        with RawClient(endpoint, keys) as honest:
            while other.poll() is None:
                expected = robot.right_answer()
                request = encode(robot.request())
                began = time.monotonic()
                replies = honest.ask(request)
                waits.append(time.monotonic() - began)
                answer = content(replies)
                assert answer == expected, (answer, expected)
                robot.act_until_sensing()
                robot.sense()
                if robot.state.step > _STEPS:
                    trial += 1
                    robot.begin(trial)
        assert other.returncode == 0, other.returncode
        assert other.stdout is not None
        counts = json.loads(other.stdout.read())
    waits.sort()
    return Outcome(waits[-1], waits[len(waits) // 2], len(waits), counts)


def main() -> None:
    """Attack a service, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keys", type=Path)
    parser.add_argument("--harm", action="store_true", help="Only send costly requests.")
    options = parser.parse_args()
    if options.harm:
        print(json.dumps(harm(options.endpoint, options.seconds, options.seed, options.keys)))
        return
    outcome = attack(options.endpoint, options.seconds, options.seed, options.keys)
    print(json.dumps(outcome._asdict()))


if __name__ == "__main__":
    main()
