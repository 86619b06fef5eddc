"""The configuration file: what loads, to what, and what every mistake in it is answered with."""

import pickle
import re
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.answers import answers_in

from holdfast.config import registry
from holdfast.config.loader import Configuration, load
from holdfast.errors import ConfigurationError, UnknownProblemError
from holdfast.planning.settings import EnvironmentSettings, OffloadSettings, RecoverySettings

EXAMPLES = Path(__file__).parents[2] / "examples"

# The thesis's file for peg-in-hole, key by key, without anything of ours.
THESIS = """\
model:
  state_size: 3
  peg_width: 1
  peg_height: 2
  hole_tolerance: 0.1
  init_mean: [4, 2, 0]
  init_cov: [2, 1, 1.57]
  motion_cov: [0.01, 0.01, 0.01]
  sensing_cov: 0.001
  collision_tol: 0.001
particle_filter:
  num_particles: 100
state_space_planner:
  translation_step_size: 0.1
  rotation_step_size: 0.1
active_sensing:
  horizon: 1
  discount: 1.0
  num_observation_samples: 10
  num_nearest_neighbors: 5
  num_cores: 8
simulator:
  num_trials: 10
  max_steps: 700
  sensing_intervals: 8
  verbosity: 0
"""

# A user's problem beside the configuration: once with keyword arguments, once with structs.
LAMPS = """\
from typing import Annotated

import msgspec
import numpy as np

from holdfast.problems.problem import ProblemBase


class Lamp(msgspec.Struct, forbid_unknown_fields=True):
    center: tuple[float, float]
    height: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0


class Model(msgspec.Struct, forbid_unknown_fields=True):
    colour: str = "red"
    lamps: Annotated[list[Lamp], msgspec.Meta(min_length=1)] = msgspec.field(
        default_factory=lambda: [Lamp((0.0, 0.0))]
    )
    weights: dict[str, float] = {}


class Planner(msgspec.Struct, forbid_unknown_fields=True):
    gain: Annotated[float, msgspec.Meta(ge=0.0, le=10.0)] = 1.0


class Keywords(ProblemBase):
    name = "lamps"
    state_size = action_size = 1
    sensing_actions = ("left", "right")

    def __init__(self, gain=1.0, brightness=(1, 2), colour="red", lamps=None, places=((0, 1),)):
        if gain < 0.0:
            raise ValueError(f"gain is {gain}; it must not be negative")
        self.gain = gain
        self.colour = colour
        self.brightness = brightness
        self.places = places

    def initial_states(self, stream, count): return np.zeros((count, 1))
    def move(self, states, actions, stream): return states + actions
    def observation_mean(self, states, sensing_action): return states
    def observation_variance(self, states, sensing_action): return np.ones(1)
    def policy(self, states, stage): return -self.gain * states
    def is_goal(self, states): return np.abs(states[..., 0]) < 0.1


class Structs(Keywords):
    Model = Model
    StateSpacePlanner = Planner

    @classmethod
    def from_settings(cls, model, state_space_planner):
        return cls(
            gain=msgspec.convert(state_space_planner, Planner).gain,
            colour=msgspec.convert(model, Model).colour,
        )


class Unfinished(ProblemBase):
    state_size = 1


class Arrays(Keywords):
    def __init__(self, gain=1.0, matrix=np.eye(2), limit=float("inf")):
        super().__init__(gain)


class Broken(Keywords):
    def __init__(self, gain=1.0):
        {}["absent"]


class WrongTypes(Keywords):
    def __init__(self, gain=1.0):
        gain + "one"
"""

# A user's environment beside the configuration; it must not be imported to load that.
ROBOT = "raise RuntimeError('imported')"

PEG = "problem: peg_in_hole_2d\n"

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    monkeypatch.delitem(sys.modules, "lamps", raising=False)

    def write_file(text: str) -> Path:
        (tmp_path / "lamps.py").write_text(LAMPS)
        (tmp_path / "own_robot.py").write_text(ROBOT)
        path = tmp_path / "run.yaml"
        path.write_text(textwrap.dedent(text), encoding="utf-8")
        return path

    return write_file


