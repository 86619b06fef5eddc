"""The node's parameters: the settings' keys and its own, without ROS."""

import sys
from pathlib import Path
from typing import Any

import pytest

from holdfast.errors import HoldfastError
from holdfast_ros.ros2.main import main
from holdfast_ros.ros2.parameters import (
    OWN,
    OWN_DEFAULTS,
    NodeParameters,
    in_force,
    in_parameters,
    known_parameters,
    read_parameters,
    refusal_of_name,
)

CONFIGURATION = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def read(**values: Any) -> NodeParameters:
    given = {key.replace("__", "."): value for key, value in values.items()}
    return read_parameters({"configuration": str(CONFIGURATION), **given})


def test_without_any_everything_is_the_files_or_the_default() -> None:
    found = read(**dict.fromkeys(("offload__tls", "simulator__seed", "rate_hz")))
    assert found.configuration.simulator.seed == 0
    assert found.run_directory == Path("runs/peg_in_hole_2d-seed0").absolute()
    assert (found.own.rate_hz, found.own.frame_id) == (0.0, "task")
    assert found.own.environment == "configuration"
    assert (found.own.decide_timeout_s, found.own.publish_entropies) == (1.0, True)


def test_a_setting_is_a_parameter_of_its_keys_name() -> None:
    found = read(
        particle_filter__num_particles=50,
        offload__services=["tcp/127.0.0.1:7447"],
        offload__tls="",
        offload__detection_timeout_ms=300,
        model__peg_width=0.9,
        simulator__seed=7,
        rate_hz=2,
        environment__arguments__speed=0.5,
    )
    configuration = found.configuration
    assert configuration.planning.particle_filter.num_particles == 50
    assert configuration.offload.services == ("tcp/127.0.0.1:7447",)
    assert configuration.offload.tls is None
    assert configuration.offload.detection_timeout_ms == 300.0
    assert configuration.model["peg_width"] == 0.9
    assert configuration.environment.arguments == {"speed": 0.5}
    assert found.run_directory.name == "peg_in_hole_2d-seed7"
    assert found.own.rate_hz == 2.0


def test_what_ros_itself_has_is_left_alone() -> None:
    read(use_sim_time=True, qos_overrides__topic__depth=3)


def test_another_world_is_another_configuration() -> None:
    """So that no run goes on in another world than the one it began in."""
    named = {kind: read(environment__kind=kind) for kind in ("configuration", "executive", "ros")}
    objects = {kind: one.configuration.environment.object for kind, one in named.items()}
    assert objects == {
        "configuration": None,
        "executive": "holdfast_ros.executive:ExecutiveEnvironment",
        "ros": "holdfast_ros.ros2_environment:RosEnvironment",
    }


def test_how_a_robot_is_reached_is_the_nodes_own() -> None:
    own = read(environment__kind="ros", environment__discovery_timeout_ms=9).own
    assert (own.act, own.discovery_timeout_ms) == ("action", 9.0)
    assert read(environment__kind="ros", environment__act="service").own.act == "service"


def test_the_files_own_world_may_be_another(tmp_path: Path) -> None:
    (tmp_path / "worlds.py").write_text("class World: ...\n")
    path = tmp_path / "robot.yaml"
    path.write_text(
        "problem: peg_in_hole_2d\n"
        "environment: {object: 'worlds:World', directory: '.', arguments: {port: 3}}\n"
    )
    settings = read(configuration=str(path), environment__kind="executive").configuration
    assert settings.environment.object == "holdfast_ros.executive:ExecutiveEnvironment"
    assert settings.environment.arguments == {}


@pytest.mark.parametrize(
    ("message", "for_a_node"),
    [
        ("use another directory (--out)", "use another directory (run_directory)"),
        ("no run to resume; give --out", "no run to resume; give run_directory"),
        ("go on with that run (--resume), or", "go on with that run, or"),
        ("so simulator.num_trials (--trials) is 3", "so simulator.num_trials is 3"),
        ("nothing of the command's", "nothing of the command's"),
    ],
)
def test_a_message_names_parameters_instead_of_options(message: str, for_a_node: str) -> None:
    assert in_parameters(message) == for_a_node


@pytest.mark.parametrize("option", ["--help", "-h"])
def test_help_needs_no_ros_and_names_every_parameter(
    option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert main([option]) == 0
    said = capsys.readouterr().out
    for name, text in OWN.items():
        assert f"\n  {name} " in said or f"\n  {name}\n" in said
        assert text.split()[0] in said
    assert "(default: false)" in said
    assert max(map(len, said.splitlines())) <= 100


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"configuration": ""}, "configuration is empty"),
        ({"configuration": 3}, "configuration is 3; expected text"),
        ({"rate_hz": float("nan")}, "rate_hz is NaN; expected a number >= 0 and <= 10000"),
        ({"rate_hz": True}, "rate_hz is true; expected a number >= 0 and <= 10000"),
        ({"decide_timeout_s": 61}, "decide_timeout_s is 61; expected a number >= 0 and <= 60"),
        ({"publish_entropies": 1}, "publish_entropies is 1; expected true or false"),
        ({"assignments": "a.b=1"}, 'assignments is "a.b=1"; expected a list, as in [a.b=1]'),
        ({"assignments": ["a.b="]}, "assignments[0] is 'a.b='; expected SECTION.KEY=YAML"),
        ({"assignments": ["a.b=1"]}, "a is not a known section"),
        ({"environment__act": "topic"}, 'environment.act is "topic"; expected'),
        ({"environment__discovery_timeout_ms": 0}, "environment.discovery_timeout_ms is 0"),
        (
            {"environment__kind": "ros", "environment__object": "a:B"},
            "environment.object is given, and environment.kind is ros, which needs none",
        ),
        ({"rate": 3}, "rate is no parameter of this node; did you mean"),
        ({"offload__service": []}, "did you mean offload.services?"),
        ({"particle_filter__num_particles": 0}, "is 0; expected a whole number >= 1 and <= 1000"),
    ],
)
def test_what_is_wrong_is_said(values: dict[str, Any], message: str) -> None:
    with pytest.raises(HoldfastError) as raised:
        read(**values)
    assert message in str(raised.value)


def test_what_is_in_force_is_what_was_read() -> None:
    shown = in_force(read(particle_filter__num_particles=50, rate_hz=2, offload__tls=""))
    assert (shown["particle_filter.num_particles"], shown["rate_hz"]) == (50, 2.0)
    assert (shown["offload.tls"], shown["frame_id"], shown["model.peg_width"]) == ("", "task", 1)
    assert shown["run_directory"].endswith("/runs/peg_in_hole_2d-seed0")
    # ROS has no empty lists, and lists of one kind alone.
    assert "offload.services" not in shown
    again = {key: value for key, value in shown.items() if key != "run_directory"}
    assert (
        read_parameters(again).configuration.plain()
        == read(particle_filter__num_particles=50).configuration.plain()
    )


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("speed", "speed is no parameter of this node"),
        ("particle_filter.num_particle", "did you mean particle_filter.num_particles?"),
        *((name, "") for name in ("rate_hz", "model.any", "use_sim_time", "qos_overrides.a")),
        *((name, "") for name in ("environment.arguments.any", "offload.services")),
    ],
)
def test_a_name_that_is_none_is_refused(name: str, reason: str) -> None:
    assert refusal_of_name(name).endswith(reason)
    assert bool(refusal_of_name(name)) == bool(reason)


def test_each_is_described() -> None:
    known = known_parameters()
    assert OWN.keys() == OWN_DEFAULTS.keys() < known.keys()
    assert known["particle_filter.num_particles"].endswith("default 300")
    assert all(known.values())
