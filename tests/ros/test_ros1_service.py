"""The typed service in a real ROS 1: stock tools and clients use it, and a run loses nothing."""

import asyncio
import json
import os
import signal
import socket
import struct
import subprocess
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from tests.process_states import stop
from tests.ros.conftest import PATIENCE_S, line_of
from tests.ros.ros1_processes import HOLDFAST, SYSTEM_PYTHON, Ros1, ros1_in, wait_for
from tests.unit.test_ros_client import in_process

from holdfast.config.loader import Configuration, load
from holdfast.errors import TransportError
from holdfast_ros.active_sensing import (
    ActiveSensing,
    DecisionAnswer,
    DecisionRequest,
    ErrorCode,
    RequestKind,
)
from holdfast_ros.loop_thread import LoopThread
from holdfast_ros.messages import md5_sum
from holdfast_ros.ros1_client import Ros1Client, Ros1Service
from holdfast_ros.ros1_environment import RosEnvironment
from holdfast_ros.ros1_service import Ros1Server
from ros1_master_guard.headers import encode_header

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
Maker = Callable[[str], "Asker"]
CLOUD, RECOVERY = "cloud_active_sensing", "cloud_active_sensing_recovery"


@pytest.fixture
def around(ros1: Mapping[str, str], tmp_path: Path) -> Iterator[Ros1]:
    yield from ros1_in(ros1, tmp_path)


@pytest.fixture
def here(around: Ros1) -> RosEnvironment:
    return RosEnvironment.of(around.environment)


class Asker:
    """A client of one service, asked from the test's thread."""

    def __init__(self, name: str, here: RosEnvironment, thread: LoopThread) -> None:
        self.service = Ros1Service(name, here, "robot")
        self.thread = thread

    def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        return self.thread.run(self.service.ask(request, deadline_s))

    def disconnect(self) -> None:
        self.thread.call(self.service.disconnect)


@pytest.fixture
def client_of(here: RosEnvironment) -> Iterator[Maker]:
    """Make clients of services by their names."""
    thread = LoopThread("test")
    made: list[Asker] = []

    def make(name: str) -> Asker:
        made.append(Asker(name, here, thread))
        return made[-1]

    yield make
    for service in made:
        service.disconnect()
    thread.close(30.0)


@pytest.fixture
def configuration() -> Configuration:
    return load(EXAMPLE)


def test_the_tools_of_ros_know_the_service(around: Ros1) -> None:
    around.serve(CLOUD, EXAMPLE)
    assert f"/{CLOUD}" in around.run("rosservice", "list").split()
    assert around.run("rosservice", "type", f"/{CLOUD}").split() == [
        "holdfast_interfaces/ActiveSensing"
    ]
    info = around.run("rosservice", "info", f"/{CLOUD}")
    assert f"Node: /{CLOUD}" in info
    assert "Args: kind configuration seed trial state" in info
    assert f"/{CLOUD}" in around.run("rosnode", "list").split()
    assert f"* /{CLOUD}" in around.run("rosnode", "info", f"/{CLOUD}")
    assert "xmlrpc reply" in around.run("rosnode", "ping", "-c", "1", f"/{CLOUD}")
    shown = around.run("rossrv", "show", "holdfast_interfaces/ActiveSensing")
    assert "uint8 CHOOSE_TASK_ACTIONS=2" in shown
    assert around.run("rossrv", "md5", "holdfast_interfaces/ActiveSensing").strip() == md5_sum()
    called = around.run("rosservice", "call", f"/{CLOUD}", "{kind: 0, seed: 3, trial: 0}")
    assert "error: 0" in called
    refused = around.run("rosservice", "call", f"/{CLOUD}", "{kind: 7}")
    assert "kind 7: there are 0 INITIALIZE, 1 CHOOSE_SENSING_ACTION" in refused


STOCK = """
import json, rospy, sys
from holdfast_interfaces.srv import ActiveSensing, ActiveSensingRequest

rospy.init_node("stock")
rospy.wait_for_service("cloud_active_sensing", 10)
said = []
for persistent in (False, True):
    ask = rospy.ServiceProxy("cloud_active_sensing", ActiveSensing, persistent=persistent)
    state = ask(ActiveSensingRequest(kind=0, seed=4, trial=1)).state
    chosen = ask(ActiveSensingRequest(kind=1, state=state))
    acted = ask(ActiveSensingRequest(
        kind=2, state=state, sensing_action=chosen.sensing_action, observation=[0.1]))
    state.belief.weights = [1.0] * len(state.belief.weights)
    spoilt = ask(ActiveSensingRequest(kind=1, state=state))
    other = ask(ActiveSensingRequest(kind=0, configuration="another"))
    said.append([chosen.sensing_action, list(chosen.entropies), acted.error, acted.message,
        list(acted.task_actions), spoilt.error, spoilt.message, other.error, other.message])
print(json.dumps(said))
"""


