"""Which problems a service builds, and for whom it refuses to."""

from pathlib import Path
from typing import Any

import pytest
from tests.programs import said_by
from tests.unit.test_protocol_service import CODE, planning_of

from holdfast.config import registry
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.errors import ConfigurationError, OtherCodeError, UnknownProblemError
from holdfast.protocol.messages import SessionConfiguration
from holdfast.service.problem_factory import ProblemFactory


def opening(
    name: str, model: dict[str, Any] | None = None, seed: int = 0, code: tuple[str, ...] = CODE
) -> SessionConfiguration:
    return SessionConfiguration(name, model or {}, {}, planning_of(), seed, *code)


class TestProblemFactory:
    def test_built_in_problems(self) -> None:
        for name in registry.BUILT_IN:
            assert ProblemFactory()(opening(name)).name == name

    def test_settings_are_those_of_the_opening(self) -> None:
        built: Any = ProblemFactory()(opening("peg_in_hole_2d", {"peg_width": 2.0}))
        assert built.model.peg_width == 2.0

    @pytest.mark.parametrize(
        ("asked", "error", "message"),
        [
            (
                opening("peg_in_hole_2d", {"peg_width": -2.0}),
                ConfigurationError,
                r"model\.peg_width is -2\.0; expected",
            ),
            (
                opening("peg_in_hole_2d", {"peg_with": 2.0}),
                ConfigurationError,
                r"model\.peg_with.*did you mean peg_width",
            ),
            (opening("nix"), UnknownProblemError, r"problem nix: .*capsule_robot"),
            # Code of the robot's choice is not run.
            (
                opening("holdfast.problems.capsule_robot:CapsuleRobot"),
                UnknownProblemError,
                "--problem",
            ),
            (opening("capsule_robot", code=CODE[:1]), OtherCodeError, "not told on the robot"),
        ],
    )
    def test_what_is_refused(
        self, asked: SessionConfiguration, error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            ProblemFactory()(asked)

    def test_unknown_names_are_not_looked_for_each_time(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """To look through all that is installed takes as long as ten decisions."""
        looked: list[str] = []
        registered = registry.names()

        def names() -> list[str]:
            looked.append("names")
            return registered

        monkeypatch.setattr(registry, "names", names)
        monkeypatch.setattr(registry, "problem_class", looked.append)
        known = ProblemFactory()
        for number in range(20):
            with pytest.raises(UnknownProblemError, match=f"problem nobody_{number}: is not known"):
                known(opening(f"nobody_{number}"))
        assert looked == ["names"]

    def test_own_problem_that_was_named(self, tmp_path: Path) -> None:
        (tmp_path / "a_robot_of_ones_own.py").write_text(
            "from holdfast.problems.capsule_robot import CapsuleRobot\n"
            "class Mine(CapsuleRobot):\n    name = 'mine'\n"
        )
        name = "a_robot_of_ones_own:Mine"
        known = ProblemFactory([name], tmp_path)
        code = core_version(), problem_digest(registry.problem_class(name))
        assert known(opening(name, code=code)).name == "mine"
        # What is on the disk now is not what was loaded.
        module = tmp_path / "a_robot_of_ones_own.py"
        module.write_text(module.read_text() + "# changed\n")
        assert known(opening(name, code=code)).name == "mine"
        changed = problem_digest(registry.problem_class(name))
        with pytest.raises(OtherCodeError) as refused:
            known(opening(name, code=(code[0], changed)))
        for part in (name, code[1], changed, "deploy the same version"):
            assert part in str(refused.value)
        assert code[0] not in str(refused.value)

    @pytest.mark.parametrize("told", ["0.1.0+0123456789abcdef", ""])
    def test_other_holdfast(self, told: str) -> None:
        with pytest.raises(OtherCodeError) as refused:
            ProblemFactory()(opening("capsule_robot", code=(told, CODE[1])))
        for part in ("capsule_robot", core_version(), told or "not told"):
            assert part in str(refused.value)

    def test_unknown_name_at_the_start(self) -> None:
        with pytest.raises(UnknownProblemError, match="nix"):
            ProblemFactory(["nix"])

    def test_a_problem_is_built_anew_for_other_settings(self) -> None:
        known = ProblemFactory()
        assert known(opening("capsule_robot")) is not known(opening("capsule_robot", seed=1))

    def test_several_workers_build_their_first_problem_at_once(self) -> None:
        program = """
import sys, threading
from holdfast.config import registry
from holdfast.service.problem_factory import ProblemFactory
from holdfast.protocol.messages import SessionConfiguration
from holdfast.planning.settings import PlanningSettings
from holdfast.config.source_digest import core_version, problem_digest

code = core_version(), problem_digest(object)
sys.setswitchinterval(1e-6)
known = ProblemFactory()
barrier = threading.Barrier(4)
built = []

def build():
    for name in registry.BUILT_IN:
        barrier.wait()
        built.append(known(SessionConfiguration(name, {}, {}, PlanningSettings(), 0, *code)).name)

threads = [threading.Thread(target=build) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len(built) == 16
"""
        said_by(program)
