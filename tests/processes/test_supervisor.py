"""``serve --processes``: several processes behind one address, of which any may die at any time."""

import itertools
import json
import os
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families
from tests.ports import free_port
from tests.processes import faults
from tests.processes.world import World

PATIENCE_S = 120.0
PEG = "peg_in_hole_2d"

# Its import ends the process if a file says so.
MORTAL = """
import os
from pathlib import Path

from holdfast.problems.capsule_robot import CapsuleRobot

if Path("die").exists():
    os._exit(3)


class Mortal(CapsuleRobot):
    name = "mortal"
"""


def several(
    site: faults.Site,
    *options: str,
    endpoint: str | None = None,
    variables: dict[str, str] | None = None,
) -> faults.Service:
    """Return a service of two processes that tells how it is."""
    address = f"127.0.0.1:{free_port()}"
    service = site.service(
        *("--processes", "2", "--health", address, "--metrics", address),
        *options,
        endpoint=endpoint,
    )
    service.variables = variables or {}
    return service.start()


def health_of(service: faults.Service, path: str) -> tuple[int, str]:
    (ready,) = service.process.matching("ready")
    return faults.page(ready["health"], path)


def metrics(service: faults.Service) -> dict[str, float]:
    """Return all counts, each kind of a metric by itself."""
    status, text = health_of(service, "/metrics")
    assert status == 200
    return {
        f"{sample.name}{sorted(sample.labels.items())}": sample.value
        for family in text_string_to_metric_families(text)
        if family.type in ("counter", "histogram")
        for sample in family.samples
    }


def children(service: faults.Service) -> list[int]:
    pid = service.process.pid
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def started_again(service: faults.Service, count: int) -> Callable[[], object]:
    return lambda: service.process.wait_for("process_started", count)


class TestRobots:
    @pytest.mark.parametrize(
        "protocol",
        # It has a stream and datagrams, and TLS; unit/test_service_listening.py has all sockets.
        ["udp", *(pytest.param(each, marks=pytest.mark.slow) for each in ("tcp", "tls", "unix"))],
    )
    def test_processes_are_killed_under_them(
        self, protocol: str, site: faults.Site, keys: Path, references: faults.References
    ) -> None:
        """Their runs decide the same; nothing but time is lost, and nothing is forgotten."""
        place = site.directory / "socket" if protocol == "unix" else f"127.0.0.1:{free_port()}"
        credentials = {
            end: ("--tls", str(keys / "ours" / end)) if protocol in ("tls", "udp") else ()
            for end in ("robot", "service")
        }
        cloud = several(site, *credentials["service"], endpoint=f"{protocol}/{place}")
        document = faults.document_of(PEG)
        told: list[dict[str, float]] = []

        def kill(index: int) -> None:
            told.append(metrics(cloud))
            os.kill(children(cloud)[index], signal.SIGKILL)
            told.append(metrics(cloud))

        worlds: list[World] = []
        robots = []
        for number in range(4):
            world, file = site.world(
                document, f"robot-{number}", offload=faults.PATIENT, recovery={"launch": "never"}
            )
            worlds.append(world)
            if number == 0:
                world.on("perform", 20, faults.in_order(lambda: kill(0), started_again(cloud, 1)))
                world.on("sense", 36, faults.in_order(lambda: kill(1), started_again(cloud, 2)))
                world.on("perform", 50, faults.in_order(lambda: kill(0), lambda: kill(-1)))
            robots.append(
                site.run(file, *credentials["robot"], services=[cloud], out=f"out-{number}")
            )
        for robot, world in zip(robots, worlds, strict=True):
            robot.finish()
            world.check()
            faults.assert_identical(robot.out, references(document))
            world.assert_each_once(references(document))
            assert not [each for each in faults.events_of(robot.out) if each["event"] == "launch"]
        decisions = "holdfast_decisions_total[('kind', 'sensing')]"
        # The processes that the last robots have met report every second.
        faults.wait_until(lambda: metrics(cloud)[decisions] > 0, "the decisions to be told")
        told.append(metrics(cloud))
        for before, after in itertools.pairwise(told):
            for name, value in before.items():
                assert after[name] >= value, name
        assert (
            told[-1][decisions] == told[-1]["holdfast_decision_seconds_count[('kind', 'sensing')]"]
        )
        assert told[-1]["holdfast_process_restarts_total[]"] == 4
        assert len(cloud.process.matching("process_ended")) == 4
        assert len(cloud.process.matching("ready")) == 1


