"""The thesis's network: a robot and its cloud, joined by a real OpenVPN or WireGuard tunnel.

The tunnel is cut and restored under it. The robot, the cloud and the internet between them are
three networks on this machine. The profiles are those of ``deploy/vpn/make-profiles``. They stand
where systemd's units look for them, each end with an /etc of its own, and ``openvpn`` and
``wg-quick`` are called as those units call them.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from tests.deploy.docker import missing
from tests.processes import faults
from tests.programs import completed

from holdfast_lab.testbed.namespace import NetworkNamespace

MAKE_PROFILES = Path(__file__).parents[2] / "deploy" / "vpn" / "make-profiles"
TOOLS = {
    "ip": "iproute2",
    "nft": "nftables",
    "openssl": "openssl",
    "openvpn": "openvpn",
    "wg": "wireguard-tools",
    "wireguard-go": "wireguard-go",
}
KINDS = ("openvpn", "wireguard")
BOTH = pytest.mark.parametrize("kind", KINDS)

ROBOT, CLOUD, INSIDE = "192.0.2.2", "198.51.100.2", "10.77.0.1"
"""Where they are in the world, and where the cloud is in the tunnel."""

PORT = 7447

_NEW_NETWORK = 0x40000000
_libc = ctypes.CDLL(None, use_errno=True)


# -- networks ------------------------------------------------------------------------------------


class Network:
    """A network of its own."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.prefix = stack.enter_context(NetworkNamespace()).prefix
        self._holder = self.prefix[self.prefix.index("--target") + 1]

    def call(self, *command: str, fails: bool = False) -> str:
        """Run a command in it; return what it says."""
        done = subprocess.run(
            [*self.prefix, *command], capture_output=True, text=True, timeout=faults.PATIENCE_S
        )
        assert fails == (done.returncode != 0), f"{command}: {done.stderr}"
        return done.stdout + done.stderr

    def connect_to(self, other: Network, device: str, own: str, gateway: str) -> None:
        """Lay a cable to another one, which is the way to everywhere."""
        cable = ("ip", "link", "add", device, "type", "veth", "peer", "name", "eth0")
        other.call(*cable, "netns", self._holder)
        for network, end, address in ((other, device, gateway), (self, "eth0", own)):
            network.call("ip", "addr", "add", f"{address}/24", "dev", end)
            network.call("ip", "link", "set", end, "up")
        self.call("ip", "route", "add", "default", "via", gateway)

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Let this thread be in it, and whatever it starts: threads, processes, sockets."""
        with (
            Path("/proc/thread-self/ns/net").open() as before,
            Path(f"/proc/{self._holder}/ns/net").open() as here,
        ):
            _enter(here.fileno())
            try:
                yield
            finally:
                _enter(before.fileno())


def _enter(descriptor: int) -> None:
    assert _libc.setns(descriptor, _NEW_NETWORK) == 0, os.strerror(ctypes.get_errno())


class Internet(Network):
    """What lies between a robot and a cloud."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        super().__init__(stack)
        self.call("sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
        self.robot, self.cloud = Network(stack), Network(stack)
        self.robot.connect_to(self, "to-robot", ROBOT, "192.0.2.1")
        self.cloud.connect_to(self, "to-cloud", CLOUD, "198.51.100.1")

    def cut(self) -> None:
        self.call("ip", "link", "set", "to-cloud", "down")

    def restore(self) -> None:
        self.call("ip", "link", "set", "to-cloud", "up")


# -- tunnels -------------------------------------------------------------------------------------


class End:
    """One end of a tunnel: a process in a network, with files of its own in /etc."""

    def __init__(self, network: Network, kind: str, role: str, directory: Path) -> None:
        self._network = network
        self._log = directory / "log"
        self.etc = directory / "etc"
        self.etc.mkdir(parents=True)
        # Only OpenVPN starts a process that stays; wireguard-go leaves its parent, and ends with
        # the first process of its namespace.
        self._unshare = ["unshare", "--mount"]
        if kind == "openvpn":  # as openvpn-server@.service and openvpn-client@.service
            place = f"/etc/openvpn/{role}"
            nobind = "--nobind" if role == "client" else ""
            run = f"exec openvpn --suppress-timestamps {nobind} --config holdfast.conf"
            self._up = "Initialization Sequence Completed"
        else:  # as wg-quick@.service
            self._unshare += ["--pid", "--fork", "--kill-child", "--mount-proc"]
            place = "/etc/wireguard"
            run = "mount -t tmpfs none /run && wg-quick up holdfast && echo is up && exec cat"
            self._up = "is up"
        self._run = f"mount --bind {self.etc} {place} && cd {place} && {run}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it as its unit does."""
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*self._network.prefix, *self._unshare, "sh", "-c", self._run],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def wait_until_up(self) -> None:
        self.wait_for(self._up)

    def wait_for(self, words: str, count: int = 1) -> None:
        """Wait until it has said something so many times."""
        faults.wait_until(
            lambda: self._log.read_text().count(words) >= count or self._has_ended(),
            f"{words!r} from a tunnel's end",
        )
        said = self._log.read_text()
        assert said.count(words) >= count, said

    def call(self, script: str) -> str:
        """Run a script where its files are."""
        assert self._process is not None
        spaces = ["--mount", "--net", f"--pid=/proc/{self._process.pid}/ns/pid_for_children"]
        target = ["nsenter", "--target", str(self._process.pid), *spaces]
        return subprocess.run(
            [*target, "bash", "-c", script],
            capture_output=True,
            timeout=faults.PATIENCE_S,
            check=True,
        ).stdout.decode()

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        """End it; when this returns its device is gone."""
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait()
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process = None
            devices = Path("/proc/thread-self/net/dev")
            with self._network.entered():
                faults.wait_until(
                    lambda: "holdfast:" not in devices.read_text(), "the device's end"
                )

    def _has_ended(self) -> bool:
        return self._process is None or self._process.poll() is not None


