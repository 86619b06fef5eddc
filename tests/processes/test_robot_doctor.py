"""``holdfast doctor``: each layer that can fail, really failing, and what is said of it."""

import asyncio
import contextlib
import functools
import json
import shutil
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TypeAlias, get_args

import pytest
from tests.command_line import run_here
from tests.ports import free_port
from tests.processes import lying_problem, test_other_code
from tests.processes.faults import HERE, PATIENT, Service, Site, document_of
from tests.unit.test_transport_credentials import sign_with_names
from tests.wire import CALL, LAST, frame_of, hello_of

from holdfast.cli.doctor import _as_text
from holdfast.planning.settings import OffloadSettings
from holdfast.protocol.messages import NeedState, Refused, Reply, decode_request, encode
from holdfast.robot.doctor import Examination, LayerFinding, State
from holdfast.transport.endpoints import parse_endpoint
from holdfast.transport.frames import FrameDecoder
from holdfast.transport.key_ring import make_credentials, revoke_credentials
from holdfast_lab.testbed.namespace import NetworkNamespace, why_no_namespace

PEG = document_of("peg_in_hole_2d", max_steps=40)
PLAIN = ["name", "route", "port", "tls", "protocol", "clock", "problem", "round trip"]
SECURE = [*PLAIN[:4], "certificate", *PLAIN[4:]]
LAYERS = {
    "tcp": PLAIN,
    "tls": SECURE,
    "udp": [*SECURE[:6], "datagrams", *SECURE[6:]],
    "unix": [PLAIN[0], *PLAIN[2:]],
}

Answer: TypeAlias = Callable[[socket.socket], None]


@dataclass
class Seen:
    """What the command has said of one service."""

    code: int
    findings: list[dict[str, str]]

    def __getitem__(self, layer: str) -> dict[str, str]:
        (found,) = [each for each in self.findings if each["layer"] == layer]
        return found

    @property
    def states(self) -> dict[str, str]:
        return {each["layer"]: each["state"] for each in self.findings}


Look: TypeAlias = Callable[..., Seen]


def seen_in(endpoint: str, code: int, output: str) -> Seen:
    try:
        findings = [json.loads(line) for line in output.splitlines()]
    except json.JSONDecodeError:
        raise AssertionError(output) from None
    assert {each["service"] for each in findings} == {endpoint}
    assert code == (1 if "fails" in {each["state"] for each in findings} else 0)
    return Seen(code, findings)


