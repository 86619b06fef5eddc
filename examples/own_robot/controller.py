"""Plays a robot's controller: a process of its own, which knows nothing of holdfast.

It holds a peg over a slot in the ground and listens on a TCP socket for one JSON object a line:

    {"do": "start", "trial": 0}                     take the peg back to its start: a new trial
    {"do": "move", "step": 0, "action": [x, y, a]}  answered when the motion has ended
    {"do": "sense", "coordinate": 0}                measure x, y or the angle
    {"do": "done"}                                  is the peg half-way in?
    {"do": "count"}                                 how many moves has this trial had?

Who connected last operates it: a line from an older connection is not carried out any more. It can
be slow, silent for a while, and killed and started again at any time. Each move that it makes
leaves one line in `performed.log`, from which it goes on after a restart. It does what it is told:
a step that comes twice is moved twice and counted twice, and marked as an error there.
"""

import argparse
import json
import math
import random
import socketserver
import threading
import time
from pathlib import Path

HALF_WIDTH, HALF_HEIGHT, GAP = 0.5, 1.0, 0.1  # of the peg, and of the slot around it
START, START_VARIANCE = (4.0, 2.0, 0.0), (2.0, 1.0, 1.57)
MOTION_VARIANCE, SENSING_VARIANCE = (0.01, 0.01, 0.01), 0.001
FAR, SLOT = 1e3, HALF_WIDTH + GAP
OBSTACLES = (
    (-FAR, -FAR, -SLOT, 0.0),
    (SLOT, -FAR, FAR, 0.0),
    (-SLOT, -FAR, SLOT, -HALF_HEIGHT - GAP),
)


def collides(pose):
    """Tell whether the peg overlaps the ground: no axis separates the two rectangles."""
    x, y, angle = pose
    c, s = math.cos(angle), math.sin(angle)
    half = [(a, b) for a in (-HALF_WIDTH, HALF_WIDTH) for b in (-HALF_HEIGHT, HALF_HEIGHT)]
    xs, ys = [x + c * a - s * b for a, b in half], [y + s * a + c * b for a, b in half]
    for left, bottom, right, top in OBSTACLES:
        corners = [(a - x, b - y) for a in (left, right) for b in (bottom, top)]
        us, vs = [c * a + s * b for a, b in corners], [c * b - s * a for a, b in corners]
        if (
            min(xs) < right and max(xs) > left and min(ys) < top and max(ys) > bottom
            and min(us) < HALF_WIDTH and max(us) > -HALF_WIDTH
            and min(vs) < HALF_HEIGHT and max(vs) > -HALF_HEIGHT
        ):  # fmt: skip
            return True
    return False


class Robot:
    """The peg, its clock and its log."""

    def __init__(self, options):
        self.options, self.silent_at = options, options.silent_at
        self.trial, self.performed, self.reward, self.pose = 0, 0, 0.0, START
        options.directory.mkdir(parents=True, exist_ok=True)
        self.log = options.directory / "performed.log"
        if self.log.exists() and (lines := self.log.read_text().splitlines()):
            self.__dict__.update(json.loads(lines[-1])["after"])

    def do(self, command):
        """Carry out a command and return the answer."""
        kind = command["do"]
        if kind == "start":
            self.trial, self.performed, self.reward = command["trial"], 0, 0.0
            self.pose = self._free(START, START_VARIANCE, "start")
            self._note({})
        elif kind == "move":
            self._move(command["step"], command["action"])
        elif kind == "sense":
            value = self.pose[command["coordinate"]]
            noise = self._random("sense").gauss(0.0, math.sqrt(SENSING_VARIANCE))
            return {"value": value + noise}
        elif kind == "done":
            return {"done": abs(self.pose[0]) < GAP and abs(self.pose[1]) < GAP}
        elif kind != "count":
            return {"error": f"unknown command {kind}"}
        return {"trial": self.trial, "performed": self.performed, "reward": self.reward}

    def _move(self, step, action):
        if self.silent_at == step:
            self.silent_at = None
            time.sleep(self.options.silent_s)
        time.sleep(1e-3 * self.options.delay_ms)
        note = {"step": step}
        if step != self.performed:
            note["error"] = f"step {step} was performed where step {self.performed} was due"
        free, blocked = 0.0, 1.0  # parts of the way; it ends at contact
        if not collides(self._along(action, 1.0)):
            free = 1.0
        while blocked - free > 1e-3:
            part = 0.5 * (free + blocked)
            if collides(self._along(action, part)):
                blocked = part
            else:
                free = part
        self.pose = self._free(self._along(action, free), MOTION_VARIANCE, "move")
        self.performed, self.reward = self.performed + 1, -math.hypot(*action)
        self._note(note)

    def _along(self, action, part):
        return tuple(at + part * by for at, by in zip(self.pose, action, strict=True))

    def _free(self, mean, variances, purpose):
        """Draw a pose about `mean` that does not collide."""
        drawn = self._random(purpose)
        for _ in range(1000):
            pose = tuple(
                drawn.gauss(at, math.sqrt(of)) for at, of in zip(mean, variances, strict=True)
            )
            if not collides(pose):
                return pose
        return mean

    def _random(self, purpose):
        # Named, so that the same moves have the same noise in every run and after every restart.
        return random.Random(f"{self.options.seed}/{self.trial}/{self.performed}/{purpose}")

    def _note(self, note):
        after = {key: getattr(self, key) for key in ("trial", "performed", "reward", "pose")}
        with self.log.open("a") as file:  # one write: a kill leaves the whole line or nothing
            file.write(json.dumps({**note, "after": after}) + "\n")


class Connection(socketserver.StreamRequestHandler):
    """Reads commands and answers them, one at a time."""

    disable_nagle_algorithm = True

    def handle(self):
        """Answer until the other end closes, or somebody else connects."""
        server = self.server
        try:
            while line := self.rfile.readline(65536):
                with server.moving:
                    if server.operator is not self.request:
                        return
                    try:
                        answer = server.robot.do(json.loads(line))
                    except (KeyError, TypeError, ValueError, IndexError) as error:
                        answer = {"error": f"{type(error).__name__}: {error}"}
                self.wfile.write(json.dumps(answer).encode() + b"\n")
        except ConnectionError:
            pass  # the other end is gone; the next one may connect


class Server(socketserver.ThreadingTCPServer):
    """Listens; there is one robot, and one lock for it."""

    allow_reuse_address = daemon_threads = True

    def process_request(self, request, client_address):
        """Make whoever connects the operator, in the order in which they do."""
        self.operator = request
        super().process_request(request, client_address)


def main():
    """Read the options and serve until killed."""
    parser = argparse.ArgumentParser(description="A robot's controller behind a TCP socket.")
    parser.add_argument("--port", type=int, default=7500, help="0: any free one")
    parser.add_argument("--directory", type=Path, default=Path(), help="of performed.log")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--delay-ms", type=float, default=10.0, help="how long a move takes")
    parser.add_argument("--silent-at", type=int, help="step at which to be silent once")
    parser.add_argument("--silent-s", type=float, default=10.0, help="for how long")
    options = parser.parse_args()
    with Server(("127.0.0.1", options.port), Connection) as server:
        server.robot, server.moving = Robot(options), threading.Lock()
        print(f"listening on 127.0.0.1:{server.server_address[1]}", flush=True)
        server.serve_forever()


if __name__ == "__main__":
    main()