class Tunnel:
    """Profiles of robots, and the two ends that have them."""

    def __init__(
        self, internet: Internet, kind: str, directory: Path, stack: contextlib.ExitStack
    ) -> None:
        self.internet = internet
        self.kind = kind
        self.profiles = directory / "vpn"
        self._directory = directory
        self._stack = stack
        make_profiles(kind, self.profiles, CLOUD, "anna", "ben")
        self.cloud = self._end(internet.cloud, "server", "cloud")
        self.robot = self._end(internet.robot, "client", "robot")
        # Somewhere else.
        self.stranger = self._end(internet, "client", "stranger")
        self.give_to_cloud()
        self.give(self.robot, profile_of(self.profiles, "anna"))

    def _end(self, network: Network, role: str, name: str) -> End:
        end = End(network, self.kind, role, self._directory / name)
        self._stack.callback(end.kill)
        return end

    def give_to_cloud(self) -> None:
        """Copy what the cloud's end needs, as the script says."""
        files = f"{self.profiles}/cloud/."
        subprocess.run(["cp", "-r", "--preserve=mode", files, self.cloud.etc], check=True)

    @staticmethod
    def give(end: End, profile: Path) -> None:
        shutil.copy(profile, end.etc / "holdfast.conf")

    def up(self) -> Tunnel:
        """Bring both ends up."""
        for end in (self.cloud, self.robot):
            end.start()
            end.wait_until_up()
        return self

    def remove(self, robot: str) -> None:
        """Shut a robot out, as the script says."""
        make_profiles("remove", self.profiles, robot)
        self.give_to_cloud()
        if self.kind == "openvpn":
            self.cloud.kill(signal.SIGTERM)
            self.cloud.start()
            self.cloud.wait_until_up()
        else:  # as the unit does when it is reloaded
            self.cloud.call("wg syncconf holdfast <(wg-quick strip holdfast)")


def profile_of(profiles: Path, robot: str) -> Path:
    (found,) = (profiles / "robots").glob(f"{robot}.*")
    return found


def make_profiles(*words: str | Path, **variables: str) -> str:
    """Call the script; return what it says."""
    done = called(*words, **variables)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return done.stdout


