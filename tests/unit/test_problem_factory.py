"""Which problems a service builds, and for whom it refuses to."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.unit.test_protocol_service import CODE, planning_of

from holdfast.config import registry
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.errors import ConfigurationError, OtherCodeError, UnknownProblemError
from holdfast.protocol.messages import SessionConfiguration
from holdfast.service.problem_factory import ProblemFactory


class TestProblemFactory:
    def test_built_in_problems(self) -> None:
        for name in registry.BUILT_IN:
            assert (
                ProblemFactory()(SessionConfiguration(name, {}, {}, planning_of(), 0, *CODE)).name
                == name
            )

    def test_settings_are_those_of_the_opening(self) -> None:
        session_configuration = SessionConfiguration(
            "peg_in_hole_2d", {"peg_width": 2.0}, {}, planning_of(), 0, *CODE
        )
        built: Any = ProblemFactory()(session_configuration)
        assert built.model.peg_width == 2.0

    def test_settings_that_do_not_fit_are_explained(self) -> None:
        session_configuration = SessionConfiguration(
            "peg_in_hole_2d", {"peg_width": -2.0}, {}, planning_of(), 0, *CODE
        )
        with pytest.raises(ConfigurationError, match=r"model\.peg_width is -2\.0; expected"):
            ProblemFactory()(session_configuration)

    def test_unknown_keys_are_explained(self) -> None:
        session_configuration = SessionConfiguration(
            "peg_in_hole_2d", {"peg_with": 2.0}, {}, planning_of(), 0, *CODE
        )
        with pytest.raises(ConfigurationError, match=r"model\.peg_with.*did you mean peg_width"):
            ProblemFactory()(session_configuration)

    def test_unknown_name(self) -> None:
        with pytest.raises(UnknownProblemError, match=r"problem nix: .*capsule_robot"):
            ProblemFactory()(SessionConfiguration("nix", {}, {}, planning_of(), 0, *CODE))

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
                known(SessionConfiguration(f"nobody_{number}", {}, {}, planning_of(), 0, *CODE))
        assert looked == ["names"]

    def test_code_of_the_robots_choice_is_not_run(self, tmp_path: Path) -> None:
        session_configuration = SessionConfiguration(
            "holdfast.problems.capsule_robot:CapsuleRobot", {}, {}, planning_of(), 0, *CODE
        )
        with pytest.raises(UnknownProblemError, match="--problem"):
            ProblemFactory()(session_configuration)

    def test_own_problem_that_was_named(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys, "path", sys.path.copy())
        (tmp_path / "a_robot_of_ones_own.py").write_text(
            "from holdfast.problems.capsule_robot import CapsuleRobot\n"
            "class Mine(CapsuleRobot):\n    name = 'mine'\n"
        )
        name = "a_robot_of_ones_own:Mine"
        known = ProblemFactory([name], tmp_path)
        code = core_version(), problem_digest(registry.problem_class(name))
        assert known(SessionConfiguration(name, {}, {}, planning_of(), 0, *code)).name == "mine"
        # What is on the disk now is not what was loaded.
        module = tmp_path / "a_robot_of_ones_own.py"
        module.write_text(module.read_text() + "# changed\n")
        assert known(SessionConfiguration(name, {}, {}, planning_of(), 0, *code)).name == "mine"
        changed = problem_digest(registry.problem_class(name))
        with pytest.raises(OtherCodeError) as refused:
            known(SessionConfiguration(name, {}, {}, planning_of(), 0, code[0], changed))
        for part in (name, code[1], changed, "deploy the same version"):
            assert part in str(refused.value)
        assert code[0] not in str(refused.value)

    @pytest.mark.parametrize("told", ["0.1.0+0123456789abcdef", ""])
    def test_other_holdfast(self, told: str) -> None:
        session_configuration = SessionConfiguration(
            "capsule_robot", {}, {}, planning_of(), 0, told, CODE[1]
        )
        with pytest.raises(OtherCodeError) as refused:
            ProblemFactory()(session_configuration)
        for part in ("capsule_robot", core_version(), told or "not told"):
            assert part in str(refused.value)

    def test_digest_that_is_not_told(self) -> None:
        session_configuration = SessionConfiguration(
            "capsule_robot", {}, {}, planning_of(), 0, CODE[0]
        )
        with pytest.raises(OtherCodeError, match="not told on the robot"):
            ProblemFactory()(session_configuration)

    def test_unknown_name_at_the_start(self) -> None:
        with pytest.raises(UnknownProblemError, match="nix"):
            ProblemFactory(["nix"])

    def test_a_problem_is_built_anew_for_other_settings(self) -> None:
        session_configuration = SessionConfiguration(
            "capsule_robot", {}, {}, planning_of(), 0, *CODE
        )
        known = ProblemFactory()
        assert known(session_configuration) is not known(
            msgspec.structs.replace(session_configuration, seed=1)
        )

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
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
