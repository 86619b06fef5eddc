"""Commands that may have few files and sockets open: they work, or say so before they begin."""

import contextlib
import resource
from pathlib import Path

import pytest
from tests.ports import free_port
from tests.processes import faults
from tests.processes.test_tls import secure
from tests.wire import GOODBYE, HELLO, RawLink, hello_of

from holdfast.runtime.descriptors import NEEDED
from holdfast.transport.service_end import MAX_LINKS, MAX_UNKNOWN

PEG = "peg_in_hole_2d"


def limited(limits: str, *command: str) -> tuple[str, ...]:
    """Return a command under limits as the shell's ``ulimit`` takes them."""
    return ("sh", "-c", f'ulimit {limits} && exec "$@"', "sh", *command)


@pytest.mark.parametrize(
    ("command", "number"),
    [
        ("run", 8),
        ("serve", NEEDED - 1),
        pytest.param("run", 10, marks=pytest.mark.slow),
        pytest.param("serve", 9, marks=pytest.mark.slow),
    ],
)
def test_too_few_are_refused_in_one_line(site: faults.Site, command: str, number: int) -> None:
    port = free_port()
    arguments = ["serve", "--listen", f"tcp/127.0.0.1:{port}"]
    if command == "run":
        file = site.configure(faults.document_of(PEG))
        arguments = ["run", str(file), "--out", "out", "--service", f"tcp/127.0.0.1:{port}"]
    ended = site.process(*limited(f"-n {number}", *faults.COMMAND, *arguments))
    assert ended.wait() == 2, ended.account()
    (line,) = ended.output.splitlines()
    assert line.startswith(f"holdfast: error: this process may have {number} files")
    assert "RLIMIT_NOFILE" in line
    assert f"ulimit -n {NEEDED}" in line
    assert not (site.directory / "out").exists()


def test_as_many_as_are_needed_are_enough(site: faults.Site, references: faults.References) -> None:
    """For a robot whose service dies and that launches its own, and for both services."""
    cloud = site.service()
    cloud.command = limited(f"-n {NEEDED}", *cloud.command)
    cloud.start()
    story = faults.Story(site, references, faults.document_of(PEG))
    story.at("perform", 30, cloud.kill, story.status(faults.LOCAL_RECOVERY))
    robot = site.run(story.file, services=[cloud], command=limited(f"-n {NEEDED}", *faults.COMMAND))
    story.finish(robot)
    assert robot.statuses() == [faults.LOST]
    assert cloud.process.matching("session_opened")


def test_a_service_takes_what_it_is_allowed(
    site: faults.Site, references: faults.References
) -> None:
    """Each robot is a socket: a soft limit is raised as far as the hard one allows."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    cloud = site.service()
    cloud.command = limited("-S -n 12", *cloud.command)
    cloud.start()
    wanted = NEEDED + MAX_UNKNOWN + MAX_LINKS
    soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    assert resource.prlimit(cloud.process.pid, resource.RLIMIT_NOFILE) == (soft, hard)
    robot = faults.Story(site, references, faults.document_of(PEG)).run(cloud)
    assert robot.statuses() == []


def test_one_certificate_does_not_take_them_all(site: faults.Site, keys: Path) -> None:
    made = site.holdfast("keys", keys / "ours", "--robot", "greedy")
    assert made.process.returncode == 0, made.account()
    cloud = secure(site, keys, "tls")
    cloud.command = limited("-n 100", *cloud.command)
    cloud.start()
    with contextlib.ExitStack() as stack:
        answers = []
        for _ in range(60):
            link = stack.enter_context(RawLink(cloud.endpoint, keys / "ours" / "greedy"))
            link.say(hello_of())
            answers.append(link.receive())
        assert [each and each.kind for each in answers].count(HELLO) == 25  # a quarter
        full = b"one too many: 25 robots are connected; with a higher limit on open files (ulimit"
        assert any(each and each.kind == GOODBYE and full in each.payload for each in answers)
        other = stack.enter_context(RawLink(cloud.endpoint, keys / "ours" / "robot"))
        other.say(hello_of())
        frame = other.receive()
        assert frame is not None and frame.kind == HELLO
