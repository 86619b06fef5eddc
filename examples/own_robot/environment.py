"""A robot of your own: what holdfast needs to know of it is one class.

This one talks to `controller.py` over TCP. Start that, then the run::

    python examples/own_robot/controller.py &
    holdfast run examples/own_robot/own_robot.yaml --environment environment:SocketRobot
"""

import json
import socket
import time

import numpy as np


class SocketRobot:
    """A robot behind a socket.

    Parameters
    ----------
    host, port, connect_timeout_s
        From the section `environment.arguments` of the configuration.
    trial : int
        From holdfast: the robot is made anew for each trial.
    resumed : bool
        From holdfast: True after a crash in mid-trial. Then the robot stays where it is.
    """

    def __init__(self, host="127.0.0.1", port=7500, connect_timeout_s=10.0, trial=0, resumed=False):
        self._address = (host, port)
        self._connect_timeout_s = connect_timeout_s
        self._connect()
        command = {"do": "count"} if resumed else {"do": "start", "trial": trial}
        state = self._ask_until_answered(command)
        if state["trial"] != trial:
            self.close()
            raise RuntimeError(f"the controller is in trial {state['trial']}, not in {trial}")
        self._performed = state["performed"]

    def perform_sensing(self, sensing_action):
        """Measure one coordinate of the peg."""
        answer = self._ask_until_answered({"do": "sense", "coordinate": sensing_action})
        return np.array([answer["value"]])

    def perform(self, task_action):
        """Move, and return the reward."""
        move = {"do": "move", "step": self._performed, "action": task_action.tolist()}
        while (answer := self._ask(move)) is None:
            # The link broke. Only the controller knows whether it moved all the same.
            self._connect()
            answer = self._ask_until_answered({"do": "count"})
            if answer["performed"] != self._performed:
                break
        self._performed += 1
        if answer["performed"] != self._performed:
            raise RuntimeError(
                f"the controller has made {answer['performed']} moves, not {self._performed}"
            )
        return answer["reward"]

    def is_done(self):
        """Tell whether the peg is half-way in."""
        return self._ask_until_answered({"do": "done"})["done"]

    def steps_performed(self):
        """Return the number of moves in this trial; holdfast asks after a crash."""
        return self._ask_until_answered({"do": "count"})["performed"]

    def close(self):
        """Hang up; the robot stays where it is."""
        self._lines.close()
        self._socket.close()

    def _connect(self):
        deadline = time.monotonic() + self._connect_timeout_s
        while True:
            try:
                self._socket = socket.create_connection(self._address, self._connect_timeout_s)
                break
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.1)  # it may be on its way up
        # From here on holdfast watches the time: environment.timeout_ms.
        self._socket.settimeout(None)
        self._lines = self._socket.makefile("r", encoding="utf-8")

    def _ask(self, command):
        """Return the answer, or None if the link broke before it came."""
        try:
            self._socket.sendall(json.dumps(command).encode() + b"\n")
            line = self._lines.readline()
        except ConnectionError:
            line = ""
        if not line.endswith("\n"):
            self.close()
            return None
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(f"the controller refused {command}: {answer['error']}")
        return answer

    def _ask_until_answered(self, command):
        """Ask what may be asked twice."""
        while (answer := self._ask(command)) is None:
            self._connect()
        return answer