def complaint(path: Path, **arguments: Any) -> str:
    """Load a file that cannot be used and return the message, which is one or two lines."""
    with pytest.raises(ConfigurationError) as caught:
        load(path, **arguments)
    message = str(caught.value)
    assert message.count("\n") <= 1, message
    return message


class TestWhatLoads:
    def test_the_thesis_example_has_exactly_the_thesis_keys_and_values(self) -> None:
        example = yaml.safe_load((EXAMPLES / "thesis.yaml").read_text(encoding="utf-8"))
        assert example.pop("problem") == "peg_in_hole_2d"
        assert example.pop("selector") == {
            "method": "action_entropy",
            "estimator": "nearest_neighbor",
        }
        assert example == yaml.safe_load(THESIS)

    @pytest.mark.parametrize("path", sorted(EXAMPLES.rglob("*.yaml")), ids=lambda path: path.stem)
    def test_an_example_loads_and_is_told_by_its_keys(self, path: Path, write: Write) -> None:
        named = load(path)
        text = path.read_text(encoding="utf-8")
        if ":" in named.problem_name:  # a user's own problem can only be named
            return
        inferred = load(write(re.sub(r"(?m)^problem: .*$", "", text)))
        assert inferred == named

    @pytest.mark.parametrize("name", registry.names())
    def test_nothing_but_the_name(self, name: str, write: Write) -> None:
        configuration = load(write(f"problem: {name}"))
        assert configuration.problem.name == name
        assert configuration.planning.particle_filter.num_particles == 300

    def test_an_empty_section_has_its_defaults(self, write: Write) -> None:
        empty = load(write("problem: peg_in_hole_2d\nmodel:\nsimulator: ~\nselector: {}"))
        assert empty == load(write("problem: peg_in_hole_2d"))

    @pytest.mark.parametrize("text", ["1e-3", "1E-3", ".001", "0.001", "1.0e-03", "+1e-3"])
    def test_every_spelling_of_a_number(self, text: str, write: Write) -> None:
        configuration = load(write(f"problem: peg_in_hole_2d\nmodel: {{sensing_cov: {text}}}"))
        assert configuration.model["sensing_cov"] == 1e-3

    def test_a_byte_order_mark_and_anchors(self, write: Write) -> None:
        path = write(
            "\ufeffproblem: peg_in_hole_2d\nmodel: {init_cov: &c [1, 1, 1], motion_cov: *c}"
        )
        assert load(path).model["motion_cov"] == load(path).model["init_cov"]


class TestProblemDirectory:
    """Where the module of a problem of one's own is looked for."""

    @staticmethod
    def elsewhere(path: Path, text: str) -> Path:
        """Write a file into a directory that holds no module."""
        directory = path.parent / "elsewhere"
        directory.mkdir(exist_ok=True)
        (directory / "config.yaml").write_text(text)
        return directory / "config.yaml"

    def test_a_resolved_file_loads_from_anywhere(self, write: Write) -> None:
        path = write("problem: lamps:Keywords")
        configuration = load(path)
        assert configuration.problem_directory == path.parent
        again = load(self.elsewhere(path, configuration.to_yaml()))
        assert again == configuration
        assert again.to_yaml() == configuration.to_yaml()

    def test_it_may_be_relative_to_the_file(self, write: Write) -> None:
        path = write("")
        found = load(
            self.elsewhere(path, "problem: lamps:Keywords\nproblem_directory: ..")
        ).problem_directory
        assert found == path.parent

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("lamps:Keywords\nproblem_directory: absent", 'is "absent", where there is no direc'),
            ("lamps:Keywords\nproblem_directory: empty", 'is "empty", where there is no module'),
            ("lamps:Keywords\nproblem_directory: 3", "is 3; expected the path of a directory"),
            ("capsule_robot\nproblem_directory: .", 'is "."; only a problem that is named'),
        ],
    )
    def test_what_is_refused(self, text: str, expected: str, write: Write) -> None:
        path = write(f"problem: {text}")
        (path.parent / "empty").mkdir()
        assert f"line 2: problem_directory {expected}" in complaint(path)