def test_a_stock_client_in_rospy_asks_and_is_told_its_mistakes(
    around: Ros1, client_of: Maker
) -> None:
    around.serve(CLOUD, EXAMPLE)
    once, standing = json.loads(around.run(SYSTEM_PYTHON, "-c", STOCK))
    assert once == standing
    chosen, entropies, error, message, actions, *mistakes = once
    service = client_of(CLOUD)
    state = service.ask(DecisionRequest(RequestKind.INITIALIZE, seed=4, trial=1), 30.0).state
    answer = service.ask(DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state), 30.0)
    assert (chosen, entropies) == (answer.sensing_action, answer.entropies.tolist())
    assert (error, message) == (ErrorCode.OK, "")
    assert len(actions) > 0
    assert mistakes[0] == ErrorCode.BAD_REQUEST
    assert "weights" in mistakes[1]
    assert mistakes[2] == ErrorCode.OTHER_CONFIGURATION
    assert "'another'" in mistakes[3]


ROBOT = """
import json, sys, time
import rospy
from holdfast.config.loader import load
from holdfast_ros.active_sensing import DecisionRequest, RequestKind
from holdfast_ros.ros1_client import Ros1Client
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.protocol.status import Status

settings = load(sys.argv[1])
simulator = settings.simulator
rospy.init_node("executive")
made, statuses = [], []
with Ros1Client(
    "active_sensing", deadline_s=float(sys.argv[2]),
    on_event=lambda name, **fields: statuses.append(fields.get("status", name)),
) as client:
    world = SimulatedEnvironment(settings.problem, simulator.seed, 0)
    request = DecisionRequest(RequestKind.INITIALIZE, seed=simulator.seed, trial=0)
    state = client.decide(request).state
    done = False
    while not done:
        # Whoever watches may do harm here, and says when it is done.
        print(len(made), flush=True)
        if sys.stdin.readline() == "wait for the cloud\\n":
            while client.status is not Status.KEEP_ALIVE:
                client.decide(DecisionRequest(RequestKind.INITIALIZE))
                time.sleep(0.01)
        request = DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state)
        chosen = client.decide(request).sensing_action
        made.append(chosen)
        answer = client.decide(DecisionRequest(
            RequestKind.CHOOSE_TASK_ACTIONS, state=state, sensing_action=chosen,
            observation=world.perform_sensing(chosen)))
        state = answer.state
        for action in answer.task_actions:
            world.perform(action)
            made.append(tuple(action))
            done = world.is_done()
            if done:
                break
print(json.dumps([made, statuses]), flush=True)
"""


class Robot:
    """A node in rospy, of the system's Python, that runs a trial step by step."""

    def __init__(self, around: Ros1, deadline_s: float) -> None:
        command = [around.python, "-c", ROBOT, str(EXAMPLE), str(deadline_s)]
        self._process = around.start(
            *command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=None, text=True
        )

    def next(self) -> Any:
        """Return how many decisions there are, or at the end what they were."""
        line = line_of(self._process)
        assert line, "the robot has ended"
        return json.loads(line)

    def go_on(self, told: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{told}\n")
        self._process.stdin.flush()


def test_a_run_decides_as_in_process_whatever_happens_to_the_cloud(
    around: Ros1, configuration: Configuration
) -> None:
    cloud = around.serve(CLOUD, EXAMPLE)
    around.serve(RECOVERY, EXAMPLE)
    robot = Robot(around, 2.0)  # longer than a busy machine stands still
    steps = 0
    echo = None
    while isinstance(said := robot.next(), int):
        steps += 1
        told = ""
        match steps:
            case 1:
                echo = around.start(
                    *("rostopic", "echo", "-p", "/active_sensing/status"),
                    stdout=subprocess.PIPE,
                    text=True,
                )
                assert line_of(echo) == "%time,field.data\n"
                assert line_of(echo).endswith(",standard\n")
            case 2:
                cloud.kill()
                cloud.wait()
            case 4:
                cloud = around.serve(CLOUD, EXAMPLE)
                told = "wait for the cloud"
            case 6:
                stop(cloud.pid)
            case 8:
                cloud.send_signal(signal.SIGCONT)
                told = "wait for the cloud"
            case 10:
                cloud.terminate()
                cloud.wait()
        robot.go_on(told)
    made, statuses = said
    assert steps > 10
    assert made == json.loads(json.dumps(in_process(configuration, 0)))
    assert echo is not None
    expected = ["local recovery", "keep alive", "local recovery", "keep alive", "local recovery"]
    assert [status.replace("_", " ") for status in statuses] == expected
    seen = [line_of(echo).strip().rpartition(",")[2] for _ in expected]
    assert seen == expected


def test_a_dead_service_that_the_master_still_lists_is_found_without_waiting(
    around: Ros1, client_of: Maker
) -> None:
    cloud = around.serve(CLOUD, EXAMPLE)
    standing, new = client_of(CLOUD), client_of(CLOUD)
    standing.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0)
    cloud.kill()
    cloud.wait()
    assert around.service_uri(CLOUD) is not None
    for service in (standing, new):
        with pytest.raises(TransportError, match=r"nobody listens at .* the master says it is"):
            service.ask(DecisionRequest(RequestKind.INITIALIZE), 120.0)
    around.serve(CLOUD, EXAMPLE)
    for service in (standing, new):
        assert service.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0).error is ErrorCode.OK


