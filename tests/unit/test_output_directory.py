"""The directory of a command's findings."""

from pathlib import Path

import pytest

from holdfast.errors import OutputError
from holdfast.runtime.output_directory import claim_directory


class TestDirectory:
    def test_the_default_is_numbered(self, tmp_path: Path) -> None:
        claimed = [claim_directory(None, tmp_path / "runs", "demo") for _ in range(3)]
        assert [path.name for path in claimed] == ["demo", "demo-2", "demo-3"]
        assert all(path.is_dir() for path in claimed)

    def test_what_is_there_is_kept(self, tmp_path: Path) -> None:
        out = tmp_path / "a" / "out"
        assert claim_directory(out, tmp_path, "demo") == out
        assert claim_directory(out, tmp_path, "demo") == out
        (out / "file").touch()
        with pytest.raises(OutputError, match=r"out: holds files already.*--out"):
            claim_directory(out, tmp_path, "demo")

    def test_it_cannot_be_made(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        for out in (tmp_path / "file", tmp_path / "file" / "out"):
            with pytest.raises(OutputError, match="cannot be made"):
                claim_directory(out, tmp_path, "demo")
        with pytest.raises(OutputError, match="cannot be made"):
            claim_directory(None, tmp_path / "file", "demo")