def called(*words: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return completed(
        [MAKE_PROFILES, *words], timeout=faults.PATIENCE_S, env={**os.environ, **variables}
    )


# -- fixtures ------------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def _tools() -> None:
    packages = sorted({package for tool, package in TOOLS.items() if shutil.which(tool) is None})
    reason = f"not installed (Debian's packages): {', '.join(packages)}" if packages else ""
    if os.geteuid() != 0:
        reason = "devices in networks of their own need root"
    elif not Path("/dev/net/tun").exists():
        reason = "this machine has no /dev/net/tun"
    if reason:
        missing(reason)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("keys")
    with faults.Site(directory) as site:
        hosts = ("--host", INSIDE, "--host", CLOUD)
        made = site.holdfast("keys", directory / "keys", *hosts)
        assert made.process.returncode == 0, made.account()
    return directory / "keys"


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.fixture
def laid(kind: str, tmp_path: Path, stack: contextlib.ExitStack) -> Tunnel:
    return Tunnel(Internet(stack), kind, tmp_path / "tunnel", stack)


@pytest.fixture
def tunnel(laid: Tunnel) -> Tunnel:
    return laid.up()


# -- holdfast over them --------------------------------------------------------------------------


class Run:
    """``holdfast serve`` in the cloud and a robot that is to run; the same whatever joins them."""

    def __init__(
        self,
        internet: Internet,
        site: faults.Site,
        references: faults.References,
        keys: Path,
        wire: str,
        host: str = INSIDE,
    ) -> None:
        self._internet = internet
        self._keys = keys
        self.document = faults.document_of("peg_in_hole_2d", max_steps=180)
        # So long an answer takes nearly the largest datagram that there is.
        self.document["simulator"]["sensing_intervals"] = 44
        self.steps = faults.sensing_steps(self.document)
        with internet.cloud.entered():
            self.cloud: faults.Service = site.service(
                *("--tls", str(keys / "service")),
                endpoint=f"{wire}/{host}:{PORT}",
                lease_ms=faults.QUICK["lease_ms"],
            ).start()
        # The world that the robot acts on is where the robot is.
        with internet.robot.entered():
            self.story = faults.Story(site, references, self.document, offload=faults.QUICK)

    def finish(self) -> faults.Robot:
        with self._internet.robot.entered():
            return self.story.run(self.cloud, options=("--tls", str(self._keys / "robot")))


@pytest.mark.parametrize(
    ("kind", "wire"),
    [
        ("openvpn", "udp"),
        ("wireguard", "tls"),
        pytest.param("openvpn", "tls", marks=pytest.mark.slow),
        pytest.param("wireguard", "udp", marks=pytest.mark.slow),
    ],
)
def test_cut_and_restored(
    tunnel: Tunnel, wire: str, site: faults.Site, references: faults.References, keys: Path
) -> None:
    run = Run(tunnel.internet, site, references, keys, wire)
    story, steps = run.story, run.steps
    story.at("sense", steps[1], tunnel.internet.cut)
    story.at("perform", steps[2], tunnel.internet.restore, story.status(faults.KEEP_ALIVE))
    robot = run.finish()
    assert robot.statuses() == [faults.LOST, faults.RESTORED]
    # No datagram is too large for the tunnel.
    assert robot.matching("no_datagrams") == []


@pytest.mark.parametrize(
    "kind",
    ["openvpn", pytest.param("wireguard", marks=pytest.mark.slow)],  # 15 seconds
)
def test_the_clouds_end_is_killed_and_started_again(
    tunnel: Tunnel, site: faults.Site, references: faults.References, keys: Path
) -> None:
    """With its keys, so that the robot's end must find that out; holdfast notices sooner."""
    run = Run(tunnel.internet, site, references, keys, "tls")
    story, steps = run.story, run.steps
    story.at("sense", steps[1], tunnel.cloud.kill)
    again = (tunnel.cloud.start, tunnel.cloud.wait_until_up)
    story.at("perform", steps[2], *again, story.status(faults.KEEP_ALIVE))
    robot = run.finish()
    assert robot.statuses() == [faults.LOST, faults.RESTORED]


@BOTH
def test_a_robot_that_is_removed_in_mid_run(
    tunnel: Tunnel, site: faults.Site, references: faults.References, keys: Path
) -> None:
    run = Run(tunnel.internet, site, references, keys, "tls")
    story, steps = run.story, run.steps
    story.at("sense", steps[1], lambda: tunnel.remove("anna"), story.status(faults.LOCAL_RECOVERY))
    robot = run.finish()
    assert robot.statuses() == [faults.LOST]
    if tunnel.kind == "openvpn":
        tunnel.cloud.wait_for("is revoked")
    # The next one is let in, at the same end.
    tunnel.robot.kill()
    tunnel.give(tunnel.robot, profile_of(tunnel.profiles, "ben"))
    tunnel.robot.start()
    tunnel.robot.wait_until_up()
    with tunnel.internet.robot.entered():
        socket.create_connection((INSIDE, PORT), faults.PATIENCE_S).close()


def test_openvpn_lets_no_stranger_in(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    tunnel = Tunnel(Internet(stack), "openvpn", tmp_path / "tunnel", stack)
    make_profiles("openvpn", tmp_path / "theirs", CLOUD, "anna")
    profile = profile_of(tmp_path / "theirs", "anna")
    tunnel.cloud.start()
    tunnel.cloud.wait_until_up()
    tunnel.give(tunnel.stranger, profile)
    tunnel.stranger.start()
    tunnel.cloud.wait_for("tls-crypt unwrap error: packet authentication failed")
    tunnel.stranger.kill()
    # One who has what all robots have in common.
    ours = profile_of(tunnel.profiles, "anna").read_text()
    text = profile.read_text()
    for part in ("ca", "tls-crypt"):
        text = text.replace(_part(text, part), _part(ours, part))
    profile.write_text(text)
    tunnel.give(tunnel.stranger, profile)
    tunnel.stranger.start()
    tunnel.cloud.wait_for("VERIFY ERROR")
    tunnel.robot.start()
    tunnel.robot.wait_until_up()


def _part(profile: str, name: str) -> str:
    return profile[profile.index(f"<{name}>") : profile.index(f"</{name}>")]


def test_wireguard_lets_no_stranger_in(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    tunnel = Tunnel(Internet(stack), "wireguard", tmp_path / "tunnel", stack)
    make_profiles("wireguard", tmp_path / "theirs", CLOUD, "anna")
    profile = profile_of(tmp_path / "theirs", "anna")
    # One who has what all robots have in common.
    ours = profile_of(tunnel.profiles, "anna").read_text()
    text = profile.read_text()
    profile.write_text(text.replace(_public_key(text), _public_key(ours)))
    tunnel.give(tunnel.stranger, profile)
    for end in (tunnel.cloud, tunnel.stranger):
        end.start()
        end.wait_until_up()

    def received_and_sent(end: End) -> tuple[int, int]:
        _, received, sent = end.call("wg show holdfast transfer").split()
        return int(received), int(sent)

    faults.wait_until(lambda: received_and_sent(tunnel.stranger)[1] > 0, "a stranger's attempt")
    tunnel.robot.start()
    tunnel.robot.wait_until_up()
    # Who came later is answered.
    faults.wait_until(lambda: received_and_sent(tunnel.robot)[0] > 0, "the cloud's answer")
    assert received_and_sent(tunnel.stranger)[0] == 0


def _public_key(profile: str) -> str:
    return profile.partition("PublicKey = ")[2].partition("\n")[0]


@BOTH
def test_nothing_is_reached_beside_the_tunnel(tunnel: Tunnel, site: faults.Site) -> None:
    internet = tunnel.internet
    with internet.cloud.entered():
        site.service("--insecure", endpoint=f"tcp/{INSIDE}:{PORT}").start()
    with internet.robot.entered():
        socket.create_connection((INSIDE, PORT), faults.PATIENCE_S).close()
    with internet.entered():
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((CLOUD, PORT), faults.PATIENCE_S)
        # A machine takes packets for each of its addresses at each of its devices, so a neighbour
        # who sends them there gets in. This rule keeps it out (docs/deploy.md).
        internet.call("ip", "route", "add", INSIDE, "via", CLOUD)
        socket.create_connection((INSIDE, PORT), faults.PATIENCE_S).close()
        rules = """
            table inet holdfast {
                chain input {
                    type filter hook input priority 0
                    ip daddr 10.77.0.1 iifname != { "lo", "holdfast" } reject
                }
            }
        """
        internet.cloud.call("nft", rules)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((INSIDE, PORT), faults.PATIENCE_S)
    for network in (internet.robot, internet.cloud):
        with network.entered():
            socket.create_connection((INSIDE, PORT), faults.PATIENCE_S).close()


# -- the script ----------------------------------------------------------------------------------


def test_what_the_files_are(tmp_path: Path) -> None:
    for kind in KINDS:
        said = make_profiles(kind, tmp_path / kind, "cloud.example.org:4711", "anna", "ben")
        assert "systemctl enable --now" in said
        readable = {
            path.relative_to(tmp_path / kind).parts[:2]
            for path in (tmp_path / kind).rglob("*")
            if path.is_file() and path.stat().st_mode & 0o077
        }
        # Which robot has which address is all that the server reads as nobody.
        assert readable == ({("cloud", "holdfast-robots")} if kind == "openvpn" else set())
        assert (tmp_path / kind).stat().st_mode & 0o777 == 0o700
        anna = profile_of(tmp_path / kind, "anna").read_text()
        assert "cloud.example.org" in anna
        assert "4711" in anna
        assert anna != profile_of(tmp_path / kind, "ben").read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(KINDS)


@BOTH
def test_adding_and_removing_robots_leaves_the_others_as_they_are(
    kind: str, tmp_path: Path
) -> None:
    vpn = tmp_path / "vpn"
    make_profiles(kind, vpn, "[2001:db8::7]", "anna", "ben")
    before = profile_of(vpn, "anna").read_text()
    make_profiles("add", vpn, "carl")
    make_profiles("remove", vpn, "ben")
    assert not list((vpn / "robots").glob("ben.*"))
    make_profiles("add", vpn, "dora", "ben", HOLDFAST_VPN_NETWORK="10.1.1")
    assert profile_of(vpn, "anna").read_text() == before
    assert addresses_of(vpn) == {
        "anna": "10.77.0.2",
        "dora": "10.77.0.3",
        "carl": "10.77.0.4",
        "ben": "10.77.0.5",
    }
    assert sorted(path.name for path in vpn.iterdir() if path.name != "authority") == [
        "cloud",
        "network",
        "robots",
    ]


def addresses_of(vpn: Path) -> dict[str, str]:
    """Return the robots that the cloud's end knows."""
    configuration = (vpn / "cloud" / "holdfast.conf").read_text()
    if "[Interface]" in configuration:
        robots = [part.splitlines() for part in configuration.split("\n\n")[1:]]
        return {
            robot[0].removeprefix("# "): robot[3].removeprefix("AllowedIPs = ").removesuffix("/32")
            for robot in robots
        }
    files = (vpn / "cloud" / "holdfast-robots").iterdir()
    return {file.name: file.read_text().split()[4] for file in files}


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (("openvpn", "new"), "openvpn needs DIR, HOST[:PORT] and the names of robots"),
        (("openvpn", "new", "host", "an na"), "robot 'an na'"),
        (("openvpn", "new", "host", "../anna"), "robot '../anna'"),
        (("openvpn", "new", "host", "DEFAULT"), "robot 'DEFAULT': this name is taken"),
        (("openvpn", "new", "host", "anna", "anna"), "robot 'anna' is named twice"),
        (("openvpn", "new", "ho st", "anna"), "HOST 'ho st'"),
        (("wireguard", "new", "host:65536", "anna"), "PORT '65536': a number from 1 to 65535"),
        (("wireguard", "new", "2001:db8::7", "anna"), "in brackets"),
        (("wireguard", "there", "host", "anna"), "there is there already"),
        (("add", "there"), "no robot is named"),
        (("add", "there", "anna"), "robot 'anna' is there already"),
        (("add", "new", "anna"), "was not made by make-profiles"),
        (("remove", "there", "ben"), "robot 'ben' is not in"),
        (("wireguard",), "wireguard needs DIR"),
        (("quic", "new"), "usage: make-profiles openvpn|wireguard"),
        ((), "usage: make-profiles openvpn|wireguard"),
    ],
)
def test_what_is_refused_changes_nothing(
    words: Sequence[str], wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_profiles("wireguard", "there", "host", "anna")
    before = _contents(tmp_path)
    refused = called(*words)
    assert refused.returncode == 2
    assert wrong in refused.stderr
    assert not refused.stdout
    assert _contents(tmp_path) == before


@pytest.mark.parametrize(
    ("network", "wrong"),
    [
        ("{here}/evil host 1194 10.77.0", "kind '{here}/evil': openvpn and wireguard"),
        ("date host 1194 10.77.0", "kind 'date'"),
        ("wireguard ho$(touch${{IFS}}ran)st 51820 10.77.0", "HOST 'ho"),
        ("wireguard host a[$(touch${{IFS}}ran)] 10.77.0", "PORT 'a["),
        ("wireguard host 51820 10.77.0 PostUp = touch ran", "HOLDFAST_VPN_NETWORK '10.77.0 PostUp"),
        ("", "kind ''"),
    ],
)
@pytest.mark.parametrize("what", ["add", "remove"])
def test_a_directory_of_somebody_else_runs_nothing(
    what: str, network: str, wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_profiles("wireguard", "there", "host", "anna")
    for name in ("known", "enlist", "strike", "next", "next_robot", "taken_addresses"):
        program = tmp_path / f"evil_{name}"
        program.write_text(f"#!/bin/sh\ntouch {tmp_path}/ran\n")
        program.chmod(0o755)
    (tmp_path / "there" / "network").write_text(network.format(here=tmp_path) + "\n")
    before = _contents(tmp_path)
    refused = called(what, "there", "ben" if what == "add" else "anna")
    assert refused.returncode == 2
    assert wrong.format(here=tmp_path) in refused.stderr
    assert _contents(tmp_path) == before


def test_what_would_be_an_option_in_a_profile_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_profiles("openvpn", "there", "host", "anna")
    address = tmp_path / "there" / "cloud" / "holdfast-robots" / "anna"
    address.write_text(address.read_text().replace("# serial ", "# serial ../../../"))
    key = tmp_path / "there" / "authority" / "tls-crypt.key"
    key.write_text(key.read_text() + "</tls-crypt>\nplugin evil.so\n<tls-crypt>\n")
    before = _contents(tmp_path)
    for words, wrong in (
        (("add", "there", "ben"), "authority/tls-crypt.key: is no key or certificate"),
        (("remove", "there", "anna"), "anna: has no serial number, but '../../../"),
    ):
        refused = called(*words)
        assert refused.returncode == 2
        assert wrong in refused.stderr
        assert _contents(tmp_path) == before


def test_nothing_half_written_stays(tmp_path: Path) -> None:
    """An openssl that fails at the last robot."""
    programs = tmp_path / "programs"
    programs.mkdir()
    (programs / "openssl").write_text(
        f'#!/bin/sh\ncase "$*" in *CN=ben*) echo no entropy >&2; exit 1 ;; esac\n'
        f'exec {shutil.which("openssl")} "$@"\n'
    )
    (programs / "openssl").chmod(0o755)
    path = f"{programs}:{os.environ['PATH']}"
    failed = called("openvpn", tmp_path / "vpn", "host", "anna", "ben", PATH=path)
    assert failed.returncode != 0
    assert "no entropy" in failed.stderr
    assert [each.name for each in tmp_path.iterdir()] == ["programs"]
    make_profiles("openvpn", tmp_path / "vpn", "host", "anna")
    before = _contents(tmp_path)
    assert called("add", tmp_path / "vpn", "ben", PATH=path).returncode != 0
    assert _contents(tmp_path) == before


def _contents(directory: Path) -> dict[str, bytes | None]:
    return {
        str(path): path.read_bytes() if path.is_file() else None for path in directory.rglob("*")
    }