@pytest.fixture
def look(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Look:
    """Return a function that looks at a service."""

    def look_at(endpoint: str, *options: str | Path) -> Seen:
        words = ("--json", "--service", endpoint, *map(str, options))
        said = run_here(capsys, tmp_path, "doctor", *words)
        return seen_in(endpoint, said.code, said.stdout)

    return look_at


def look_from(network: NetworkNamespace, site: Site, endpoint: str, *options: str | Path) -> Seen:
    """Look at a service from a network, in a process of its own."""
    command = (*network.prefix, sys.executable, "-m", "holdfast", "doctor", "--json")
    process = site.process(*command, "--service", endpoint, *map(str, options))
    return seen_in(endpoint, process.wait(), process.output)


def assert_fails(seen: Seen, layer: str, what: str, to_do: str = "") -> None:
    """Check that this layer fails, those below work, and those above were not reached.

    Between the parts of ``what`` that are divided by dots anything may be said.
    """
    assert seen.code == 1
    found = seen[layer]
    assert found["state"] == "fails", seen.findings
    for part in what.split(" ... "):
        assert part in found["seen"], found
    assert to_do in found["advice"], found
    names = [each["layer"] for each in seen.findings]
    below, above = names[: names.index(layer)], names[names.index(layer) + 1 :]
    assert {seen.states[each] for each in below} <= {"ok", "warns"}, seen.findings
    assert {seen.states[each] for each in above} <= {"-"}, seen.findings


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return credentials of all sorts; beside them, copies from before a revocation."""
    home = tmp_path_factory.mktemp("home") / "keys"
    now = datetime.now(UTC)
    make_credentials(home, robots=["anna"], services=["cloud"], now=now - timedelta(days=30))
    for days, name in ((3, "old"), (-3, "early")):
        moment = now - timedelta(days=days)
        make_credentials(home, robots=[name], services=[f"{name}-cloud"], days=2, now=moment)
    make_credentials(home, robots=["soon"], services=["soon-cloud"], days=5)
    sign_with_names(home, "cloud", "two-names", ["two-names", "two"])
    make_credentials(home, robots=["thief"], services=["thief-cloud"])
    for name in ("thief", "thief-cloud"):
        shutil.copytree(home / name, home.with_name(name))
    revoke_credentials(home, names=["thief", "thief-cloud"])
    make_credentials(home.with_name("other"), robots=["anna"], services=["cloud"])
    return home


def service_of(
    site: Site, protocol: str, credentials: Path | None = None, host: str = "127.0.0.1"
) -> Service:
    options = () if credentials is None else ("--tls", str(credentials))
    return site.service(*options, endpoint=f"{protocol}/{host}:{free_port(host)}").start()


@pytest.fixture(scope="module")
def services(home: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., str]]:
    """Return what gives the endpoint of a service, which each of its kind has."""
    with Site(tmp_path_factory.mktemp("services")) as site:

        @functools.cache
        def endpoint_of(protocol: str, keys: str | None, host: str = "127.0.0.1") -> str:
            return service_of(
                site, protocol, None if keys is None else home.parent / keys, host
            ).endpoint

        yield endpoint_of


@contextlib.contextmanager
def answering(answer: Answer) -> Iterator[int]:
    """Take connections, and do something with each; return the port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    taken, _ = listener.accept()
                    threading.Thread(target=handle, args=(taken,), daemon=True).start()

        def handle(taken: socket.socket) -> None:
            with taken, contextlib.suppress(OSError):
                answer(taken)

        threading.Thread(target=accept, daemon=True).start()
        yield listener.getsockname()[1]


def says(data: bytes) -> Answer:
    """Return what says something to whoever comes, and listens once."""

    def answer(taken: socket.socket) -> None:
        taken.sendall(data)
        taken.recv(1000)

    return answer


def plays_service(
    *,
    clock_s: float = 0.0,
    delay_s: float = 0.0,
    reply: Callable[[int], Reply] = lambda number: NeedState(number, False),
) -> Answer:
    """Return what says that nothing is known of any run, as a service does, or something else."""

    def answer(taken: socket.socket) -> None:
        taken.sendall(hello_of("service", "cloud", clock_s=time.time() + clock_s))
        decoder = FrameDecoder(1 << 20)
        while data := taken.recv(65536):
            for frame in decoder.feed(data):
                if frame.kind == CALL:
                    time.sleep(delay_s)  # the way is long
                    number = decode_request(frame.payload).number
                    taken.sendall(frame_of(LAST, frame.call, encode(reply(number))))

    return answer


class TestAllIsWell:
    @pytest.mark.parametrize("protocol", ["tls", "udp", "unix"])
    def test_with_a_configuration(self, protocol: str, home: Path, site: Site, look: Look) -> None:
        options: tuple[str | Path, ...] = ()
        if protocol == "unix":
            cloud = site.service(endpoint=f"unix/{site.directory / 's'}").start()
        else:
            cloud = service_of(site, protocol, home / "cloud")
            options = ("--tls", home / "anna")
        seen = look(cloud.endpoint, *options, site.configure(PEG, offload=PATIENT))
        assert [each["layer"] for each in seen.findings] == LAYERS[protocol]
        assert set(seen.states.values()) == {"ok"}, seen.findings
        assert "2 decisions are the robot's own, bit for bit" in seen["problem"]["seen"]
        assert seen["clock"]["seen"].endswith("from the service's")
        if protocol in ("tls", "udp"):
            assert seen["certificate"]["seen"].startswith("ours: anna, until ")
            assert "; theirs: cloud, until " in seen["certificate"]["seen"]
        assert not cloud.process.matching("link_refused")

    def test_without_one_and_for_people(self, site: Site, services: Callable[..., str]) -> None:
        endpoint = services("tcp", None)
        done = site.holdfast("doctor", "--service", endpoint)
        assert done.process.returncode == 0
        lines = done.output.splitlines()
        assert lines[0] == endpoint
        assert "  name         ok     127.0.0.1 is an address" in lines
        assert "  problem      -      not asked: with CONFIG, decisions are compared" in lines
        assert len(lines) > len(PLAIN)

    def test_services_and_credentials_of_the_configuration(
        self, home: Path, site: Site, services: Callable[..., str]
    ) -> None:
        nobody = f"tls/127.0.0.1:{free_port()}"
        offload = {"services": [services("tls", "keys/cloud"), nobody], "tls": str(home / "anna")}
        done = site.holdfast("doctor", "--json", site.configure(PEG, offload=offload))
        assert done.process.returncode == 1
        found = [json.loads(line) for line in done.output.splitlines()]
        fails = [each for each in found if each["state"] == "fails"]
        assert [(each["service"], each["layer"]) for each in fails] == [(nobody, "port")]


class TestTheWay:
    def test_a_name_that_is_not_found(self, look: Look) -> None:
        seen = look("tcp/nobody.invalid:7447")
        assert_fails(seen, "name", "nobody.invalid is not found", "is it spelled right")

    def test_a_socket_that_is_not_there(self, tmp_path: Path, look: Look) -> None:
        assert_fails(look(f"unix/{tmp_path / 's'}"), "name", "is not there")

    @pytest.mark.parametrize(("protocol", "more"), [("tcp", ""), ("tls", " --tls KEYS/service; ")])
    def test_a_port_at_which_nothing_listens(
        self, protocol: str, more: str, site: Site, look: Look
    ) -> None:
        endpoint = f"{protocol}/127.0.0.1:{free_port()}"
        assert_fails(look(endpoint), "port", "refused", f"holdfast serve --listen {endpoint}{more}")
        name = f"room_over_{protocol}:LightDarkRoom"
        shutil.copy(test_other_code.EXAMPLE, site.directory / f"room_over_{protocol}.py")
        seen = look(endpoint, site.configure({**test_other_code.DOCUMENT, "problem": name}))
        assert f"--listen {endpoint} --problem {name}{more}" in seen["port"]["advice"]

    def test_a_port_that_does_not_answer(self, look: Look) -> None:
        with contextlib.ExitStack() as stack:
            full = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
            for _ in range(4):
                waiting = stack.enter_context(socket.socket())
                waiting.setblocking(False)
                waiting.connect_ex(full.getsockname())
            seen = look(f"tcp/127.0.0.1:{full.getsockname()[1]}")
        assert_fails(seen, "port", "nothing answers", "firewall")

    def test_a_network_without_a_way(self, site: Site) -> None:
        with own_network() as network:
            seen = look_from(network, site, "tcp/192.0.2.7:7447")
        assert_fails(seen, "route", "network is unreachable", "VPN")

    def test_datagrams_that_do_not_get_through(self, home: Path, site: Site) -> None:
        with own_network() as network:
            rules = "add table inet t; add chain inet t c {type filter hook input priority 0;}; "
            rules += "add rule inet t c meta l4proto udp drop"
            subprocess.run([*network.prefix, "nft", rules], check=True)
            cloud = site.service(
                *("--tls", str(home / "cloud")), endpoint=f"udp/127.0.0.1:{free_port()}"
            )
            cloud.command = (*network.prefix, *cloud.command)
            cloud.start()
            options = ("--tls", home / "anna", site.configure(PEG, offload=PATIENT))
            lo = ["ip", "link", "set", "lo", "mtu", "1240"]
            subprocess.run([*network.prefix, *lo], check=True)
            seen = look_from(network, site, cloud.endpoint, *options)
        assert seen["route"]["state"] == "warns"
        assert "(lo, MTU 1240)" in seen["route"]["seen"]
        assert "up to 1248 bytes" in seen["route"]["advice"]
        assert seen["datagrams"]["state"] == "fails"
        assert "none gets through" in seen["datagrams"]["seen"]
        assert cloud.endpoint.rpartition(":")[2] in seen["datagrams"]["advice"]
        # Over the stream all the rest works.
        rest = {k: state for k, state in seen.states.items() if k not in ("route", "datagrams")}
        assert set(rest.values()) == {"ok"}


@contextlib.contextmanager
def own_network() -> Iterator[NetworkNamespace]:
    reason = why_no_namespace()
    if reason is not None:
        pytest.skip(reason)
    with NetworkNamespace() as network:
        yield network


@pytest.mark.parametrize("state", get_args(State))
def test_each_state_on_a_terminal(state: State, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    text = _as_text(LayerFinding("clock", state, "it is late", "sleep", "::1"))
    first, second = text.splitlines()
    assert f"m {state:<6} \x1b[0m::1: it is late" in first
    assert second.strip() == "-> sleep"


def test_a_host_with_two_addresses(
    home: Path, services: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of them is a way to the service, and that is enough."""
    port = int(services("tls", "keys/cloud").rpartition(":")[2])
    tcp = (socket.AF_INET, socket.SOCK_STREAM, 6, "")
    found = [(*tcp, (address, port)) for address in ("127.0.0.2", "127.0.0.1")]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    offload = OffloadSettings(detection_timeout_ms=30_000.0, tls=str(home / "anna"))
    seen: list[LayerFinding] = []
    endpoint = parse_endpoint(f"tls/localhost:{port}")
    asyncio.run(Examination(endpoint, offload, None, seen.append).run())
    states = {(each.layer, each.address): each.state for each in seen}
    assert seen[0].seen == "localhost is 127.0.0.2, 127.0.0.1"
    assert states["port", "127.0.0.1"] == "ok"
    assert states["port", "127.0.0.2"] == "fails"
    assert [layer for layer, address in states if address == "127.0.0.2"] == ["route", "port"]
    assert states["round trip", "127.0.0.1"] == "ok"


HTTP = b"HTTP/1.1 400 Bad Request\r\n\r\n"
OF_ANOTHER_RELEASE = hello_of("service", "cloud", version=2, release="9.9.9")
REFUSES = plays_service(reply=lambda number: Refused(number, "version", "speaks version 9"))


@pytest.mark.parametrize(
    ("protocol", "answer", "layer", "what", "to_do"),
    [
        ("tcp", says(HTTP), "protocol", "speaks HTTP", "another program"),
        ("tls", says(HTTP), "tls", "does not speak TLS", "another program"),
        (
            *("tcp", says(OF_ANOTHER_RELEASE), "protocol"),
            "is holdfast 9.9.9 with version 2 of the wire ... install the same release at both",
            "",
        ),
        ("tcp", REFUSES, "protocol", "version: speaks version 9", "same release at both ends"),
    ],
    ids=["a web server", "one without TLS", "another wire", "other messages"],
)
def test_what_listens_is_no_service_of_this_release(
    protocol: str, answer: Answer, layer: str, what: str, to_do: str, home: Path, look: Look
) -> None:
    options = () if protocol == "tcp" else ("--tls", home / "anna")
    with answering(answer) as port:
        assert_fails(look(f"{protocol}/127.0.0.1:{port}", *options), layer, what, to_do)


def test_a_process_that_stands_still(home: Path, site: Site, look: Look) -> None:
    cloud = service_of(site, "tls", home / "cloud")
    cloud.stop()
    seen = look(cloud.endpoint, "--tls", home / "anna")
    assert_fails(seen, "tls", "takes connections and says nothing", "stopped")


def test_a_clock_that_is_wrong(look: Look) -> None:
    with answering(plays_service(clock_s=-3600.0)) as port:
        seen = look(f"tcp/127.0.0.1:{port}")
    assert seen.code == 0
    assert seen["clock"]["state"] == "warns"
    assert seen["clock"]["seen"].startswith("3600 s ahead of the service's")
    assert seen["round trip"]["seen"].startswith("20 echoes")


def test_limits_that_are_short_for_the_way(site: Site, look: Look) -> None:
    file = site.configure(PEG, offload={"detection_timeout_ms": 40.0})
    with answering(plays_service(delay_s=0.03)) as port:
        seen = look(f"tcp/127.0.0.1:{port}", file)
    assert seen["round trip"]["state"] == "warns"
    advice = seen["round trip"]["advice"]
    assert "offload.detection_timeout_ms, 40, is short for this way: take " in advice
    # Nor does it come to the state of a run that it has been told of.
    assert "comes to another state" in seen["problem"]["seen"]


class TestCertificates:
    @pytest.mark.parametrize(
        ("service", "protocol", "robot", "layer", "what", "to_do"),
        [
            (
                *(("tcp", None), "tls", "keys/anna", "tls"),
                *("closes connections at the first bytes of TLS", "tcp/..."),
            ),
            (
                *(("tls", "keys/cloud"), "tcp", None, "protocol"),
                *("refuses this end, which does not speak TLS; as at that end", ""),
            ),
            *(
                (("tls", "keys/cloud"), "tls", robot, "certificate", what, to_do)
                for robot, what, to_do in (
                    (None, "ours: none was given", "--tls KEYS/robot"),
                    ("keys/old", "certificate.pem: has expired (valid from ", ""),
                    ("keys/early", "certificate.pem: is not valid yet; is a clock wrong?", ""),
                    ("keys/thief", "certificate.pem: has been revoked", ""),
                    ("thief", "ours: thief, until", ""),
                    ("other/anna", "theirs: was not signed by", "shown is cloud"),
                )
            ),
            # The robot has the list of those that are revoked.
            *(
                (("udp", *service), "udp", "keys/anna", "certificate", what, "shown is ")
                for service, what in (
                    (("keys/cloud", "127.0.0.2"), "theirs: does not name this host"),
                    (("thief-cloud",), "theirs: has been revoked"),
                )
            ),
        ],
    )
    def test_two_ends_that_do_not_believe_each_other(
        self,
        service: tuple[str, ...],
        protocol: str,
        robot: str | None,
        layer: str,
        what: str,
        to_do: str,
        home: Path,
        services: Callable[..., str],
        look: Look,
    ) -> None:
        place = services(*service).partition("/")[2]
        options = () if robot is None else ("--tls", home.parent / robot)
        seen = look(f"{protocol}/{place}", *options)
        assert_fails(seen, layer, what, to_do)
        if robot == "thief":
            assert "refuses this end, which has a certificate that has been" in str(seen.findings)

    @pytest.mark.parametrize(
        ("service", "what"),
        [
            ("old-cloud", "has expired; 'holdfast keys DIR --renew --service NAME' makes another"),
            ("two-names", "theirs: has 2 common names, and must have one"),
        ],
    )
    def test_a_service_with_a_faulty_certificate(
        self, service: str, what: str, home: Path, look: Look
    ) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(home / service / "certificate.pem", home / service / "key.pem")

        def answer(taken: socket.socket) -> None:
            with context.wrap_socket(taken, server_side=True) as tls:
                tls.recv(1000)

        with answering(answer) as port:
            seen = look(f"tls/127.0.0.1:{port}", "--tls", home / "anna")
        assert_fails(seen, "certificate", what, f"shown is {service} ")
        assert "; it is 20" in seen["clock"]["seen"]

    def test_another_robot_s_name(
        self, home: Path, site: Site, services: Callable[..., str], look: Look
    ) -> None:
        file = site.configure(PEG, offload={"name": "berta"})
        seen = look(services("tls", "keys/cloud"), "--tls", home / "anna", file)
        what = "says that it is berta, and shows the certificate of anna"
        assert_fails(seen, "certificate", what)

    def test_what_ends_soon(self, home: Path, services: Callable[..., str], look: Look) -> None:
        seen = look(services("tls", "keys/soon-cloud"), "--tls", home / "soon")
        assert seen.code == 0
        assert seen["certificate"]["state"] == "warns"
        assert "expires in 5.0 days" in seen["certificate"]["advice"]
        assert "--renew --service soon-cloud" in seen["certificate"]["advice"]

    def test_a_key_that_others_can_read(
        self, home: Path, tmp_path: Path, services: Callable[..., str], look: Look
    ) -> None:
        shutil.copytree(home / "anna", tmp_path / "open")
        (tmp_path / "open" / "key.pem").chmod(0o644)
        seen = look(services("tls", "keys/cloud"), "--tls", tmp_path / "open")
        assert seen["certificate"]["state"] == "warns"
        assert "others can read this key (mode 644); chmod 600" in seen["certificate"]["advice"]


class TestProblem:
    def test_other_code(self, site: Site, look: Look) -> None:
        shutil.copy(test_other_code.EXAMPLE, site.directory)
        cloud = test_other_code.older_copy(site).start()
        seen = look(cloud.endpoint, site.configure(test_other_code.DOCUMENT))
        found = seen["problem"]
        assert found["state"] == "fails"
        here, there = test_other_code.digests_in(found["seen"].removeprefix("other_code: "))
        assert here != there
        assert seen["round trip"]["seen"].startswith("20 echoes: ")

    def test_a_problem_that_the_service_does_not_know(
        self, site: Site, services: Callable[..., str], look: Look
    ) -> None:
        shutil.copy(test_other_code.EXAMPLE, site.directory)
        seen = look(services("tcp", None), site.configure(test_other_code.DOCUMENT))
        assert "is not known to this service" in seen["problem"]["seen"]
        assert f"service with --problem {test_other_code.NAME}; " in seen["problem"]["advice"]
        assert "--problem-directory DIR" in seen["problem"]["advice"]

    def test_a_service_that_decides_otherwise(self, site: Site, look: Look) -> None:
        name = "lying_problem:LyingPeg"
        cloud = site.service("--problem", name, "--problem-directory", str(HERE))
        cloud.variables[lying_problem.VARIABLE] = "sensing"
        cloud.start()
        document = {**PEG, "problem": name, "problem_directory": str(HERE)}
        seen = look(cloud.endpoint, site.configure(document))
        assert seen["problem"]["state"] == "fails"
        assert "answers otherwise than this robot's own planner" in seen["problem"]["seen"]
        assert "trust.md" in seen["problem"]["advice"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "usage"),
        (("--json",), "no service is named: give --service ENDPOINT"),
        (("--service", "tcp/a:1", "--tls", "keys"), "tcp does not use the credentials"),
    ],
)
def test_options_that_cannot_be_used(arguments: tuple[str, ...], message: str, site: Site) -> None:
    done = site.holdfast("doctor", *arguments)
    assert done.process.returncode == 2
    assert message in done.output
    assert "Traceback" not in done.output
