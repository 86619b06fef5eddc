"""A Docker Engine for tests, the base that no registry hands out here, and the images of the tree.

An engine that runs already is used and left as it is found, but for what it has built. Where none
runs, root starts one with a directory of its own, and ends it (``HOLDFAST_TEST_DOCKER_DATA`` names
one for its images that stays). The images' tags are digests of what they are made of, so a tree
that has not changed is not built again.
"""

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest
from tests.programs import completed

ROOT = Path(__file__).parents[2]
BASE = "debian:bookworm-slim"
TARGETS = ("cloud", "robot")

USER = 10001
"""User of what runs in the images."""

PATIENCE_S = 120.0
"""For whatever must happen; only a hang takes so long."""

_BUILD_S = 1200.0
_DEBIAN = "http://deb.debian.org/debian"
_AUTHORITIES = Path("/etc/ssl/certs/ca-certificates.crt")
_NOT_IN_SLIM = (
    *("usr/share/doc", "usr/share/man", "usr/share/locale"),
    *("var/cache/apt", "var/lib/apt/lists"),
)


def missing(reason: str) -> NoReturn:
    """Leave the test out, or fail in CI, where everything is to be had."""
    if os.environ.get("CI"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


def holdfast(*words: object, cwd: Path | None = None) -> None:
    """Run the command on this machine, which must succeed."""
    done = completed(
        [sys.executable, "-m", "holdfast", *map(str, words)], cwd=cwd, timeout=PATIENCE_S
    )
    assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"


def give_to(user: int, *paths: Path) -> None:
    """Let a user have files and directories."""
    if os.geteuid() != 0:
        missing("files have to be given to the user of the images, which root alone can")
    for path in paths:
        for each in (path, *path.rglob("*")):
            os.chown(each, user, user)


def wait_until(condition: Callable[[], bool], what: str) -> None:
    """Wait for what happens elsewhere."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.05)


class Engine:
    """The command ``docker``, talking to one engine."""

    def __init__(self, host: str | None = None, restart: Callable[[], None] | None = None) -> None:
        self.restart = restart
        self.variables = dict(os.environ)
        if host is not None:
            self.variables["DOCKER_HOST"] = host

    def run(
        self, *words: object, variables: Mapping[str, str] | None = None, **options: Any
    ) -> subprocess.CompletedProcess[str]:
        """Run a command with this engine; whatever its exit code is."""
        return subprocess.run(
            [str(word) for word in words],
            env={**self.variables, **(variables or {})},
            text=True,
            capture_output=True,
            check=False,
            timeout=options.pop("timeout", PATIENCE_S),
            **options,
        )

    def checked(self, *words: object, **options: Any) -> str:
        """Run a command that must succeed, and return what it prints."""
        done = self.run(*words, **options)
        assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done.stdout.strip()

    def docker(self, *words: object, **options: Any) -> str:
        """Run ``docker ...``, which must succeed, and return what it prints."""
        return self.checked("docker", *words, **options)

    def inspect(self, name: str) -> Any:
        """Return what is known of a container, an image or a network."""
        return json.loads(self.docker("inspect", name))[0]

    def has_image(self, name: str) -> bool:
        """Tell whether there is such an image."""
        return self.run("docker", "image", "inspect", name).returncode == 0

    def compose(self, project: str, *words: object, **options: Any) -> str:
        """Run Compose, the second one if it is there, which must succeed."""
        second = self.run("docker", "compose", "version").returncode == 0
        command = ("docker", "compose") if second else ("docker-compose",)
        return self.checked(*command, "-p", project, *words, **options)


class Images(NamedTuple):
    """Names of the images."""

    cloud: str
    robot: str


@contextlib.contextmanager
def running_engine() -> Iterator[Engine]:
    """Return the engine that runs, or one that is ended afterwards."""
    if shutil.which("docker") is None:
        missing("there is no command docker (Debian: docker.io)")
    engine = Engine()
    found = engine.run("docker", "version")
    if found.returncode == 0:
        yield engine
        return
    if os.geteuid() != 0 or shutil.which("dockerd") is None:
        missing(f"no Docker Engine can be used: {found.stderr.strip()}")
    with tempfile.TemporaryDirectory(prefix="holdfast-docker-", ignore_cleanup_errors=True) as name:
        own = _OwnEngine(Path(name))
        try:
            own.start()
            yield own.engine
        finally:
            own.stop()


class _OwnEngine:
    """An engine of the tests, with its files in a directory."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._data = os.environ.get("HOLDFAST_TEST_DOCKER_DATA") or directory / "data"
        self._process: subprocess.Popen[bytes] | None = None
        self.engine = Engine(f"unix://{directory}/socket", self.restart)

    def start(self) -> None:
        directory = self._directory
        with (directory / "log").open("a") as log:
            process = self._process = subprocess.Popen(
                [
                    *("dockerd", "--host", self.engine.variables["DOCKER_HOST"]),
                    *("--data-root", self._data, "--exec-root", directory / "exec"),
                    *("--pidfile", directory / "pid"),
                ],
                stdout=log,
                stderr=subprocess.STDOUT,
            )

        def answers() -> bool:
            if process.poll() is not None:
                account = (directory / "log").read_text()[-2000:]
                missing(f"dockerd ended with exit code {process.returncode}:\n{account}")
            return self.engine.run("docker", "version").returncode == 0

        wait_until(answers, "dockerd to answer")

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(PATIENCE_S)

    def restart(self) -> None:
        self.stop()
        self.start()


def build(engine: Engine) -> Images:
    """Build what is not built yet of this tree."""
    if not engine.has_image(BASE):
        _make_base(engine)
    tag = f"test-{_digest()[:12]}"
    names = {target: f"holdfast-{target}:{tag}" for target in TARGETS}
    for target, name in names.items():
        if not engine.has_image(name):
            engine.docker(
                *("build", "-q", "-f", "deploy/Containerfile", "--target", target, "-t", name, "."),
                cwd=ROOT,
                timeout=_BUILD_S,
            )
    return Images(**names)


def _digest() -> str:
    """Return the digest of all that the images are made of."""
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    roots = [ROOT / line[1:] for line in ignored if line.startswith("!")]
    files = {path for root in roots for path in (root, *root.rglob("*")) if path.is_file()}
    files = {path for path in files if path.suffix not in (".pyc", ".so")}
    digest = hashlib.sha256()
    for path in sorted({*files, ROOT / "deploy/Containerfile", ROOT / ".dockerignore"}):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(ROOT)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _make_base(engine: Engine) -> None:
    """Make Debian from its packages; like the registries' slim one it has no pages to read.

    It takes along what this machine needs to reach packages: the authorities that it believes, and
    what it tells apt of proxies.
    """
    if os.geteuid() != 0 or shutil.which("debootstrap") is None:
        missing(f"there is no image {BASE}, and root with debootstrap is needed to make it")
    with tempfile.TemporaryDirectory(prefix="holdfast-base-") as name:
        root = Path(name) / "root"
        engine.checked(
            *(
                "debootstrap",
                "--variant=minbase",
                "--include=ca-certificates",
                "bookworm",
                root,
                _DEBIAN,
            ),
            timeout=_BUILD_S,
        )
        for path in _NOT_IN_SLIM:
            shutil.rmtree(root / path)
            (root / path).mkdir()
        if _AUTHORITIES.exists():
            shutil.copy(_AUTHORITIES, root / _AUTHORITIES.relative_to("/"))
        for file in Path("/etc/apt/apt.conf.d").iterdir():
            if "Acquire::" in file.read_text():
                shutil.copy(file, root / "etc/apt/apt.conf.d")
        archive = Path(name) / "base.tar"
        engine.checked("tar", "-C", root, "-cf", archive, ".", timeout=_BUILD_S)
        engine.docker("import", archive, BASE, timeout=_BUILD_S)