class TestEnding:
    @pytest.mark.parametrize(
        ("number", "code"),
        [
            (signal.SIGTERM, 0),
            # As test_service_process.py has them of one process, by the same handlers.
            pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
            pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
        ],
    )
    def test_in_order(self, site: faults.Site, number: signal.Signals, code: int) -> None:
        cloud = several(site)
        pids = children(cloud)
        assert len(pids) == 2
        cloud.process.signal(number)
        assert cloud.process.wait() == code, cloud.process.account()
        for pid in pids:
            faults.wait_for_end(pid)
        (stopping,) = cloud.process.matching("stopping")
        assert stopping["reason"] == number.name
        assert "Traceback" not in cloud.process.output
        with socket.socket() as again:
            host, _, port = cloud.endpoint.removeprefix("tcp/").rpartition(":")
            again.bind((host, int(port)))

    def test_processes_end_with_the_supervisor(self, site: faults.Site) -> None:
        cloud = several(site)
        pids = children(cloud)
        cloud.kill()
        for pid in pids:
            faults.wait_for_end(pid)

    def test_a_second_signal_ends_at_once(self, site: faults.Site) -> None:
        """A process that stands still cannot end in order, and would be waited for."""
        cloud = several(site)
        pids = children(cloud)
        os.kill(pids[0], signal.SIGSTOP)
        cloud.process.signal(signal.SIGTERM)
        cloud.process.wait_for("stopping")
        cloud.process.signal(signal.SIGTERM)
        cloud.process.wait()
        for pid in pids:
            faults.wait_for_end(pid)


class TestHealth:
    def test_a_process_that_cannot_be_started_again(self, site: faults.Site) -> None:
        """Each time it is started a little later; as soon as it can serve, it does."""
        (site.directory / "mortal_problem.py").write_text(MORTAL)
        options = ("--problem", "mortal_problem:Mortal", "--problem-directory", str(site.directory))
        cloud = several(site, *options)
        (site.directory / "die").touch()
        first, second = children(cloud)
        os.kill(first, signal.SIGKILL)
        ended = cloud.process.wait_for("process_ended", 4)
        assert ended["reason"] == "ended with exit code 3"
        delays = [each["again_in_s"] for each in cloud.process.matching("process_ended")]
        assert delays == sorted(delays)
        assert delays[0] == 0.0 < delays[-1]
        # The other one serves.
        assert health_of(cloud, "/readyz") == (200, "ok\n")
        os.kill(second, signal.SIGKILL)
        cloud.process.wait_for("process_ended", 1, pid=second)
        assert health_of(cloud, "/readyz") == (503, "starting\n")
        assert health_of(cloud, "/livez") == (200, "ok\n")
        (site.directory / "die").unlink()
        cloud.process.wait_for("process_started", 2)
        assert health_of(cloud, "/readyz") == (200, "ok\n")


class TestRefusing:
    def refused(self, site: faults.Site, *options: str) -> str:
        """Return the one line with which a service of several processes is not started."""
        ended = site.process(
            *site.service().command, "serve", "--processes", "2", "--log", "json", *options
        )
        assert ended.wait() == 2, ended.account()
        assert not ended.matching("ready")
        (error,) = ended.events
        assert error.name == "error"
        return json.dumps(dict(error.fields))

    def test_an_address_that_is_taken(self, site: faults.Site) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", free_port()))
            taken.listen()
            endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
            assert endpoint in self.refused(site, "--listen", endpoint)
            address = endpoint.removeprefix("tcp/")
            anywhere = ("--listen", f"tcp/127.0.0.1:{free_port()}")
            assert address in self.refused(site, *anywhere, "--health", address)