def test_a_stopped_service_costs_no_more_than_the_deadline(around: Ros1, client_of: Maker) -> None:
    cloud = around.serve(CLOUD, EXAMPLE)
    standing, new = client_of(CLOUD), client_of(CLOUD)
    standing.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0)
    stop(cloud.pid)
    for service in (standing, new, standing):
        with pytest.raises(TransportError, match=r"no answer in 0\.2 s"):
            service.ask(DecisionRequest(RequestKind.INITIALIZE), 0.2)
    cloud.send_signal(signal.SIGCONT)
    for service in (standing, new):
        assert service.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0).error is ErrorCode.OK


class TestTheMasterDies:
    def test_calls_to_a_service_that_lives_go_on(self, around: Ros1, client_of: Maker) -> None:
        around.serve(CLOUD, EXAMPLE)
        service = client_of(CLOUD)
        service.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0)
        assert around.master is not None
        around.master.kill()
        around.master.wait()
        assert service.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0).error is ErrorCode.OK
        # Even over a new connection: it is where it was.
        service.disconnect()
        assert service.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0).error is ErrorCode.OK
        never_seen = client_of(CLOUD)
        with pytest.raises(TransportError, match=f"there is no master at .*{around.port}"):
            never_seen.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0)

    def test_a_master_that_knows_nothing_is_told_again(
        self, around: Ros1, here: RosEnvironment
    ) -> None:
        around.serve(CLOUD, EXAMPLE)
        assert around.master is not None
        for _ in range(2):
            around.master.kill()
            around.master.wait()
            around.start_master()
            wait_for(lambda: around.service_uri(CLOUD), "the service is listed again")
            assert f"/{CLOUD}" in around.run("rosservice", "list").split()

    def test_a_master_that_stands_still_holds_up_no_call(
        self, around: Ros1, client_of: Maker
    ) -> None:
        cloud = around.serve(CLOUD, EXAMPLE)
        service = client_of(CLOUD)
        service.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0)
        assert around.master is not None
        stop(around.master.pid)
        service.disconnect()
        assert service.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0).error is ErrorCode.OK
        never_seen = client_of(CLOUD)
        with pytest.raises(TransportError, match=r"no answer"):
            never_seen.ask(DecisionRequest(RequestKind.INITIALIZE), 0.3)
        around.master.send_signal(signal.SIGCONT)
        assert never_seen.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0).error is ErrorCode.OK
        assert cloud.poll() is None

    def test_a_service_can_be_started_before_its_master(
        self, around: Ros1, here: RosEnvironment
    ) -> None:
        assert around.master is not None
        around.master.kill()
        around.master.wait()
        around.start(
            # The system's Python, as the robot has it.
            *(around.python, "-m", "holdfast", "ros1-serve", "--configuration", str(EXAMPLE))
        )
        around.start_master()
        wait_for(lambda: around.service_uri(CLOUD), "the service is listed")


def test_rosnode_kill_ends_it(around: Ros1) -> None:
    cloud = around.serve(CLOUD, EXAMPLE)
    around.run("rosnode", "kill", f"/{CLOUD}")
    assert cloud.wait(PATIENCE_S) == 0
    assert around.service_uri(CLOUD) is None


def test_the_later_one_of_a_name_has_it_and_the_earlier_one_ends(around: Ros1) -> None:
    first, second = (around.serve(CLOUD, EXAMPLE) for _ in range(2))
    assert first.wait(PATIENCE_S) == 0
    assert around.service_uri(CLOUD) is not None
    assert second.poll() is None


def test_who_watches_a_robot_is_told_the_status(around: Ros1, here: RosEnvironment) -> None:
    around.serve(CLOUD, EXAMPLE)
    with Ros1Client("arm", ros_environment=here, deadline_s=30.0) as client:
        wait_for(lambda: "/arm" in around.run("rosnode", "list").split(), "the node is listed")
        assert "* /arm/status [std_msgs/String]" in around.run("rosnode", "info", "/arm")
        assert 'data: "standard"' in around.run("rostopic", "echo", "-n", "1", "/arm/status")
        client.decide(DecisionRequest(RequestKind.INITIALIZE, seed=4))
        assert client.decided_by == f"/{CLOUD}"
    assert "/arm" not in around.run("rosnode", "list").split()