class TestResolution:
    """One for each coordinate, in a file."""

    @pytest.mark.parametrize("method", ["action_entropy", "state_entropy", "action_covariance"])
    def test_another_number_is_refused_with_its_line(self, method: str, write: Write) -> None:
        text = f"problem: peg_in_hole_2d\nselector:\n  method: {method}\n  resolution: [1, 2]"
        message = complaint(write(text))
        assert "line 4: selector.resolution is [1.0, 2.0], 2 numbers; need one number" in message
        assert "3 for peg_in_hole_2d, one for each coordinate of " in message

    def test_another_number_that_was_given_instead_of_the_files(self, write: Write) -> None:
        path = write("problem: peg_in_hole_2d\nselector: {resolution: [1, 2, 3]}")
        with pytest.raises(ConfigurationError) as refused:
            load(path, overrides={"selector.resolution": [0.1]})
        assert str(refused.value).startswith(
            f"selector.resolution, given instead of what {path} says, is [0.1], 1 numbers; need "
        )

    @pytest.mark.parametrize("method", ["random", "fixed"])
    def test_where_nothing_is_measured_it_has_no_effect(self, method: str, write: Write) -> None:
        load(write(f"problem: capsule_robot\nselector: {{method: {method}, resolution: [1]}}"))


class TestResolved:
    @pytest.mark.parametrize(
        "text",
        [
            THESIS,
            "problem: capsule_robot\nselector: {method: fixed, sensing_action: 1, resolution: 1e-7}"
            "\nsimulator: {sensing_intervals: 0}",
            "problem: capsule_robot\nselector: {resolution: [0.1, 2]}",
            "problem: multitier_peg_in_hole_2d\nsimulator: {seed: 9223372036854775807}",
            "problem: lamps:Keywords\nmodel: {colour: '1e-3', lamps: [1, null, {a: 'yes'}]}",
            "problem: lamps:Structs\nmodel: {lamps: [{center: [0.1, 1e22]}], weights: {'1': 2}}",
        ],
        ids=["thesis", "capsule", "resolutions", "multitier", "keywords", "structs"],
    )
    def test_it_loads_to_the_same(self, text: str, write: Write) -> None:
        configuration = load(write(text))
        again = load(write(configuration.to_yaml()))
        assert again == configuration
        assert again.to_yaml() == configuration.to_yaml()

    def test_every_default_is_written(self, write: Write) -> None:
        resolved = yaml.safe_load(load(write("problem: peg_in_hole_2d")).to_yaml())
        assert resolved["problem"] == "peg_in_hole_2d"
        assert resolved["model"]["peg_height"] == 2
        assert resolved["state_space_planner"] == {
            "translation_step_size": 0.1,
            "rotation_step_size": 0.1,
        }
        assert resolved["selector"]["method"] == "path_entropy"
        assert resolved["selector"]["resolution"] is None
        assert resolved["simulator"]["seed"] == 0

    def test_defaults_of_keyword_arguments_are_written_where_yaml_holds_them(
        self, write: Write
    ) -> None:
        resolved = load(write("problem: lamps:Keywords\nstate_space_planner: {gain: 2}")).to_yaml()
        assert yaml.safe_load(resolved)["model"] == {
            "brightness": [1, 2],
            "colour": "red",
            "lamps": None,
            "places": [[0, 1]],
        }
        assert "Not listed" not in resolved

    def test_defaults_that_yaml_cannot_hold_are_named_in_a_comment(self, write: Write) -> None:
        resolved = load(write("problem: lamps:Arrays")).to_yaml()
        assert yaml.safe_load(resolved)["model"] == {"gain": 1.0}
        assert "# model.matrix, model.limit\n" in resolved
        assert load(write(resolved)).to_yaml() == resolved

    def test_a_constructor_gets_tuples_where_its_defaults_are_tuples(self, write: Write) -> None:
        first = load(write("problem: lamps:Keywords")).problem
        again = load(write(load(write("problem: lamps:Keywords")).to_yaml())).problem
        other = load(write("problem: lamps:Keywords\nmodel: {places: [[1, 2], [3, 4]]}")).problem
        for problem in (first, again):
            assert problem.brightness == (1, 2)  # type: ignore[attr-defined]
            assert problem.places == ((0, 1),)  # type: ignore[attr-defined]
        assert other.places == ((1, 2), (3, 4))  # type: ignore[attr-defined]

    @pytest.mark.parametrize("text", [THESIS, "problem: lamps:Keywords"], ids=["thesis", "lamps"])
    def test_another_process_rebuilds_it(self, text: str, write: Write) -> None:
        configuration = load(write(text), seed=7)
        plain = pickle.loads(pickle.dumps(configuration.plain()))
        again = Configuration.from_plain(plain)
        assert again == configuration
        assert again.path.samefile(configuration.path)
        assert type(again.problem) is type(configuration.problem)

    def test_other_plain_data_is_refused(self) -> None:
        with pytest.raises(ConfigurationError, match="path and configuration"):
            Configuration.from_plain({"problem": "peg_in_hole_2d"})


