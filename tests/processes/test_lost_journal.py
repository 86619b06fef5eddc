"""The files of a run are taken away, cannot be written or have no room: the robot holds still.

It says what is the matter with which file, and whatever it does then, it performs nothing twice.
"""

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.processes.faults import (
    COMMAND,
    References,
    Robot,
    Site,
    Story,
    document_of,
    sensing_steps,
)
from tests.programs import completed

PEG = "peg_in_hole_2d"
SHORT = document_of(PEG, max_steps=40)
LONG_STEPS = 400
LONG = document_of(PEG, max_steps=LONG_STEPS)
KILLED = sensing_steps(SHORT)[1]
"""Killed while it senses there, the robot leaves a journal without an action of unknown fate."""

_IN_NAMESPACE = ("unshare", "--user", "--map-root-user", "--mount")


def why_no_mounts() -> str | None:
    """Return why no file system can be mounted in a namespace of its own; None if it can be."""
    if shutil.which("unshare") is None:
        return "unshare is not installed (Debian's package: util-linux)"
    done = completed([*_IN_NAMESPACE, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], timeout=30)
    return None if done.returncode == 0 else f"no mount in a namespace: {done.stderr.strip()}"


WHY_NOT = why_no_mounts()
needs_mounts = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))


def in_namespace(script: str, directory: Path) -> list[str]:
    """Return the robot's command with a script before it that mounts something at a directory."""
    return [*_IN_NAMESPACE, "sh", "-c", script, str(directory), *COMMAND]


READ_ONLY = 'mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" && exec "$@"'

# What is in it is gone with the namespace, so it is brought out.
SMALL = """
mount -t tmpfs -o size=28k tmpfs "$0" || exit 99
"$@"
code=$?
cp -a "$0" "$0-kept"
exit $code
"""


def content(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir() if path.is_file()}


def journal_of(robot: Robot) -> Path:
    return robot.out / "journal.bin"


def remove_journal(out: Path) -> None:
    (out / "journal.bin").unlink()


def rename(out: Path) -> None:
    out.rename(out.with_name("renamed"))


def replace(out: Path) -> None:
    shutil.copyfile(out / "journal.bin", out / "copy")
    (out / "copy").rename(out / "journal.bin")


class TestTakenAwayInMidRun:
    @pytest.mark.parametrize(
        "take", [remove_journal, replace, pytest.param(shutil.rmtree, marks=pytest.mark.slow)]
    )
    def test_the_robot_holds_still(
        self, take: Callable[[Path], None], site: Site, references: References
    ) -> None:
        story = Story(site, references, SHORT)
        story.at("perform", 12, lambda: take(story.running.out))
        robot = site.run(story.file)
        assert robot.wait() == 2, robot.account()
        assert f"{journal_of(robot)}: the journal is gone" in robot.output
        assert "Traceback" not in robot.output
        # Nothing can go on with what is not there.
        assert "--resume" not in robot.output
        # What the robot was about to do when it was taken away was done, and nothing after it.
        assert story.world.step == 13

    def test_a_renamed_directory_is_written_on(self, site: Site, references: References) -> None:
        """Nothing is lost: the journal is in it. Its tables are not made, for nobody says where."""
        story = Story(site, references, SHORT)
        story.at("perform", 12, lambda: rename(story.running.out))
        site.run(story.file).wait()
        assert not story.world.wrongs
        story.finish(site.run(story.file, out="renamed", resume=True))

    @pytest.mark.parametrize(
        "take", [shutil.rmtree, pytest.param(remove_journal, marks=pytest.mark.slow)]
    )
    def test_a_batch_ends(self, take: Callable[[Path], None], site: Site) -> None:
        """Its own problem takes the files away, in its last trial."""
        (site.directory / "thief.py").write_text(THIEF)
        out = site.directory / "out"
        file = site.configure({**document_of(PEG, max_steps=6, trials=3), "problem": "thief:Thief"})
        variables = {"THIEF_TAKES": str(out if take is shutil.rmtree else out / "journal.bin")}
        batch = site.process(
            *COMMAND, "run", str(file), "--out", str(out), "--jobs", "1", variables=variables
        )
        assert batch.wait() == 2, batch.account()
        assert f"{out / 'journal.bin'}: the journal is gone" in batch.output
        assert "Traceback" not in batch.output


THIEF = """
import os, shutil
from pathlib import Path
from holdfast.problems.peg_in_hole_2d import PegInHole2D

class Thief(PegInHole2D):
    moves = 0

    def is_goal(self, state):
        Thief.moves += 1
        path = Path(os.environ["THIEF_TAKES"])
        if Thief.moves == 15:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return super().is_goal(state)
"""


class TestCutOffAfterAKill:
    @pytest.mark.parametrize(
        "world", ["WorldClient", pytest.param("PlainWorldClient", marks=pytest.mark.slow)]
    )
    def test_nothing_is_performed_twice(
        self, world: str, site: Site, references: References
    ) -> None:
        story = Story(site, references, SHORT, environment={"object": f"world_client:{world}"})
        story.at("sense", KILLED, site.kill_robot)
        robot = site.run(story.file)
        assert robot.wait() == -signal.SIGKILL
        journal = journal_of(robot)
        whole = journal.read_bytes()
        os.truncate(journal, len(whole) - 100)
        for _ in range(2):  # a refusal changes nothing: the next one is refused as well
            again = site.run(story.file, resume=True)
            assert again.wait() == 2, again.account()
            assert story.world.step == KILLED
            assert "the journal is damaged (after record" in again.output
            assert "--resume" not in again.output
        journal.write_bytes(whole)
        story.finish(site.run(story.file, resume=True))


class TestCannotBeWritten:
    @needs_mounts
    @pytest.mark.parametrize(
        ("killed", "alone"),
        [(True, False), pytest.param(False, False, marks=pytest.mark.slow), (True, True)],
        ids=["killed", "ended", "the journal alone"],
    )
    def test_a_read_only_file_system(
        self, killed: bool, alone: bool, site: Site, references: References
    ) -> None:
        story = Story(site, references, SHORT)
        end = site.kill_robot if killed else lambda: story.running.signal(signal.SIGTERM)
        story.at("sense", KILLED, end)
        robot = site.run(story.file)
        assert robot.wait() in (-signal.SIGKILL, 128 + signal.SIGTERM)
        before = content(robot.out)
        read_only = journal_of(robot) if alone else robot.out
        command = in_namespace(READ_ONLY, read_only)
        again = site.run(story.file, resume=True, command=command)
        assert again.wait() == 2, again.account()
        assert f"{read_only}: cannot be written: Read-only file system" in again.output
        assert "its journal is whole" in again.output
        assert content(robot.out) == before
        story.finish(site.run(story.file, resume=True))

    @needs_mounts
    def test_a_disk_that_fills_up(self, site: Site, references: References) -> None:
        story = Story(site, references, LONG)
        out = site.directory / "out"
        out.mkdir()
        robot = site.run(story.file, command=in_namespace(SMALL, out))
        assert robot.wait() == 4, robot.account()
        assert f"{journal_of(robot)}: cannot be written: No space left on" in robot.output
        assert "device; make room on the disk first\nGo on with: " in robot.output
        assert "--resume" in robot.output
        assert 0 < story.world.step < LONG_STEPS
        story.finish(site.run(story.file, out="out-kept", resume=True))
