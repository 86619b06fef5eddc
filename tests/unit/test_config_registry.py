"""Problems by name."""

from pathlib import Path

import pytest

from holdfast.config import registry
from holdfast.errors import UnknownProblemError
from holdfast.problems.capsule_robot import CapsuleRobot


class TestRegistry:
    def test_finds_an_importable_class(self) -> None:
        name = "holdfast.problems.capsule_robot:CapsuleRobot"
        assert registry.problem_class(name) is CapsuleRobot

    def test_finds_a_file_in_the_directory(self, tmp_path: Path) -> None:
        (tmp_path / "a_problem_in_a_file.py").write_text("class Mine:\n    pass\n")
        name = "a_problem_in_a_file:Mine"
        with pytest.raises(UnknownProblemError, match="a_problem_in_a_file"):
            registry.problem_class(name)
        assert registry.problem_class(name, tmp_path).__name__ == "Mine"

    def test_an_unknown_name_is_answered_with_close_and_all_names(self) -> None:
        with pytest.raises(
            UnknownProblemError, match=r"peg_in_hole_2.*did you mean.*peg_in_hole_2d.*capsule_robot"
        ):
            registry.problem_class("peg_in_hole_2")

    def test_an_unknown_class(self) -> None:
        with pytest.raises(UnknownProblemError, match=r"has no PegInHole.*PegInHole2D"):
            registry.problem_class("holdfast.problems.peg_in_hole_2d:PegInHole")

    def test_not_a_class(self) -> None:
        with pytest.raises(UnknownProblemError, match="not a class but function"):
            registry.problem_class("holdfast.config.registry:names")

    @pytest.mark.parametrize("name", ["", ":", "a:", ":b", "a b:c", "../a:b"])
    def test_not_a_name(self, name: str) -> None:
        with pytest.raises(UnknownProblemError):
            registry.problem_class(name)


def test_signature_keys_tell_one_problem_alone() -> None:
    for name, own in registry.BUILT_IN.items():
        keys = set(registry.problem_class(name).Model.__struct_fields__)
        told = [other for other, each in registry.BUILT_IN.items() if each.signature_keys <= keys]
        assert own.signature_keys <= keys
        assert told == [name]
