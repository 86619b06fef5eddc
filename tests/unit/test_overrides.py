"""Values that a command line gives instead of the file's: none is lost or contradicted."""

import typing
from pathlib import Path
from typing import Any

import msgspec
import pytest

from holdfast.cli import run
from holdfast.cli.overrides import combined, parse_assignment, parse_values
from holdfast.config import loader
from holdfast.config.loader import load
from holdfast.config.problem_builder import schemas_of
from holdfast.config.source import SETTINGS
from holdfast.errors import ConfigurationError, HoldfastError
from holdfast.problems.peg_in_hole_2d import PegInHole2D

SECTIONS: dict[str, type[msgspec.Struct]] = {**SETTINGS, **schemas_of(PegInHole2D)}
KEYS = [
    (section, field.encode_name)
    for section, schema in SECTIONS.items()
    for field in msgspec.structs.fields(schema)
    if field.encode_name != "state_size"  # which has one value
]
# Where a value next to the default would not do.
CHOSEN = {
    "offload.name": "anna",
    "offload.services": ["tcp/127.0.0.1:7001"],
    "offload.decision_deadline_ms": 17,
    "offload.tls": "credentials",
    "environment.object": "somebodys_robot",
    "environment.directory": "robots",
    "environment.arguments": {"port": 7},
    "selector.resolution": 0.25,
    "selector.estimator": "gaussian_mixture_upper",
    "selector.nats_per_cost": 0.25,
    "selector.path_offsets": [1, 3],
    "model.init_mean": [1, 2, 3],
    "model.init_cov": [1, 2, 3],
    "model.motion_cov": [1, 2, 3],
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    # A horizon goes with the entropy of the next action.
    text = "problem: peg_in_hole_2d\nselector: {method: action_entropy}\n"
    (tmp_path / "peg.yaml").write_text(text)
    return tmp_path / "peg.yaml"


def another_value(section: str, key: str, value: Any) -> Any:
    """Return a value that is allowed and is not the default."""
    if f"{section}.{key}" in CHOSEN:
        return CHOSEN[f"{section}.{key}"]
    hint = typing.get_type_hints(SECTIONS[section])[key]
    if typing.get_origin(hint) is typing.Literal:
        return typing.get_args(hint)[-1]
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    assert isinstance(value, float), f"{section}.{key} needs an entry in CHOSEN"
    return value / 2 or 0.5


def plain(loaded: loader.Configuration) -> dict[str, Any]:
    sections = msgspec.json.decode(msgspec.json.encode(loaded.plain()["configuration"]))
    assert isinstance(sections, dict)
    return sections


@pytest.mark.parametrize(("section", "key"), KEYS, ids=[".".join(names) for names in KEYS])
class TestEachKey:
    def test_a_value_arrives(self, section: str, key: str, path: Path) -> None:
        default = plain(load(path))
        value = another_value(section, key, default[section][key])
        assert value != default[section][key]
        text = msgspec.json.encode(value).decode()
        overrides = combined([parse_assignment(f"{section}.{key}={text}")])
        loaded = plain(load(path, overrides=overrides))
        if (section, key) == ("offload", "tls"):
            value = str(Path.cwd() / value)
        assert loaded[section][key] == value
        loaded[section][key] = default[section][key]
        assert loaded == default

    def test_the_command_refuses_a_value_that_is_not_allowed(
        self, section: str, key: str, path: Path
    ) -> None:
        value = "3" if (section, key) == ("environment", "arguments") else "{not: allowed}"
        with pytest.raises(HoldfastError, match=rf"^{section}\.{key}(\.not)?, given instead of "):
            run.main([str(path), "--set", f"{section}.{key}={value}"])


OPTIONS = [
    ("--trials", "3", "simulator.num_trials", "4"),
    ("--seed", "0", "simulator.seed", "1"),
    ("--recovery", "never", "recovery.launch", "at_start"),
    ("--tls", "keys", "offload.tls", "other"),
    ("--environment", "robot", "environment.object", "other"),
    ("--service", "tcp/127.0.0.1:7001", "offload.services", "[tcp/127.0.0.1:7002]"),
]


@pytest.mark.parametrize(("option", "given", "key", "other"), OPTIONS)
class TestAnOptionAndAnAssignment:
    def test_contradict_each_other(
        self, option: str, given: str, key: str, other: str, path: Path
    ) -> None:
        with pytest.raises(HoldfastError) as refused:
            run.main([str(path), option, given, "--set", f"{key}={other}"])
        assert str(refused.value) == (
            f"--set {key}={other} and {option} {given} contradict each other: both say what {key} "
            "is; leave one of them out"
        )

    def test_may_say_the_same(
        self, option: str, given: str, key: str, other: str, path: Path
    ) -> None:
        del other
        same = f"[{given}]" if option == "--service" else given
        arguments = [str(path), option, given, "--set", f"{key}={same}"]
        # Refused for another reason, for nothing shall run.
        with pytest.raises(HoldfastError, match="is_missing"):
            run.main([*arguments, "--set", "simulator.is_missing=1"])


@pytest.mark.parametrize(
    ("assignments", "expected"),
    [
        (["selector.method=random"], {"selector.method": "random"}),
        (["offload.tls=null"], {"offload.tls": None}),
        (["a.b=1", "a.b=1", "a.c=[x, 2]"], {"a.b": 1, "a.c": ["x", 2]}),
        ([" a.b =text=1"], {"a.b": "text=1"}),
        (["a.b[1].c=2", "a.b.0.c=3", "a.bc=1"], {"a.b.1.c": 2, "a.b.0.c": 3, "a.bc": 1}),
        (["problem_directory=."], {"problem_directory": "."}),
    ],
)
def test_assignments(assignments: list[str], expected: dict[str, object]) -> None:
    assert combined(map(parse_assignment, assignments)) == expected


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (["a.b=1", "a.b=true"], "contradict each other"),
        (["a.b"], "--set a.b: must be SECTION.KEY=VALUE"),
        (["a.b="], "--set a.b=: has no value"),
        (["a.b=[1"], "--set a.b, line 1"),
        (["a.b={c: 1}", "a.b.c=1"], "both say what a.b.c is"),
        (["a..b=1"], "--set a..b=1: must be SECTION.KEY=VALUE"),
        (["num_particles=9"], "did you mean particle_filter.num_particles=9?"),
        (["problem=a:B"], "that is --problem"),
    ],
)
def test_assignments_that_are_refused(assignments: list[str], message: str) -> None:
    with pytest.raises(HoldfastError) as refused:
        combined(map(parse_assignment, assignments))
    assert message in str(refused.value)


