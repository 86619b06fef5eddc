"""Files: written completely or not at all."""

import errno
import os
from pathlib import Path

import pytest

from holdfast.errors import OutputError
from holdfast.runtime.files import directory_beside, move_into_place, require_free, write_atomically


class TestMadeBesideItsPlace:
    @pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("mine")])
    def test_or_not_at_all(self, error: BaseException, tmp_path: Path) -> None:
        with pytest.raises(type(error)), directory_beside(tmp_path / "place") as growing:
            (growing / "file").write_text("half")
            raise error
        assert list(tmp_path.iterdir()) == []

    def test_what_the_system_refuses(self, tmp_path: Path) -> None:
        place = tmp_path / "place"
        with (
            pytest.raises(OutputError, match="place: cannot be written: No space left on device"),
            directory_beside(place),
        ):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        with (
            pytest.raises(OutputError, match="place: cannot be written: No such file"),
            directory_beside(tmp_path / "nowhere" / "place"),
        ):
            pass
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "file").touch()
        (tmp_path / "made").mkdir()
        with pytest.raises(OutputError, match="full: cannot be written: Directory not empty"):
            move_into_place([(tmp_path / "made", tmp_path / "full")])

    @pytest.mark.parametrize("directory", [False, True])
    def test_a_place_must_be_free(self, directory: bool, tmp_path: Path) -> None:
        require_free(tmp_path / "free", "--out", directory=directory)
        (tmp_path / "file").touch()
        (tmp_path / "link").symlink_to("nothing")
        for name in ("file", "link"):
            with pytest.raises(OutputError, match=rf"{name}: exists already; .* \(--out\)"):
                require_free(tmp_path / name, "--out", directory=directory)
        with pytest.raises(OutputError, match=r"holds files already|exists already"):
            require_free(tmp_path, "--out", directory=directory)
        with pytest.raises(OutputError, match="there is no directory"):
            require_free(tmp_path / "no" / "place", "--out", directory=directory)
        with pytest.raises(OutputError, match=r"there is no directory|Not a directory"):
            require_free(tmp_path / "file" / "place", "--out", directory=directory)
        (tmp_path / "empty").mkdir()
        if directory:
            require_free(tmp_path / "empty", "--out", directory=True)


class TestAtomicFiles:
    def test_text_bytes_and_lines(self, tmp_path: Path) -> None:
        path = tmp_path / "file"
        for content, expected in (
            ("θ", "θ"),
            (b"bytes", "bytes"),
            (iter(["a\n", "b\n"]), "a\nb\n"),
        ):
            write_atomically(path, content)
            assert path.read_text(encoding="utf-8") == expected
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]

    def test_a_failure_leaves_the_old_file_and_nothing_else(self, tmp_path: Path) -> None:
        path = tmp_path / "file"
        write_atomically(path, "old")

        def lines() -> list[str]:
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            write_atomically(path, (line for _ in range(1) for line in lines()))
        assert path.read_text() == "old"
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]

    def test_a_missing_directory_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match="missing/file: cannot be written: No such file"):
            write_atomically(tmp_path / "missing" / "file", "text")
