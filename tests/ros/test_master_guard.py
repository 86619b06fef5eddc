"""A ROS 1 master that dies, and nodes of others that do not notice: real masters, stock nodes."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.process_states import alive, stop
from tests.ros.conftest import PATIENCE_S
from tests.ros.graph import (
    Graph,
    keeps_on,
    known_to_guard,
    replaced,
    settled,
    start_everything,
    topic_tool,
)
from tests.ros.ros1_processes import SYSTEM_PYTHON, wait_for

GUARD = (sys.executable, "-m", "holdfast", "ros1-guard")


@pytest.fixture
def graph(tmp_path: Path, ros1: dict[str, str]) -> Iterator[Graph]:
    with Graph(tmp_path, ros1) as graph:
        yield graph


class TestItsOwnMaster:
    def test_nobody_loses_a_publisher(self, graph: Graph) -> None:
        # A roscpp node gives up the publishers that it is not told of, and numbers what is new.
        graph.guard()
        graph.node("talker", "/first", "/chatter")
        graph.node("talker", "/second", "/chatter")
        graph.start(topic_tool("relay"), "/chatter", "/relayed", "__name:=relay")
        listener = graph.node("listener", "/listener", "/relayed")
        keeps_on(listener, 20)
        for node in ("/first", "/second"):
            graph.wait_for_node(node)
        wait_for(lambda: len(graph.incoming("/relay", "/chatter")) == 2)
        before = graph.incoming("/relay", "/chatter")
        for _ in range(5):
            replaced(graph, graph.kill_master())
            keeps_on(listener, 50)
        settled(graph)
        assert graph.incoming("/relay", "/chatter") == before

    def test_calls_wait_while_there_is_no_master(self, graph: Graph) -> None:
        guard = graph.guard("--no-rosout")
        server = graph.node("server", "/server", "/work", "/more_work")
        wait_for(lambda: server.lines)
        # The guard is kept from doing anything, so that there is no master for as long as we like.
        stop(guard.process.pid)
        graph.kill_master()
        setting = graph.start("rosparam", "set", "/late", "1")
        listing = graph.start("rosservice", "list")
        server.tell("end one")
        time.sleep(1.0)
        assert setting.process.poll() is None
        assert listing.process.poll() is None
        os.kill(guard.process.pid, signal.SIGCONT)
        for process in (setting, listing):
            assert process.process.wait(PATIENCE_S) == 0, process.account()
        assert "/work" in listing.lines
        assert graph.run("rosparam", "get", "/late") == "1\n"
        wait_for(lambda: "ended one" in server.lines, server.account)
        wait_for(lambda: "/more_work" not in graph.registered()["services"])

    def test_one_that_is_stopped_is_replaced(self, graph: Graph) -> None:
        guard = graph.guard("--silent-s", "1")
        caller, listener = start_everything(graph)
        before, pid = settled(graph), graph.master_pid()
        os.kill(pid, signal.SIGSTOP)
        wait_for(lambda: graph.events(guard, "master_lost"))
        assert graph.listed() == before
        assert graph.master_pid() != pid
        assert not alive(pid)
        keeps_on(caller)
        keeps_on(listener)

    def test_a_node_that_dies_at_the_same_moment(self, graph: Graph) -> None:
        guard = graph.guard()
        caller, _ = start_everything(graph)
        doomed = graph.node("server", "/doomed", "/doomed_work")
        wait_for(lambda: doomed.lines)
        assert "/doomed_work" in graph.registered()["services"]
        pid = graph.master_pid()
        doomed.process.kill()
        os.kill(pid, signal.SIGKILL)
        doomed.process.wait()
        replaced(graph, pid)
        assert "/doomed" not in graph.registered()["nodes"]
        assert "/doomed_work" not in graph.registered()["services"]
        assert {"/work", "/mux/select"} <= graph.registered()["services"].keys()
        wait_for(lambda: len(graph.events(guard, "master_started")) == 2)
        assert graph.events(guard, "master_started")[1]["gone"] == ["/doomed"]
        keeps_on(caller)

    def test_a_node_that_is_stopped_is_kept(self, graph: Graph) -> None:
        guard = graph.guard("--no-rosout")
        server = graph.node("server", "/stopped", "/work")
        wait_for(lambda: server.lines)
        before = graph.registered()
        stop(server.process.pid)
        replaced(graph, graph.kill_master())
        assert graph.registered()["services"] == before["services"]
        wait_for(lambda: len(graph.events(guard, "master_started")) == 2)
        assert graph.events(guard, "master_started")[1]["silent"] == ["/stopped"]
        os.kill(server.process.pid, signal.SIGCONT)
        graph.run("rosservice", "call", "/work")

    def test_who_watches_a_parameter_still_does(self, graph: Graph) -> None:
        graph.guard("--no-rosout")
        graph.run("rosparam", "set", "/speed", "1")
        watcher = graph.node("watcher", "/watcher", "/speed")
        wait_for(lambda: watcher.lines == ["1"], watcher.account)
        for speed in (2, 3):
            replaced(graph, graph.kill_master())
            graph.run("rosparam", "set", "/speed", str(speed))
            wait_for(lambda: watcher.lines[-1] == str(speed), watcher.account)  # noqa: B023

    def test_parameters_of_every_kind(self, graph: Graph) -> None:
        graph.guard("--no-rosout")
        values = {
            "text": "naïve\nlines \u2603",
            "number": 1e-320,
            "whole": -(2**31),
            "list": [1, [2.5, "x"], {"in": "side"}],
            "data": b"\0\1\xff\r\n",
            "space": {"deep": {"deeper": True, "": "no name"}},
            "large": "x" * 5_000_000,
            "many": {f"key_{number}": number for number in range(20_000)},
        }
        for name, value in values.items():
            assert graph.ask("setParam", f"/all/{name}", value)[0] == 1
        assert graph.ask("setParam", "relative", 1, caller="/test/ns")[0] == 1
        assert graph.ask("setParam", "~own", 2)[0] == 1
        assert graph.ask("deleteParam", "/all/space/deep/deeper")[0] == 1
        wait_for(lambda: "rosdistro" in graph.registered()["parameters"])
        before = graph.registered()["parameters"]
        assert before["test"] == {"relative": 1, "own": 2}
        for _ in range(2):
            replaced(graph, graph.kill_master())
            assert graph.registered()["parameters"] == before

    def test_what_there_is_no_room_for_on_the_disk_is_not_lost(self, graph: Graph) -> None:
        # No file may be larger than this, in units of 1024 bytes.
        guard = graph.guard("--no-rosout", before=("bash", "-c", 'ulimit -f 64; exec "$@"', "bash"))
        assert graph.ask("setParam", "/large", "x" * 100_000)[0] == 1
        wait_for(lambda: graph.events(guard, "journal_failed"))
        assert graph.ask("setParam", "/small", "x")[0] == 1
        replaced(graph, graph.kill_master())
        assert graph.registered()["parameters"]["small"] == "x"
        assert len(graph.registered()["parameters"]["large"]) == 100_000
        assert len(graph.events(guard, "journal_failed")) == 1

    @pytest.mark.parametrize("loss", ["file", "directory"])
    def test_its_journal_is_removed(self, graph: Graph, loss: str) -> None:
        guard = graph.guard("--no-rosout")
        graph.run("rosparam", "set", "/speed", "1")
        wait_for(lambda: b"speed" in graph.journal.read_bytes())  # no write is left
        if loss == "file":
            graph.journal.unlink()
        else:
            graph.journal.parent.rename(graph.directory / "taken")
        replaced(graph, graph.kill_master())
        assert graph.registered()["parameters"]["speed"] == 1
        wait_for(graph.journal.exists)
        assert not graph.events(guard, "journal_failed")

    def test_a_journal_that_cannot_be_read_is_named(self, graph: Graph) -> None:
        journal = graph.directory / f"master-{graph.port}.journal"
        journal.write_text("not what it was")
        guard = graph.guard("--no-rosout", "--directory", str(graph.directory))
        (event,) = graph.events(guard, "journal_failed")
        assert f"{journal}: is no journal of a ROS 1 master" in event["reason"]
        assert journal.read_bytes().startswith(b"ros1_master_guard")

    def test_it_goes_on_when_nobody_reads_what_it_says(self, graph: Graph) -> None:
        with subprocess.Popen(
            (*GUARD, "--no-rosout"),
            env=graph.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as guard:
            assert guard.stdout is not None
            assert guard.stderr is not None
            guard.stdout.close()
            guard.stderr.close()
            wait_for(graph.master_pid)
            graph.run("rosparam", "set", "/speed", "1")
            replaced(graph, graph.kill_master())
            assert graph.run("rosparam", "get", "/speed") == "1\n"
            guard.terminate()
            assert guard.wait(PATIENCE_S) == 0

    def test_the_spare_ends_quietly(self, graph: Graph) -> None:
        guard = graph.guard("--no-rosout")
        spares: list[int] = []

        def has_spare() -> bool:
            children = Path(f"/proc/{guard.process.pid}/task/{guard.process.pid}/children")
            spares[:] = {int(pid) for pid in children.read_text().split()} - {graph.master_pid()}
            return bool(spares)

        wait_for(has_spare)
        time.sleep(1.0)  # it says that it is warm, which the guard does not read
        pid = graph.master_pid()
        guard.end()
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: not any(map(alive, spares)))
        assert "Traceback" not in guard.errors

    def test_the_guard_is_killed(self, graph: Graph) -> None:
        guard = graph.guard()
        caller, listener = start_everything(graph)
        before, pid = settled(graph), graph.master_pid()
        guard.end()
        assert graph.master_pid() == pid
        keeps_on(caller)
        second = graph.guard()
        assert '"master":"found"' in second.lines[0]
        for _ in range(2):
            replaced(graph, graph.kill_master())
            assert graph.listed() == before
        keeps_on(caller)
        keeps_on(listener)

    def test_the_guard_that_comes_after_ends_what_it_found(self, graph: Graph) -> None:
        guard = graph.guard()
        wait_for(lambda: "/rosout" in graph.registered()["nodes"])
        rosout = graph.rosout_pid()
        pid = graph.master_pid()
        guard.end()
        second = graph.guard()
        assert graph.master_pid() == pid
        assert graph.rosout_pid() == rosout
        assert second.end(signal.SIGTERM) == 0
        wait_for(lambda: not alive(pid))
        wait_for(lambda: not alive(rosout))

    def test_guard_and_master_are_killed(self, graph: Graph) -> None:
        guard = graph.guard()
        caller, _ = start_everything(graph)
        before = settled(graph)
        pid = graph.master_pid()
        guard.end()
        os.kill(pid, signal.SIGKILL)
        second = graph.guard()
        assert '"master":"resumed"' in second.lines[0]
        assert graph.listed() == before
        keeps_on(caller)

    def test_ended_in_order_it_begins_anew_without_nodes(self, graph: Graph) -> None:
        guard = graph.guard()
        wait_for(lambda: "/rosout" in graph.registered()["nodes"])
        graph.run("rosparam", "set", "/use_sim_time", "true")
        pid = graph.master_pid()
        assert guard.end(signal.SIGTERM) == 0
        assert not alive(pid)
        # Yesterday's simulated time is not today's.
        second = graph.guard("--no-rosout")
        assert '"master":"started"' in second.lines[0]
        assert "/use_sim_time" not in graph.run("rosparam", "list")
        assert second.end(signal.SIGINT) == 130

    def test_both_are_killed_and_so_are_the_nodes(self, graph: Graph) -> None:
        guard = graph.guard()
        server = graph.node("server", "/server", "/work")
        wait_for(lambda: server.lines and "/rosout" in graph.registered()["nodes"])
        graph.run("rosparam", "set", "/use_sim_time", "true")
        rosout, pid = graph.rosout_pid(), graph.master_pid()
        for process in (guard, server):
            process.end()
        os.kill(pid, signal.SIGKILL)
        second = graph.guard()
        assert '"master":"started"' in second.lines[0]
        registered = graph.registered()
        assert "use_sim_time" not in registered["parameters"]
        assert registered["nodes"].keys() == {"/rosout"}
        assert graph.rosout_pid() == rosout

    @pytest.mark.slow
    def test_roslaunch(self, graph: Graph) -> None:
        graph.guard()
        (graph.directory / "one.launch").write_text(
            '<launch><param name="p" value="3"/>'
            '<node pkg="rosout" type="rosout" name="launched"/></launch>'
        )
        launch = graph.start("roslaunch", str(graph.directory / "one.launch"))
        wait_for(lambda: "/launched" in graph.registered()["nodes"], launch.account)
        before = settled(graph)
        replaced(graph, graph.kill_master())
        assert graph.listed() == before
        assert launch.process.poll() is None
        assert launch.end(signal.SIGINT) == 0
        assert "/launched" not in graph.registered()["nodes"]

    def test_a_second_guard_is_refused(self, graph: Graph) -> None:
        guard = graph.guard("--no-rosout")
        second = graph.start(
            *(str(word) for word in guard.process.args),  # type: ignore[union-attr]
            name="second",
        )
        assert second.process.wait(PATIENCE_S) == 2
        assert f"has a guard already: process {guard.process.pid}" in second.errors


class TestAMasterOfOthers:
    def test_rosmaster(self, graph: Graph) -> None:
        graph.start("rosmaster", "--core", "-p", str(graph.port))
        wait_for(graph.master_pid)
        guard = graph.guard()
        assert '"master":"found"' in guard.lines[0]
        caller, listener = start_everything(graph)
        settled(graph)
        known_to_guard(graph)
        before = graph.listed()
        for _ in range(3):
            replaced(graph, graph.kill_master())
            assert graph.listed() == before
            graph.newcomer("/relayed", "/more_work")
        keeps_on(caller)
        keeps_on(listener)

    def test_it_is_guarded_once_the_guard_says_so(self, graph: Graph) -> None:
        graph.start("rosmaster", "--core", "-p", str(graph.port))
        wait_for(graph.master_pid)
        server = graph.node("server", "/server", "/work")
        wait_for(lambda: server.lines)
        graph.guard("--no-rosout")
        replaced(graph, graph.kill_master())
        assert "/work" in graph.registered()["services"]

    def test_what_cannot_be_written_down_is_known_to_the_next_one(self, graph: Graph) -> None:
        graph.start("rosmaster", "--core", "-p", str(graph.port))
        wait_for(graph.master_pid)
        guard = graph.guard("--no-rosout")
        wait_for(graph.journal.exists)  # it is written next when something has changed
        (unusable := graph.journal.with_name(f"{graph.journal.name}.new")).mkdir()
        graph.run("rosparam", "set", "/speed", "1")
        wait_for(lambda: graph.events(guard, "journal_failed"))
        time.sleep(1.0)
        assert len(graph.events(guard, "journal_failed")) == 1
        replaced(graph, graph.kill_master())
        assert graph.registered()["parameters"]["speed"] == 1
        unusable.rmdir()
        wait_for(lambda: graph.events(guard, "journal_written"))
        assert b"speed" in graph.journal.read_bytes()

    def test_roscore(self, graph: Graph) -> None:
        roscore = graph.start("roscore", "-p", str(graph.port))
        wait_for(lambda: "/rosout" in graph.registered()["nodes"], roscore.account)
        guard = graph.guard()
        server = graph.node("server", "/server", "/work")
        wait_for(lambda: server.lines)
        known_to_guard(graph)
        run_id = graph.run("rosparam", "get", "/run_id")
        graph.kill_master()
        # It takes the master's death for the end of everything, but what is not its goes on.
        roscore.process.wait(PATIENCE_S)
        wait_for(lambda: "/rosout" in graph.registered()["nodes"], guard.account)
        assert "/work" in graph.registered()["services"]
        assert graph.run("rosparam", "get", "/run_id") == run_id
        graph.run("rosservice", "call", "/work")


GUARDED_AS_STOCK = """
import copy, logging, random, socket, sys
logging.disable()
import importlib.util, rosmaster.master_api
spec = importlib.util.spec_from_file_location("master_process", sys.argv[1])
master_process = sys.modules["master_process"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(master_process)
make, make_again = master_process._load(), master_process._load()
stock, ours = rosmaster.master_api.ROSMasterHandler(1), make(master_process.MasterState())
draw = random.Random(int(sys.argv[2]))

guard, its = socket.socketpair()
ours.add_guard(its)
stream, known = guard.makefile("rb"), None

def told():
    # What the master has told its guard until now.
    global known
    its.sendall(master_process.encoded(None))
    while True:
        message = master_process.decoded(stream.read(*master_process.HEAD.unpack(stream.read(8))))
        if message is None:
            return copy.deepcopy(known)
        if known is None:
            known = master_process.MasterState(**message)
        else:
            known.apply(*message)

def apis(handler):
    tables = [handler.publishers, handler.subscribers, handler.param_subscribers]
    return (
        [{key: sorted(table.map[key]) for key in table.map} for table in tables],
        handler.services.map,
        {key: handler.services.get_service_api(key) for key in handler.services.map},
        handler.getTopicTypes("/x"),
        handler.getParam("/x", "/"),
        {name: handler.lookupNode("/x", name)[2] for name in nodes
         if any(name in (who for who, _ in where) for table in tables + [handler.services]
                for where in table.map.values())},
    )

nodes = ["/a", "/b", "/ns/c"]
keys = ["/p", "/p/q", "/p/q/r", "rel", "~own", "/s", "/p/q/"]
values = [1, 2.5, "x", True, [1, 2], {"k": {"l": 1}}, {}, {"q": 3}]
for step in range(600):
    node = draw.choice(nodes)
    api = "http://127.0.0.1:%d/" % draw.choice([1, 1, 1, 2])
    topic, service = draw.choice(["/t", "u", "/v"]), draw.choice(["/e", "f"])
    call = draw.choice([
        ("registerPublisher", topic, draw.choice(["p/A", "p/B", "*"]), api),
        ("unregisterPublisher", topic, api),
        ("registerSubscriber", topic, draw.choice(["p/A", "*"]), api),
        ("unregisterSubscriber", topic, api),
        ("registerService", service, "rosrpc://127.0.0.1:%d" % draw.choice([3, 4]), api),
        ("unregisterService", service, "rosrpc://127.0.0.1:%d" % draw.choice([3, 4])),
        ("subscribeParam", api, draw.choice(keys)),
        ("unsubscribeParam", api, draw.choice(keys)),
        ("setParam", draw.choice(keys), draw.choice(values)),
        ("deleteParam", draw.choice(keys)),
        ("setParam", "/", {"p": draw.choice(values)}) if not step % 50 else ("getPid",),
    ])
    for handler in (stock, ours):
        name, *arguments = copy.deepcopy(call)
        answer = getattr(handler, name)(node, *arguments)
        if handler is stock:
            expected = answer
    assert answer[::2] == expected[::2], (call, answer, expected)
    if not step % 20:
        # Another one, from what was told.
        again = make_again(told())
        assert apis(again) == apis(ours) == apis(stock), (step, call, apis(again), apis(stock))
        assert [sorted(map(str, table)) for table in again.getSystemState("/x")[2]] == [
            sorted(map(str, table)) for table in stock.getSystemState("/x")[2]]
        again._shutdown()
print("the same")
import os
sys.stdout.flush()
os._exit(0)
"""


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_it_is_the_stock_master(seed: int, graph: Graph) -> None:
    from ros1_master_guard import process as master_process

    script = str(Path(str(master_process.__file__)))
    said = graph.run(SYSTEM_PYTHON, "-c", GUARDED_AS_STOCK, script, str(seed))
    assert said.splitlines()[-1] == "the same"


class TestWhatCannotBeGuarded:
    def test_what_is_no_master(self, graph: Graph) -> None:
        server = graph.start(
            *(sys.executable, "-m", "http.server", "--bind", "127.0.0.1", str(graph.port))
        )

        def listens() -> bool:
            with socket.create_connection(("127.0.0.1", graph.port)):
                return True

        wait_for(listens)
        guard = graph.start(*GUARD)
        assert guard.process.wait(PATIENCE_S) == 2
        assert "what is there is no ROS 1 master" in guard.errors
        assert server.process.poll() is None
