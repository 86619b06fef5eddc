"""The journal of a ROS 1 master, and the state that is read from it."""

from __future__ import annotations

import copy
import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.master_state import known

from ros1_master_guard.process import (
    MasterJournal,
    MasterState,
    parameter_names,
    read_journal,
    write_journal,
)


class TestParameters:
    def test_a_value_gives_way_to_a_namespace(self) -> None:
        state = MasterState()
        for key, value in (("/a", 1), ("/a/b/", 2), ("/a/c", {"d": 3}), ("/e", 4), ("/e", None)):
            state.apply("parameters", key, value)
        assert state.parameters == {"a": {"b": 2, "c": {"d": 3}}}
        assert parameter_names(state.parameters) == ["/a/b", "/a/c/d"]
        state.apply("parameters", "/", {"f": 5})
        assert state.parameters == {"f": 5}


class TestJournal:
    def test_there_is_none(self, tmp_path: Path) -> None:
        assert read_journal(tmp_path / "none") is None

    def test_what_is_there_and_cannot_be_read_is_said(self, tmp_path: Path) -> None:
        (tmp_path / "other").write_bytes(b"something else")
        with pytest.raises(ValueError, match="no journal"):
            read_journal(tmp_path / "other")
        (tmp_path / "empty").touch()
        with pytest.raises(ValueError, match="no journal"):
            read_journal(tmp_path / "empty")
        with pytest.raises(IsADirectoryError):
            read_journal(tmp_path)

    @pytest.mark.parametrize("by", ["a look", "a change"])
    @pytest.mark.parametrize("loss", ["file", "directory", "truncated", "another"])
    def test_it_is_written_anew_when_it_is_gone(self, tmp_path: Path, loss: str, by: str) -> None:
        path = tmp_path / "guard" / "journal"
        journal = MasterJournal(path, known())
        if loss == "file":
            path.unlink()
        elif loss == "directory":
            shutil.rmtree(path.parent)
        elif loss == "truncated":
            os.truncate(path, 10)
        else:
            path.unlink()
            path.write_bytes(b"another")
        expected = known()
        if by == "a look":
            journal.look()
        else:
            journal.write("types", "/a", "x/Y")
            expected.types["/a"] = "x/Y"
        journal.close()
        assert read_journal(path) == expected
        assert path.parent.stat().st_mode & 0o777 == 0o700

    def test_a_look_keeps_it_young(self, tmp_path: Path) -> None:
        journal = MasterJournal(tmp_path / "journal", known())
        os.utime(tmp_path / "journal", (0, 0))
        journal.look()
        journal.close()
        assert (tmp_path / "journal").stat().st_mtime > 0

    def test_a_removed_one_that_is_open_can_be_read(self, tmp_path: Path) -> None:
        write_journal(tmp_path / "journal", known())
        with (tmp_path / "journal").open("rb") as file:
            (tmp_path / "journal").unlink()
            for _ in range(2):
                assert read_journal(file.fileno()) == known()

    def test_that_it_cannot_be_written_is_said_once(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "guard" / "journal"
        journal = MasterJournal(path, known())
        shutil.rmtree(path.parent)
        path.parent.touch()
        for number in range(3):
            journal.write("parameters", "/a", number)
            journal.look()
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "changes are not written down" in said
        path.parent.unlink()
        journal.look()
        assert "written down again" in capsys.readouterr().err
        journal.close()
        found = read_journal(path)
        assert found is not None
        assert found.parameters["a"] == 2

    def test_it_is_not_written_through_a_link(self, tmp_path: Path) -> None:
        (tmp_path / "precious").write_text("mine")
        (tmp_path / "journal.new").symlink_to(tmp_path / "precious")
        write_journal(tmp_path / "journal", known())
        assert (tmp_path / "precious").read_text() == "mine"
        assert read_journal(tmp_path / "journal") == known()

    def test_it_is_written_and_read(self, tmp_path: Path) -> None:
        path = tmp_path / "journal"
        write_journal(path, known())
        assert read_journal(path) == known()
        assert path.stat().st_mode & 0o777 == 0o600
        assert [each.name for each in tmp_path.iterdir()] == ["journal"]

    @given(
        st.lists(
            st.one_of(
                st.tuples(
                    st.just("parameters"),
                    st.sampled_from(["/a", "/a/b", "/c", "/"]),
                    st.dictionaries(st.sampled_from("abc"), st.integers(), max_size=2),
                ),
                st.tuples(
                    st.sampled_from(["publishers", "subscribers", "parameter_subscribers"]),
                    st.sampled_from(["/x", "/y"]),
                    st.none()
                    | st.lists(st.tuples(st.sampled_from("ab"), st.just("u")), min_size=1),
                ),
                st.tuples(
                    st.just("services"),
                    st.sampled_from(["/x", "/y"]),
                    st.none() | st.tuples(st.just("n"), st.just("u"), st.text()),
                ),
                st.tuples(st.just("types"), st.sampled_from(["/x", "/y"]), st.text()),
            ),
            max_size=20,
        ),
        st.integers(0, 10_000),
    )
    def test_cut_anywhere_it_holds_what_was_whole(
        self, changes: list[tuple[str, str, Any]], cut: int
    ) -> None:
        import tempfile

        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "journal"
            journal = MasterJournal(path, MasterState())
            begun = path.stat().st_size
            state = MasterState()
            after = [(begun, copy.deepcopy(state))]
            for change in changes:
                journal.write(*change)
                state.apply(*copy.deepcopy(change))
                after.append((path.stat().st_size, copy.deepcopy(state)))
            journal.close()
            assert read_journal(path) == state
            size = min(begun + cut, after[-1][0])
            os.truncate(path, size)
            assert read_journal(path) == [whole for end, whole in after if end <= size][-1]

    def test_it_is_written_anew_before_it_grows_large(self, tmp_path: Path) -> None:
        path = tmp_path / "journal"
        journal = MasterJournal(path, known())
        value = "x" * 100_000
        for number in range(200):
            journal.write("parameters", "/large", f"{number}{value}")
            assert path.stat().st_size < 6_000_000
        journal.close()
        expected = known()
        expected.apply("parameters", "/large", f"199{value}")
        assert read_journal(path) == expected

    def test_after_a_full_disk_it_is_written_anew(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "journal"
        journal = MasterJournal(path, known())
        with monkeypatch.context() as patch:
            # A disk takes what there is room for.
            patch.setattr(os, "write", lambda _, data, write=os.write: write(_, data[:9]))
            journal.write("types", "/a", "x/Y")
        assert str(path) in capsys.readouterr().err
        assert read_journal(path) == known()
        journal.write("types", "/b", "x/Y")
        journal.close()
        expected = known()
        expected.types |= {"/a": "x/Y", "/b": "x/Y"}
        assert read_journal(path) == expected

    def test_no_code_comes_out_of_it(self, tmp_path: Path) -> None:
        path = tmp_path / "journal"
        journal = MasterJournal(path, known())
        journal.write("parameters", "/evil", Path("x"))
        journal.write("parameters", "/good", 1)
        journal.close()
        found = read_journal(path)
        assert found is not None
        assert found.parameters == {**known().parameters, "good": 1}

    def test_what_cannot_be_written_down_costs_nobody_anything(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        journal = MasterJournal(tmp_path / "journal", known())
        journal.write("parameters", "/no", lambda: None)
        journal.close()
        assert "cannot be written down" in capsys.readouterr().err
        assert read_journal(tmp_path / "journal") == known()

    def test_it_takes_old_pythons_pickles_alone(self, tmp_path: Path) -> None:
        # ROS's Python may be 3.8, the guard's is newer; both read the same file.
        path = tmp_path / "journal"
        write_journal(path, known())
        assert b"\x80\x04" in path.read_bytes()
        assert pickle.HIGHEST_PROTOCOL > 4