class TestFiles:
    def test_missing(self, tmp_path: Path) -> None:
        assert "absent.yaml: there is no such file" in complaint(tmp_path / "absent.yaml")

    def test_directory(self, tmp_path: Path) -> None:
        assert f"{tmp_path}: is a directory" in complaint(tmp_path)

    def test_a_name_that_no_file_can_have(self) -> None:
        assert "cannot be read" in complaint(Path("a\0b"))

    def test_not_utf8(self, tmp_path: Path) -> None:
        path = tmp_path / "run.yaml"
        path.write_bytes(b"problem: peg_in_hole_2d\n# caf\xe9\n")
        assert "run.yaml, line 2: not UTF-8 text (byte 0xe9" in complaint(path)

    def test_too_large(self, tmp_path: Path) -> None:
        path = tmp_path / "run.yaml"
        path.write_bytes(b"#" * (1024 * 1024 + 1))
        assert "run.yaml: over 1048576 bytes" in complaint(path)


LONG = "model: [" + "1," * 100_001 + "]"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *answers_in("config_mistakes.txt"),
        # What would be too long there, or cannot be seen.
        ("model:\n  a: '\x01'\n", "line 2: not YAML: the character U+0001 is not allowed"),
        ("", "run.yaml: is empty; a configuration has the sections model,"),
        (f"simulator: {{seed: {'9' * 5000}}}", "does not fit into 64 bits"),
        (f"{PEG}simulator: {{seed: {'x' * 500}}}", f'is "{"x" * 56}...; expected a whole number'),
        ("[" * 100_000, "more than 32 levels"),
        pytest.param(LONG, "more than 100000 keys and values", marks=pytest.mark.slow),
    ],
)
def test_what_a_mistake_is_answered_with(text: str, expected: str, write: Write) -> None:
    assert expected in complaint(write(text))


class TestKeysAndValues:
    def test_no_control_character_reaches_the_terminal(self, write: Write) -> None:
        message = complaint(write('problem: peg_in_hole_2d\nsimulator: {"\\e[2J": "\\e[2J"}'))
        assert "\x1b" not in message
        message = complaint(write('problem: peg_in_hole_2d\nsimulator: {seed: "\\e[2J"}'))
        assert "\x1b" not in message

    def test_what_is_given_as_an_argument(self, write: Write) -> None:
        message = complaint(write("problem: peg_in_hole_2d\nsimulator: {seed: 3}"), seed=-1)
        assert re.match(
            r"simulator\.seed, given instead of what .*run\.yaml says, is -1; ", message
        )
        assert "num_trials, given instead" in complaint(write(THESIS), num_trials=0)


