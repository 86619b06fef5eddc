"""Complaints about a configuration name the file, the line, the key and what is allowed."""

from pathlib import Path
from typing import Any

import pytest

from holdfast.config.problem_builder import find_problem
from holdfast.config.source import Source, module_directory
from holdfast.config.yaml_document import read
from holdfast.errors import ConfigurationError
from holdfast.planning.settings import SelectorSettings, SimulatorSettings

PATH = Path("run.yaml")


def source(text: str, overrides: dict[str, Any] | None = None) -> Source:
    return Source(read(text.encode(), str(PATH)), PATH, overrides or {})


def test_a_value_given_instead_has_no_line() -> None:
    given = source("simulator: {seed: 1}", {"simulator.seed": "x"})
    with pytest.raises(ConfigurationError, match=r"^simulator\.seed, given instead of "):
        given.section("simulator", SimulatorSettings)
    assert given.directory_of(("simulator", "seed")) == Path.cwd()


def test_names_that_earlier_releases_had_are_those_of_today() -> None:
    text = "problem: holdfast.lab.studies.x:X\nenvironment: {object: holdfast.lab.y:Y}"
    named = source(text)
    assert named.problem == "studies.x:X"
    assert named.sections["environment"] == {"object": "holdfast_lab.y:Y"}
    given = source(text, {"environment.object": "holdfast.lab.z:Z"})
    assert given.sections["environment"]["object"] == "holdfast_lab.z:Z"
    assert source("problem: holdfast.laboratory:R").problem == "holdfast.laboratory:R"
    with pytest.raises(ConfigurationError, match="problem is 3"):
        find_problem(source("problem: 3"), None)
    for named in (
        source("selector: {rollout_looks: 7}"),
        source("selector: {}", {"selector.rollout_looks": 7}),
    ):
        assert named.section("selector", SelectorSettings).rollout_sensing_steps == 7
    with pytest.raises(ConfigurationError, match="rollout_looks is not a known key"):
        source("selector: {rollout_looks: 7, rollout_sensing_steps: 6}").section(
            "selector", SelectorSettings
        )


def test_the_directory_of_a_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "lamp_module.py").write_text("")
    here = source("problem_directory: own")
    key = ("problem_directory",)
    assert module_directory(here, key, "own", "lamp_module.inner") == tmp_path / "own"
    assert module_directory(here, key, None, "lamp_module") is None
    for value, reason in (("none", "there is no directory"), (".", "there is no module lamp")):
        with pytest.raises(ConfigurationError, match=reason):
            module_directory(here, key, value, "lamp_module")
