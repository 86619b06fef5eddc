"""The wire of ROS 2 with others at its other end: zenoh-ros2-sdk and pyzeros.

Each of them asks ``holdfast serve --ros2-domain`` through a whole trial, and each serves one to our
client. They know nothing of holdfast: keys, hashes, attachments and serialisation are their own.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.ports import free_port
from tests.ros.conftest import ROOT, left_out, line_of
from tests.unit.test_ros_client import EXAMPLE, configuration, decisions, in_process

from holdfast.config.loader import Configuration
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.ros.active_sensing import (
    ActiveSensing,
    DecisionAnswer,
    DecisionRequest,
    ErrorCode,
    checked_state,
    no_state,
)
from holdfast.ros.client import ActiveSensingClient, DecisionService
from holdfast.ros.messages import type_hash
from holdfast.ros.ros2_client import Ros2Service

PATIENCE_S = 30.0
NAME = "cloud_active_sensing"
DOMAIN = 42
TRIAL = 2
PEERS = Path(__file__).parent / "peers"


@contextmanager
def running(*command: str | Path, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Run a process that ends with its standard input."""
    with subprocess.Popen(
        [*map(str, command)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **options
    ) as process:
        assert process.stdin is not None
        try:
            yield process
        finally:
            try:
                process.stdin.close()
                process.wait(10.0)
            except (OSError, subprocess.TimeoutExpired):
                process.kill()


@pytest.fixture(params=["zenoh_ros2_sdk", "pyzeros"])
def peer(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="session")
def peers_python() -> Path:
    """Return the interpreter that has the peers."""
    venv = Path(os.environ.get("ROS2", ROOT / ".ros2")) / "peers"
    if not (venv / ".complete").exists():
        left_out(f"no peers in {venv}: make test-ros installs them")
    return venv / "bin" / "python"


def start_peer(python: Path, peer: str, role: str, port: int) -> Any:
    environment = {
        **os.environ,
        "CYDR_CACHE_DIR": str(python.parents[1] / ".cydr"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    script = PEERS / f"{peer}_peer.py"
    return running(
        python, script, role, NAME, str(DOMAIN), str(port), ROOT / "ros", env=environment
    )


@contextmanager
def router(port: int) -> Iterator[None]:
    with running(sys.executable, Path(__file__).with_name("zenoh_router.py"), str(port)) as process:
        assert line_of(process) == "ready\n"
        yield


@contextmanager
def service(way: str, port: int) -> Iterator[None]:
    """Run ``holdfast serve``, which listens or is there through a router."""
    # fmt: off
    with running(
        sys.executable, "-m", "holdfast", "serve", "--ros2-domain", str(DOMAIN),
        f"--ros2-{way}", f"tcp/127.0.0.1:{port}", "--configuration", EXAMPLE,
        "--until-stdin-closes",
    ) as process:
        assert "offers ros2" in line_of(process)
        yield
    # fmt: on


@contextmanager
def offered(way: str, port: int) -> Iterator[None]:
    """Run the service, and a router if it needs one."""
    with contextlib.ExitStack() as stack:
        if way == "router":
            stack.enter_context(router(port))
        stack.enter_context(service(way, port))
        yield


def array(numbers: list[float]) -> np.ndarray:
    return np.array(numbers, dtype=np.float64)


def state_fields(state: Any) -> dict[str, Any]:
    states, weights = (state or no_state()).belief
    return {
        **{
            key: getattr(state or no_state(), key)
            for key in ("seed", "trial", "step", "stage", "sensed")
        },
        "belief": {
            "state_size": states.shape[1],
            "states": states.ravel().tolist(),
            "weights": weights.tolist(),
        },
    }


def state_of(fields: dict[str, Any]) -> Any:
    belief = fields["belief"]
    return checked_state(
        fields["seed"],
        fields["trial"],
        fields["step"],
        fields["stage"],
        fields["sensed"],
        belief["state_size"],
        array(belief["states"]),
        array(belief["weights"]),
    )


class ThroughPeer:
    """Asks through a peer that is a client."""

    name = "peer"

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        fields = {
            **request._asdict(),
            "kind": int(request.kind),
            "state": state_fields(request.state),
            "observation": request.observation.tolist(),
        }
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(fields) + "\n")
        self._process.stdin.flush()
        answer = json.loads(line_of(self._process))
        size = answer["action_size"]
        actions = array(answer["task_actions"])
        return DecisionAnswer(
            ErrorCode(answer["error"]),
            answer["message"],
            answer["configuration"],
            state_of(answer["state"]),
            answer["sensing_action"],
            array(answer["entropies"]),
            actions.reshape(-1, size) if size else np.empty((0, 0)),
        )

    def close(self) -> None:
        pass


class Nobody:
    """A recovery service that is not needed."""

    name = "nobody"

    def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        raise AssertionError("the first service has answered nothing")

    def close(self) -> None:
        pass


def trial_of(way: DecisionService, settings: Configuration) -> list[Any]:
    simulator = settings.simulator
    with ActiveSensingClient(way, Nobody(), PATIENCE_S) as client:
        world = SimulatedEnvironment(settings.problem, simulator.seed, TRIAL)
        return decisions(client, world, simulator.seed, TRIAL, simulator.max_steps)


@pytest.mark.parametrize("way", ["listen", "router"])
def test_a_peer_asks_us(peer: str, way: str, peers_python: Path) -> None:
    port = free_port()
    with offered(way, port), start_peer(peers_python, peer, "client", port) as process:
        assert json.loads(line_of(process)) == {"ready": type_hash()}
        settings = configuration(**{"particle_filter.num_particles": 100})
        assert trial_of(ThroughPeer(process), settings) == in_process(settings, TRIAL)


@pytest.mark.parametrize("way", ["listen", "router"])
def test_a_peer_lists_us(way: str, peers_python: Path) -> None:
    """As ``ros2 service list -t`` would."""
    port = free_port()
    with offered(way, port):
        # fmt: off
        listed = subprocess.run(
            [peers_python.with_name("zenoh-ros2"), "--no-daemon", "--domain-id", str(DOMAIN),
             "--router", f"127.0.0.1:{port}", "--timeout", "5", "service", "list", "-t"],
            capture_output=True, text=True, timeout=PATIENCE_S, check=True,
        )
        # fmt: on
    assert listed.stdout == f"/{NAME} [holdfast_interfaces/srv/ActiveSensing]\n"


def test_a_peer_answers_us(peer: str, peers_python: Path) -> None:
    port = free_port()
    settings = configuration()
    answers = ActiveSensing(settings)

    def answer(process: subprocess.Popen[str]) -> None:
        assert process.stdin is not None and process.stdout is not None
        for line in process.stdout:
            asked = json.loads(line)
            request = DecisionRequest(
                asked["kind"],
                asked["configuration"],
                asked["seed"],
                asked["trial"],
                state_of(asked["state"]),
                asked["sensing_action"],
                array(asked["observation"]),
            )
            given = answers.answer(request)
            fields = {
                **given._asdict(),
                "error": int(given.error),
                "state": state_fields(given.state),
                "entropies": given.entropies.tolist(),
                "action_size": given.task_actions.shape[1],
                "task_actions": given.task_actions.ravel().tolist(),
            }
            process.stdin.write(json.dumps(fields) + "\n")
            process.stdin.flush()

    with router(port), start_peer(peers_python, peer, "server", port) as process:
        assert json.loads(line_of(process)) == {"ready": type_hash()}
        answering = threading.Thread(target=answer, args=(process,))
        answering.start()
        way = Ros2Service(NAME, DOMAIN, f"tcp/127.0.0.1:{port}")
        try:
            assert trial_of(way, settings) == in_process(settings, TRIAL)
        finally:
            process.kill()
            answering.join()