WAITING = """
import rospy
from holdfast_ros.active_sensing import DecisionRequest, RequestKind
from holdfast_ros.ros1_client import Ros1Client

rospy.init_node("waiting")
with Ros1Client(deadline_s=0.01) as client:
    try:
        client.decide(DecisionRequest(RequestKind.INITIALIZE), give_up_s=0.2)
    except Exception as error:
        print(error)
"""


def test_a_node_in_rospy_says_on_its_terminal_what_it_waits_for(around: Ros1) -> None:
    said = around.run("bash", "-c", 'exec "$0" -c "$1" 2>&1', around.python, WAITING).splitlines()
    assert [line.split()[2] for line in said[:-1]] == ["status:", "holding:"]
    assert all(line.startswith("[WARN]") for line in said[:-1])
    assert said[-1].startswith("nobody has answered in 0.2 s: ")


def test_it_serves_on_if_nobody_reads_what_it_says(around: Ros1) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write) as nobody:
        command = (HOLDFAST, "ros1-serve", "--configuration", str(EXAMPLE))
        around.start(*command, stdout=nobody, stderr=nobody)
    wait_for(lambda: around.service_uri(CLOUD), "the master knows it")
    assert "error: 0" in around.run("rosservice", "call", f"/{CLOUD}", "{kind: 0, seed: 3}")


def request_of(payload: bytes, size: int | None = None, md5sum: str = "*") -> bytes:
    """Return a call of the service with anything as its request."""
    header = {"callerid": "/test", "service": f"/{CLOUD}", "md5sum": md5sum}
    header |= {} if size is None else {"persistent": "1"}
    return encode_header(header) + struct.pack("<I", size or len(payload)) + payload


@pytest.fixture(scope="module")
def served(
    ros1: Mapping[str, str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Ros1, Asker]]:
    """Return a service, and a client that it has, for all who mean it ill."""
    thread = LoopThread("test")
    for around in ros1_in(ros1, tmp_path_factory.mktemp("served")):
        around.serve(CLOUD, EXAMPLE)
        standing = Asker(CLOUD, RosEnvironment.of(around.environment), thread)
        yield around, standing
        standing.disconnect()
    thread.close(30.0)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b""),
        (b"\xff" * 64, b""),
        (struct.pack("<I", 3) + b"abc", b""),
        (encode_header({"hello": "world"}), b""),
        (request_of(b"", size=1 << 31), b""),
        (request_of(b"abc"), b"3 bytes are no holdfast_interfaces/srv/ActiveSensing_Request"),
        (encode_header({"service": "/other", "md5sum": "*"}), b"has no service [/other]"),
        (request_of(b"", md5sum="0" * 32), b"of type holdfast_interfaces/ActiveSensing"),
        (encode_header({"topic": "/other", "md5sum": "*"}), b"does not publish [/other]"),
    ],
    ids=[
        *("http", "length", "cut_off", "neither", "large_request"),
        *("no_message", "no_service", "another_type", "no_topic"),
    ],
)
def test_who_speaks_otherwise_is_told_and_hung_up_on_and_nobody_else(
    served: tuple[Ros1, Asker], said: bytes, told: bytes
) -> None:
    around, standing = served
    uri = around.service_uri(CLOUD)
    assert uri is not None
    host, _, port = uri.removeprefix("rosrpc://").rpartition(":")
    with socket.create_connection((host, int(port)), 30.0) as stream:
        stream.sendall(said)
        heard = b"".join(iter(lambda: stream.recv(4096), b""))
    assert told in heard
    assert standing.ask(DecisionRequest(RequestKind.INITIALIZE), 30.0).error is ErrorCode.OK


async def test_a_defect_costs_its_request_alone(
    here: RosEnvironment,
    client_of: Maker,
    configuration: Configuration,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[str] = []
    service = Ros1Server(configuration, ros_environment=here)
    service.start(lambda name, **_: told.append(name))
    asker = client_of(CLOUD)
    loop = asyncio.get_running_loop()

    async def ask() -> DecisionAnswer:
        return await loop.run_in_executor(
            None, asker.ask, DecisionRequest(RequestKind.INITIALIZE), 30.0
        )

    with monkeypatch.context() as defect:
        defect.setattr(ActiveSensing, "answer", None)
        with pytest.raises(TransportError, match="it answers: the service has failed: TypeError"):
            await ask()
    assert (await ask()).error is ErrorCode.OK
    assert told == ["ros_master", "ros_request_failed"]
    service.close(1.0)
