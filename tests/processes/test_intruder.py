"""A stolen robot can ask for itself and do nothing else to the robots beside it.

It has a certificate of the same authority, knows the other robot's session and all that this one
asks, and says each message at each moment of a link (``tests/intruder.py``) while the honest robot
runs. Nothing of the other session reaches it, and the honest run is the same as undisturbed, bit
for bit.
"""

import os
import threading
from pathlib import Path

import msgspec
import pytest
from tests.intruder import Intruder
from tests.processes.faults import PATIENCE_S, References, Service, Site, Story, document_of
from tests.processes.test_tls import secure
from tests.questions import questions_of

from holdfast.config.loader import load
from holdfast.journal.journal import Journal
from holdfast.robot.session_configuration import session_configuration_of

DOCUMENT = document_of("peg_in_hole_2d")


@pytest.fixture(scope="session")
def stolen(keys: Path) -> Path:
    """Return the directory of the certificate of another robot, of the same authority."""
    with Site(keys) as site:
        made = site.holdfast("keys", keys / "ours", "--robot", "stolen")
        assert made.process.returncode == 0, made.account()
    return keys / "ours" / "stolen"


# Over udp it also says everything that can be said over tls.
@pytest.fixture(
    params=["udp", *(pytest.param(each, marks=pytest.mark.slow) for each in ("tcp", "tls"))]
)
def protocol(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def cloud(protocol: str, keys: Path, site: Site) -> Service:
    return (site.service() if protocol == "tcp" else secure(site, keys, protocol)).start()


@pytest.fixture
def options(protocol: str, keys: Path) -> tuple[str, ...]:
    """Return what the honest robot needs."""
    return () if protocol == "tcp" else ("--tls", str(keys / "ours" / "robot"))


class Raid:
    """An intruder that goes through all that it can say, again and again, while a robot runs."""

    def __init__(self, cloud: Service, keys: Path | None, story: Story) -> None:
        self._cloud = cloud
        self._keys = keys
        self._story = story
        self._stopped = threading.Event()
        self._round = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None
        self.intruder: Intruder | None = None

    def begin(self) -> None:
        """Begin, once the robot has asked something."""
        session = _session_of(self._story.running.out)
        if self._keys is None:
            # Without certificates the session is the only secret, and nobody tells it.
            session = os.urandom(16)
        configuration = load(self._story.file)
        asked = questions_of(configuration, session)
        own = msgspec.structs.replace(
            asked[0],
            session=os.urandom(16),
            session_configuration=session_configuration_of(configuration),
        )
        self.intruder = Intruder(self._cloud.endpoint, self._keys, asked, own)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def finish_a_round(self) -> None:
        """Wait until all was said once."""
        assert self._round.wait(5 * PATIENCE_S)

    def end(self) -> Intruder:
        """End; return the intruder."""
        self._stopped.set()
        assert self._thread is not None and self.intruder is not None
        self._thread.join()
        if self._failure is not None:
            raise self._failure
        return self.intruder

    def _run(self) -> None:
        assert self.intruder is not None
        try:
            while not self._stopped.is_set():
                self.intruder.run(self._stopped.is_set)
                self._round.set()
        except BaseException as error:  # noqa: BLE001 - raised where it is waited for
            self._failure = error
        finally:
            self._round.set()


def _session_of(run: Path) -> bytes:
    """Return the session of a run that goes on."""
    with Journal.read(run / "journal.bin") as journal:
        return journal.session()


def test_each_message_at_each_moment_changes_nothing(
    protocol: str,
    cloud: Service,
    options: tuple[str, ...],
    stolen: Path,
    site: Site,
    references: References,
) -> None:
    story = Story(site, references, DOCUMENT)
    raid = Raid(cloud, None if protocol == "tcp" else stolen, story)
    # It goes on while the robot asks; and it has said everything before the robot is through.
    story.at("perform", 10, raid.begin)
    story.at("perform", 70, raid.finish_a_round)
    robot = story.run(cloud, options=options)
    intruder = raid.end()
    assert intruder.told == []
    assert intruder.links > 500
    assert intruder.answered > 100
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared", service=cloud.endpoint)) == 1
    for name in ("service_vanished", "service_suspected", "disagreement", "refused", "restore"):
        assert not robot.matching(name), name
    assert cloud.process.process.poll() is None
    assert "Traceback" not in cloud.process.output
