"""Files and endpoints that a person names."""

import os
import socket
import sys
import threading
from pathlib import Path

import pytest

from holdfast.cli import main
from holdfast.config.reading import absolute_endpoint, read_bounded


def test_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"0123456789")
    assert read_bounded(tmp_path / "file", 100) == b"0123456789"
    assert read_bounded(tmp_path / "file", 4) == b"0123"


@pytest.mark.parametrize("content", [b"", b"a", b"abc" * 100_000])
def test_a_shell_s_pipe(content: bytes) -> None:
    reading, writing = os.pipe()

    def write() -> None:
        with os.fdopen(writing, "wb") as file:
            file.write(content)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        assert read_bounded(Path(f"/dev/fd/{reading}"), 1_000_000) == content
    finally:
        writer.join()
        os.close(reading)


def test_a_pipe_that_does_not_end() -> None:
    reading, writing = os.pipe()
    try:
        os.write(writing, b"0123456789")
        assert read_bounded(Path(f"/dev/fd/{reading}"), 4) == b"0123"
    finally:
        os.close(writing)
        os.close(reading)


def test_a_named_pipe_is_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=(b"late",))
    timer = threading.Timer(0.1, writer.start)
    timer.start()
    try:
        assert read_bounded(tmp_path / "pipe", 100) == b"late"
    finally:
        timer.join()
        writer.join()


@pytest.mark.parametrize("command", [["run"], ["simulate", "--schedule"]], ids=" ".join)
@pytest.mark.parametrize("kind", ["socket", "device", "directory"])
def test_what_is_no_file_is_refused(
    command: list[str],
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("named")
    with socket.socket(socket.AF_UNIX) as bound:
        if kind == "socket":
            bound.bind(str(path))
        elif kind == "directory":
            path.mkdir()
        else:
            path.symlink_to("/dev/zero")
        monkeypatch.setattr(sys, "argv", ["holdfast", *command, str(path)])
        with pytest.raises(SystemExit) as ended:
            main()
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("holdfast: error: named: ")
    assert said.count("\n") == 1
    assert len(said) > len("holdfast: error: named: cannot be read: ") or kind == "directory"


def test_the_path_of_a_local_socket_becomes_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert absolute_endpoint("unix/robot.sock") == f"unix/{tmp_path}/robot.sock"
    assert absolute_endpoint("unix/robot.sock", Path("/run")) == "unix//run/robot.sock"
    for other in ("unix//run/robot.sock", "tcp/localhost:7447", "unix/", "nonsense"):
        assert absolute_endpoint(other) == other