class TestTwoKeys:
    def test_no_fewer_observation_samples_than_to_begin_with(self, write: Write) -> None:
        text = "problem: peg_in_hole_2d\nactive_sensing: {num_observation_samples: 21}\n"
        text += "selector:\n  max_observation_samples: %d\n  method: "
        message = complaint(write(text % 20 + "expected_return"))
        assert "line 4: selector.max_observation_samples is 20; with" in message
        assert "at least active_sensing.num_observation_samples, which is 21" in message
        load(write(text % 21 + "expected_return"))
        load(write(text % 20 + "path_entropy"))

    def test_neighbours_need_as_many_other_particles(self, write: Write) -> None:
        text = "problem: peg_in_hole_2d\nselector: {estimator: nearest_neighbor}\n"
        text += "particle_filter: {num_particles: %d}\n"
        message = complaint(write(text % 5 + "active_sensing:\n  num_nearest_neighbors: 5"))
        assert "line 5: active_sensing.num_nearest_neighbors is 5;" in message
        assert "below particle_filter.num_particles, which is 5" in message
        assert "is 5;" in complaint(write(text % 4))  # The default breaks it as well.
        assert load(write(text % 6)).planning.particle_filter.num_particles == 6

    def test_a_fixed_sensing_action_exists(self, write: Write) -> None:
        text = "problem: peg_in_hole_2d\nselector: {method: %s, sensing_action: %d}"
        message = complaint(write(text % ("fixed", 3)))
        assert "line 2: selector.sensing_action is 3; peg_in_hole_2d has the" in message
        assert "sensing actions 0 to 2 (x, y, θ)" in message
        assert load(write(text % ("fixed", 2))).planning.selector.sensing_action == 2
        assert load(write(text % ("action_entropy", 3))).planning.selector.sensing_action == 3


class TestOffload:
    """The sections `offload` and `recovery`."""

    def test_they_load_and_come_back(self, write: Write) -> None:
        configuration = load(
            write(
                """\
                problem: peg_in_hole_2d
                offload:
                  services: [tcp/127.0.0.1:7447, tls/10.0.0.7:7447]
                  detection_timeout_ms: 5000
                  decision_deadline_ms: 20.5
                recovery: {launch: at_start, journal_survives: power_cut}
                """
            )
        )
        assert configuration.offload == OffloadSettings(
            services=("tcp/127.0.0.1:7447", "tls/10.0.0.7:7447"),
            detection_timeout_ms=5000.0,
            decision_deadline_ms=20.5,
        )
        assert configuration.recovery == RecoverySettings(
            launch="at_start", journal_survives="power_cut"
        )
        assert load(write(configuration.to_yaml())) == configuration
        assert Configuration.from_plain(configuration.plain()) == configuration

    def test_they_count_in_comparisons(self, write: Write) -> None:
        text = "problem: peg_in_hole_2d\n"
        plain = load(write(text))
        for section in (
            "offload: {services: [tcp/a:1]}",
            "recovery: {launch: never}",
            "environment: {timeout_ms: 1}",
        ):
            assert load(write(text + section)) != plain

    def test_credentials_are_relative_to_the_file(self, write: Write) -> None:
        path = write("problem: peg_in_hole_2d\noffload: {tls: keys/robot}")
        configuration = load(path)
        assert configuration.offload.tls == str(path.parent / "keys" / "robot")
        (path.parent / "run").mkdir()
        (path.parent / "run" / "config.yaml").write_text(configuration.to_yaml())
        assert load(path.parent / "run" / "config.yaml") == configuration

    def test_credentials_given_instead_are_relative_to_the_current_directory(
        self, write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "current").mkdir()
        monkeypatch.chdir(tmp_path / "current")
        path = write("problem: peg_in_hole_2d\noffload: {tls: keys}")
        found = load(path, overrides={"offload.tls": "mine"}).offload.tls
        assert found == str(tmp_path / "current" / "mine")


