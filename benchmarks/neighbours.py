"""What a robot waits for while others do to its service's port whatever may be done to a port.

The neighbours are programs of their own (tests/fuzz/neighbours.py), one kind at a time; beside each
a robot asks at a steady rate, or a new one comes every second and asks its first question.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.common import Context
from benchmarks.processes import ServiceProcess
from benchmarks.report import Bar, Result, Table, milliseconds, paragraph
from benchmarks.robots import configuration_for
from benchmarks.turns import Asker, Turn, recorded_turns
from holdfast.protocol.messages import SessionConfiguration
from holdfast.robot.session_configuration import session_configuration_of
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.key_ring import make_credentials

__all__ = ["neighbours"]

# What was asked for.
WAIT_BAR_MS = 25.0
SERVED_BAR_MS = 200.0

_RATE_HZ = 50.0
_ROOT = Path(__file__).parents[1]

_AT_WORK = {
    "": "nobody",
    "deaf": "two clients that ask and never read",
    "slow": "200 connections that say a byte every 0.1 s",
    "scanner": "500 connections a second, closed at once",
    "greetings": "200 greetings of HTTP or TLS a second",
    "large": "a robot that hands over a belief of 61 MB again and again",
}
_NEW = {
    "": "nobody",
    "hasty": "2,000 connections, closed before their handshake",
    "trickle": "50 connections a second, closed before their handshake",
}


def neighbours(context: Context) -> Result:
    """Measure what robots wait for beside each kind of neighbour."""
    seconds = 2.0 if context.quick else 10.0
    trickle_s = 3.0 if context.quick else 60.0
    rows, new_rows, bars = [], [], []
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        configuration = configuration_for(directory, num_trials=1)
        session_configuration = session_configuration_of(configuration)
        turns = [
            turn
            for trial in range(5 if context.quick else 60)
            for turn in recorded_turns(configuration.problem, configuration.planning, trial)
        ]
        make_credentials(directory / "keys")
        for done, (kind, what) in enumerate(_AT_WORK.items()):
            waited = _at_work(kind, seconds, session_configuration, turns)
            rows.append([what, str(len(waited)), *_spread(waited)])
            if kind:
                bars.append(
                    Bar(
                        f"a robot at work beside {what}: longest wait for an answer",
                        1e3 * max(waited),
                        WAIT_BAR_MS,
                        "ms",
                    )
                )
            context.progress(0.5 * (done + 1) / len(_AT_WORK))
        for done, (kind, what) in enumerate(_NEW.items()):
            served = _new(kind, directory / "keys", trickle_s, session_configuration, turns[0])
            new_rows.append([what, str(len(served)), *_spread(served)])
            if kind:
                bars.append(
                    Bar(
                        f"tls, {what}: longest until a new robot has its first answer",
                        1e3 * max(served),
                        SERVED_BAR_MS,
                        "ms",
                    )
                )
            context.progress(0.5 + 0.5 * (done + 1) / len(_NEW))
    header = ("median", "99 %", "longest")
    return Result(
        [
            paragraph(
                f"""A robot that asks {_RATE_HZ:g} whole turns of 100 particles a second over tcp,
                and who else comes to its service's port, on the same two cores: milliseconds from
                a question until the last part of its answer."""
            ),
            Table(("beside", "asked", *header), rows),
            paragraph(
                """A new robot every quarter of a second at a service with mutual TLS: milliseconds
                from before it connects until it has the sensing action that it asked for first. The
                2,000 connections are made one after another, as fast as they come about."""
            ),
            Table(("beside", "robots", *header), new_rows),
        ],
        bars,
    )


def _at_work(
    kind: str, seconds: float, session_configuration: SessionConfiguration, turns: Sequence[Turn]
) -> list[float]:
    """Return how long a robot waited for each of its answers."""
    waited = []
    with (
        ServiceProcess() as service,
        Asker(service.endpoint, session_configuration, b"at work, steady.") as asker,
    ):
        _ask(asker, turns[0])  # loads the problem
        with _Neighbour(kind, service.endpoint, seconds):
            until = time.perf_counter() + seconds
            for turn in turns[1:]:
                if (began := time.perf_counter()) > until:
                    break
                waited.append(_ask(asker, turn))
                asker.pause(max(0.0, began + 1.0 / _RATE_HZ - time.perf_counter()))
    return waited


def _new(
    kind: str, keys: Path, seconds: float, session_configuration: SessionConfiguration, first: Turn
) -> list[float]:
    """Return how long each of many new robots took to its first answer."""
    files = ("authority.pem", "certificate.pem", "key.pem")
    tls = TlsFiles(*(keys / "robot" / each for each in files))
    served: list[float] = []
    options = ("--tls", str(keys / "service"))
    with ServiceProcess(*options, protocol="tls") as service:
        with Asker(service.endpoint, session_configuration, b"loads it first..", tls) as asker:
            _ask(asker, first)
        with _Neighbour(kind, service.endpoint, seconds, keys / "robot") as neighbour:
            until = time.perf_counter() + seconds
            while time.perf_counter() < until:
                session = len(served).to_bytes(16, "big")
                began = time.perf_counter()
                with Asker(service.endpoint, session_configuration, session, tls) as asker:
                    _ask(asker, first)
                    served.append(time.perf_counter() - began)
                if neighbour.has_ended:
                    break
                time.sleep(0.25 if kind != "hasty" else 0.02)
    return served


def _ask(asker: Asker, turn: Turn) -> float:
    asked = asker.ask(turn.state, turn.digest, turn.observations[-1:])
    if asked.sensing is None or not turn.is_right(asked.sensing):
        raise RuntimeError(f"wrong answer at step {turn.state.step}: {asked}")
    return asked.sensing_s


class _Neighbour:
    """A program of tests/fuzz/neighbours.py beside what is measured; none for an empty name."""

    def __init__(self, kind: str, endpoint: str, seconds: float, keys: Path | None = None) -> None:
        self._command = [
            *(sys.executable, "-m", "tests.fuzz.neighbours", kind, endpoint),
            *("--seconds", str(seconds + 1.0), *(["--tls", str(keys)] if keys else [])),
        ]
        self._is_there = kind != ""
        self._stack = ExitStack()
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def has_ended(self) -> bool:
        return self._process is not None and self._process.poll() is not None

    def __enter__(self) -> _Neighbour:
        if self._is_there:
            process = subprocess.Popen(self._command, cwd=_ROOT, stdout=subprocess.PIPE)
            self._process = self._stack.enter_context(process)
            assert process.stdout is not None
            if process.stdout.readline() != b"begins\n":
                raise RuntimeError(f"{self._command} did not begin")
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
        self._stack.close()


def _spread(seconds: Sequence[float]) -> list[str]:
    values = np.array(seconds)
    return [
        milliseconds(float(value))
        for value in (np.median(values), np.percentile(values, 99), values.max())
    ]
