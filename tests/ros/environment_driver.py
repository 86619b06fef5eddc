"""A node that calls a robot's environment as it is told, line by line, on its standard input.

    {"id": 1, "do": "make", "act": "action", "timeout_ms": 60000, "trial": 0, "resumed": false}
    {"id": 2, "do": "perform_sensing", "arguments": [0]}
    {"id": 3, "do": "cancel"}

Each line is answered by one with its id and either ``result`` or ``error``. Calls are made by a
thread that is not the executor's, as a robot's loop makes them; ``cancel`` is not queued.
``cancel_once_accepted`` cancels as soon as the robot has accepted a task action.
"""

from __future__ import annotations

import json
import queue
import sys
import threading
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node

from holdfast.errors import EnvironmentFailedError
from holdfast_ros.ros2_environment import Connections, Ros2Environment


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def say(answer: dict[str, Any]) -> None:
    # In one piece: two threads say something.
    sys.stdout.write(f"{json.dumps(answer)}\n")
    sys.stdout.flush()


def main() -> None:
    rclpy.init()
    node = Node("driver")
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    connections = Connections(node)
    commands: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    environment: Any = None

    def do(command: dict[str, Any]) -> Any:
        nonlocal environment
        if command["do"] == "make":
            environment = Ros2Environment(
                connections,
                trial=command.get("trial", 0),
                resumed=command.get("resumed", False),
                act=command.get("act", "action"),
                timeout_ms=command.get("timeout_ms", 60_000.0),
                discovery_timeout_ms=command.get("discovery_timeout_ms", 5000.0),
            )
            return None
        if command["do"] == "cancel_once_accepted":
            client = environment._act_call.clients[0]
            send = client.call_async

            def sent(goal: Any) -> Any:
                answer = send(goal)
                answer.add_done_callback(lambda _: connections.cancel())
                return answer

            client.call_async = sent
            return None
        arguments = command.get("arguments", [])
        if command["do"] == "perform":
            arguments = [np.array(arguments[0])]
        return _plain(getattr(environment, command["do"])(*arguments))

    def work() -> None:
        while True:
            command = commands.get()
            begun = time.monotonic()
            try:
                answer = {"result": do(command)}
            except EnvironmentFailedError as error:
                public = next(
                    kind for kind in type(error).__mro__ if not kind.__name__.startswith("_")
                )
                answer = {"error": f"{public.__name__}: {error}"}
            except Exception as error:  # noqa: BLE001 - a test must hear of it
                answer = {"error": f"unexpected {type(error).__name__}: {error}"}
            took_s = time.monotonic() - begun
            say({"id": command["id"], "took_s": took_s, **answer})

    threading.Thread(target=work, daemon=True).start()
    for line in sys.stdin:
        command = json.loads(line)
        if command["do"] == "cancel":
            connections.cancel()
            say({"id": command["id"], "result": None})
        else:
            commands.put(command)


if __name__ == "__main__":
    main()