class TestOverrides:
    @pytest.mark.parametrize(
        ("name", "value", "expected"),
        [
            (
                "offload.services",
                ["tcp/a:1", "tcp/a:1"],
                r"services\[1\], given instead of what .*run.yaml says, is",
            ),
            ("offload.lease", 3, "^offload.lease is not a known key; did you mean lease_ms"),
            ("recovery.launch", "now", 'recovery.launch, given instead .*run.yaml says, is "now"'),
            ("ofload.lease_ms", 3, "ofload.* is not a known section; did you mean offload"),
        ],
    )
    def test_what_is_refused(self, name: str, value: object, expected: str, write: Write) -> None:
        message = complaint(write("problem: peg_in_hole_2d"), overrides={name: value})
        assert re.search(expected, message)


class TestEnvironment:
    """The section `environment`."""

    TEXT = "problem: peg_in_hole_2d\nenvironment: "

    def test_it_loads_without_importing_it_and_comes_back(self, write: Write) -> None:
        path = write(
            self.TEXT + "{object: 'own_robot:Robot', arguments: {port: 3, at: [1, {a: null}]}}"
        )
        configuration = load(path)
        assert configuration.environment == EnvironmentSettings(
            object="own_robot:Robot",
            directory=str(path.parent),
            arguments={"port": 3, "at": [1, {"a": None}]},
        )
        (path.parent / "run").mkdir()
        (path.parent / "run" / "config.yaml").write_text(configuration.to_yaml())
        assert load(path.parent / "run" / "config.yaml") == configuration
        assert Configuration.from_plain(configuration.plain()) == configuration

    def test_one_that_is_installed_has_no_directory(self, write: Write) -> None:
        found = load(write(self.TEXT + "{object: 'holdfast.robot.environment:Mine'}"))
        assert found.environment.directory is None

    def test_an_entry_point_is_looked_up_later(self, write: Write) -> None:
        assert load(write(self.TEXT + "{object: turtle}")).environment.object == "turtle"


class TestProblems:
    def test_none_named_and_none_told(self, write: Write) -> None:
        message = complaint(write("model: {colour: red}"))
        assert "names no problem, and the keys of its model belong to none" in message
        for name in registry.names():
            assert name in message

    def test_unknown(self, write: Write) -> None:
        with pytest.raises(UnknownProblemError) as caught:
            load(write("\nproblem: peg_in_hole_2\n"))
        message = str(caught.value)
        assert "run.yaml, line 2: problem" in message
        assert "peg_in_hole_2d" in message

    @pytest.mark.parametrize("name", ["lamps:Absent", "absent_module:Lamps", "lamps:"])
    def test_not_importable(self, name: str, write: Write) -> None:
        with pytest.raises(UnknownProblemError):
            load(write(f"problem: '{name}'"))

    @pytest.mark.parametrize("name", ["3", "[a]", "{a: b}"])
    def test_not_a_name(self, name: str, write: Write) -> None:
        message = complaint(write(f"problem: {name}"))
        assert "line 1: problem is" in message
        assert "or module:Class" in message

    @pytest.mark.parametrize(
        ("name", "raised", "source"),
        [
            ("Broken", "KeyError: 'absent'", '{}["absent"]'),
            ("WrongTypes", "TypeError: unsupported operand", 'gain + "one"'),
        ],
    )
    def test_what_a_constructor_raises_comes_with_its_own_frames(
        self, name: str, raised: str, source: str, write: Write
    ) -> None:
        path = write(f"problem: lamps:{name}")
        with pytest.raises(ConfigurationError) as caught:
            load(path)
        message = str(caught.value)
        assert f"{path}: lamps:{name} raised {raised}" in message
        assert source in message
        assert message.count("  File ") == 1
        assert f'  File "{path.parent / "lamps.py"}", line ' in message
