"""Robots that come, ask a few times, and are never heard of again.

    python -m tests.fuzz.visitors ENDPOINT --seconds 60 --seed 1

Each has a session of its own, asks what an honest robot asks, checks what it is told, and goes:
sometimes in the middle of a call, sometimes with its link. It reports as one line of JSON.
"""

from __future__ import annotations

import argparse
import collections
import json
import random
import sys
import time
from typing import Any

from tests.fuzz import corpus
from tests.questions import request_of
from tests.unit.test_protocol_service import Robot as ReferenceRobot
from tests.unit.test_protocol_service import content
from tests.wire import RawClient

from holdfast.planning.planner import encode_checkpoint
from holdfast.protocol.messages import NeedState, encode

_ROBOTS_OF_A_LINK = 40
_PROBLEMS = (corpus.PROBLEM, "peg_in_hole_2d")


def _right_answers() -> dict[str, list[list[tuple[Any, ...]]]]:
    """Return, of each problem, what is the answer in each turn."""
    found: dict[str, list[list[tuple[Any, ...]]]] = {}
    for name in _PROBLEMS:
        robot = ReferenceRobot(name, corpus.PLANNING, seed=corpus.SEED)
        found[name] = []
        for turn in corpus.turns(name):
            robot.state = turn.state
            found[name].append(robot.right_answer())
    return found


def main() -> None:
    """Come and go for so long."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("endpoint")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pause", type=float, default=0.004, help="between two robots")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    right = _right_answers()
    counts: collections.Counter[str] = collections.Counter()
    wrong: list[str] = []
    until = time.monotonic() + options.seconds
    link = RawClient(options.endpoint)
    while time.monotonic() < until and not wrong:
        if counts["robots"] % _ROBOTS_OF_A_LINK == _ROBOTS_OF_A_LINK - 1:
            link.close()
            link = RawClient(options.endpoint)
            counts["links"] += 1
        counts["robots"] += 1
        time.sleep(options.pause * 2 * chance.random())
        name = chance.choice(_PROBLEMS)
        session = chance.randbytes(16)
        session_configuration = corpus.session_configuration_of(name)
        last = chance.randint(1, len(corpus.turns(name)))
        leaves = chance.random() < 0.3
        for number, turn in enumerate(corpus.turns(name)[:last]):
            state = turn.state
            restored = number > 0 and chance.random() < 0.1
            request = request_of(
                state,
                session,
                number + 1,
                inputs=() if restored else turn.observed,
                session_configuration=session_configuration,
                checkpoint=encode_checkpoint(state) if restored else None,
            )
            if leaves and number == last - 1:
                # It was killed in the middle of its call.
                link.send_call(encode(request))
                if chance.random() < 0.1:
                    link.close()
                    link = RawClient(options.endpoint)
                counts["left"] += 1
                break
            try:
                replies = link.ask(request)
            except OSError as error:
                wrong.append(f"no answer: {error!r}")
                break
            told = content(replies)
            expected = right[name][number]
            if told == expected:
                counts["answers"] += 1
            elif told and isinstance(told[0][0], str):
                wrong.append(f"{name}, turn {number}: {told} instead of {expected}")
            else:
                kind = type(told[0][0]).__name__ if told else "nothing"
                counts[kind] += 1
                if told and not isinstance(told[0][0], NeedState):
                    break  # it is busy
    print(json.dumps({"seed": options.seed, **counts, "wrong": wrong}), flush=True)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
