"""The robot's end of a world that lives in the test's own process (``world.World``).

A class as a user writes one: it knows nothing of holdfast. It is imported by the robots of the
tests, by its name in their configuration.
"""

import json
import socket
from typing import Any

import numpy as np

from holdfast.numerics.arrays import FloatArray


class PlainWorldClient:
    """A world behind a socket, with no more than the three methods that it must have."""

    def __init__(self, port: int, trial: int, resumed: bool) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._lines = self._socket.makefile("r")
        self._ask(do="begin", trial=trial, resumed=resumed)

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        return np.array(self._ask(do="sense", sensing_action=sensing_action)["observation"])

    def perform(self, task_action: FloatArray) -> float:
        return float(self._ask(do="perform", task_action=task_action.tolist())["reward"])

    def is_done(self) -> bool:
        return bool(self._ask(do="is_done")["done"])

    def close(self) -> None:
        self._lines.close()
        self._socket.close()

    def _ask(self, **command: Any) -> dict[str, Any]:
        # Python writes a float so that reading it gives the same bits.
        self._socket.sendall(json.dumps(command).encode() + b"\n")
        line = self._lines.readline()
        if not line:
            raise ConnectionError("the world has hung up")
        answer: dict[str, Any] = json.loads(line)
        return answer


class WorldClient(PlainWorldClient):
    """The same, which tells how much it was made to do."""

    def steps_performed(self) -> int:
        return int(self._ask(do="count")["count"])
