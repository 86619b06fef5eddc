"""Processes of a real ROS 2, which are told what to do line by line."""

import contextlib
import json
import queue
import signal
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

WAIT_S = 120.0
"""Longer than anything here may take, on a machine that is busy with other things."""


class Process:
    """A process of the test's; what it prints is kept for the message of a failure."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], **options: Any):
        self._process = subprocess.Popen(
            command, env=dict(environment), text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, **options,
        )  # fmt: skip
        self.lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.put(line)
        self.lines.put(None)

    def next_line(self) -> str:
        line = self.lines.get(timeout=WAIT_S)
        assert line is not None, f"the process has ended: {self._process.wait()}"
        return line

    def send(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self) -> int:
        return self._process.wait(WAIT_S)


class Driver(Process):
    """A node that calls an environment: see environment_driver.py."""

    def __init__(
        self, python: Path, environment: Mapping[str, str], remapped: Sequence[str] = ()
    ) -> None:
        script = Path(__file__).with_name("environment_driver.py")
        rules = [word for rule in remapped for word in ("-r", rule)]
        super().__init__([str(python), str(script), "--ros-args", *rules], environment)
        self._number = 0
        self._answers: dict[int, dict[str, Any]] = {}

    def begin(self, do: str, *arguments: Any, **more: Any) -> int:
        self._number += 1
        command = {"id": self._number, "do": do, "arguments": list(arguments), **more}
        self.send(json.dumps(command))
        return self._number

    def end(self, number: int) -> dict[str, Any]:
        while number not in self._answers:
            answer = json.loads(self.next_line())
            self._answers[answer["id"]] = answer
        return self._answers.pop(number)

    def do(self, what: str, *arguments: Any, **more: Any) -> Any:
        answer = self.end(self.begin(what, *arguments, **more))
        assert "error" not in answer, answer["error"]
        return answer["result"]

    def error(self, what: str, *arguments: Any, **more: Any) -> str:
        answer = self.end(self.begin(what, *arguments, **more))
        assert "error" in answer, answer
        return str(answer["error"])


class ObservedProcess:
    """A process whose output and errors are read all the time, line by line."""

    def __init__(self, command: list[str], environment: dict[str, str], cwd: Path) -> None:
        self.process = subprocess.Popen(
            command,
            env=environment,
            cwd=cwd,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.output: queue.Queue[str] = queue.Queue()
        self.errors: list[str] = []
        self._threads = [
            threading.Thread(target=self._read_output, daemon=True),
            threading.Thread(target=self._read_errors, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def _read_output(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.output.put(line)

    def _read_errors(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.errors.append(line)

    def said(self) -> str:
        return "".join(self.errors)

    def wait_for(self, text: str, count: int = 1) -> None:
        """Wait until the standard error has a text so often."""
        deadline = monotonic() + WAIT_S
        while self.said().count(text) < count:
            assert monotonic() < deadline, f"{text!r} was not said:\n{self.said()}"
            assert self.process.poll() is None, self.said()
            threading.Event().wait(0.02)

    def kill(self) -> None:
        self.process.kill()
        self.end()

    def end(self) -> int:
        code = self.process.wait(WAIT_S)
        for thread in self._threads:
            thread.join(WAIT_S)
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()
        return code

    def interrupt(self, number: signal.Signals = signal.SIGINT) -> int:
        self.process.send_signal(number)
        return self.end()