def test_what_needs_a_service_is_refused_without_one(path: Path) -> None:
    for words in (
        *(["--recovery", "never"], ["--set", "recovery.launch=never"]),
        *(["--tls", "keys"], ["--set", "offload.tls=keys"]),
    ):
        with pytest.raises(HoldfastError, match=f"^{' '.join(words)} needs --service"):
            run.main([str(path), *words])


def test_what_needs_an_environment_is_refused_without_one(path: Path) -> None:
    for words in ("environment.directory=x", "environment.arguments.port=3"):
        with pytest.raises(HoldfastError, match=f"^--set {words} needs --environment"):
            run.main([str(path), "--set", words])


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["-e", "dockin:Cart"], "--environment"),
        (["--set", "environment.object=dockin:Cart"], "--set environment.object"),
    ],
)
def test_a_class_that_is_not_there_is_a_complaint_about_the_option(
    words: list[str], option: str, path: Path
) -> None:
    with pytest.raises(ConfigurationError, match=rf"^{option}: dockin:Cart: the module dockin "):
        run.main([str(path), *words])


PLATES = """
problem: multitier_peg_in_hole_2d
model:
  holes:
    - {center: [4, 6], tol: 0.1, depth: 1.0}
    - {center: [-4, 0], tol: 0.1, depth: 1.0}
environment: {object: robots, arguments: {port: 5, encoder: true}}
"""


def set_in(path: Path, *assignments: str) -> dict[str, Any]:
    path.write_text(PLATES)
    return plain(load(path, overrides=combined(map(parse_assignment, assignments))))


def test_a_key_below_a_section_s_key_keeps_what_is_beside_it(path: Path) -> None:
    before = set_in(path)
    after = set_in(path, "environment.arguments.encoder=false", "model.holes[1].tol=0.3")
    assert after["environment"]["arguments"] == {"port": 5, "encoder": False}
    assert [hole["tol"] for hole in after["model"]["holes"]] == [0.1, 0.3]
    after["environment"]["arguments"]["encoder"] = True
    after["model"]["holes"][1]["tol"] = 0.1
    assert after == before
    assert set_in(path, "environment.arguments.name=x")["environment"]["arguments"]["port"] == 5


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("model.holes.2.tol=1", r"model.holes is \[.*; set all of it: --set 'model.holes=\.\.\.'"),
        ("environment.arguments.port.x=1", "environment.arguments.port is 5; set all of it"),
        ("environment.argument.port=1", "^environment.argument is not .*; did you mean arguments"),
        ("environment.arguments.noise.x=1", "noise is not in the file; set all of it"),
        ("model.holes[0].width=1", r"^model.holes\[0\].width is not a known key"),
        ("model.holes.0.tol=x", r"^model.holes\[0\].tol, given instead of what .* is \"x\""),
    ],
)
def test_a_key_below_that_cannot_be_set(assignment: str, message: str, path: Path) -> None:
    with pytest.raises(ConfigurationError, match=message):
        set_in(path, assignment)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("random, path_entropy", ["random", "path_entropy"]),
        ("[0, 1],[0, 2]", [[0, 1], [0, 2]]),
        ("null,0.5", [None, 0.5]),
        ("{a: 1, b: 2}", [{"a": 1, "b": 2}]),
    ],
)
def test_several_values(text: str, values: list[Any]) -> None:
    found = parse_values(f"selector.method={text}")
    assert found == (f"--set selector.method={text}", "selector.method", values)


@pytest.mark.parametrize("text", ["selector=1,2", "selector.method="])
def test_several_values_need_a_key(text: str) -> None:
    with pytest.raises(HoldfastError, match=f"--set {text.partition('=')[0]}="):
        parse_values(text)
