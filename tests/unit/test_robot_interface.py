"""Parameters that map a robot's services; the generated types here are made by hand."""

from __future__ import annotations

import sys
import types
from collections.abc import Mapping
from typing import Any

import pytest

from holdfast.errors import ConfigurationError
from holdfast.ros.robot_interface import ROBOT_PARAMETERS, RobotInterface

LABELS = ("x", "y", "θ")


def message(*names: str) -> type:
    fields = dict.fromkeys(names, "double")
    members: dict[str, Any] = dict.fromkeys(names, 0.0)
    members["get_fields_and_field_types"] = staticmethod(lambda: fields)
    return type("Message", (), members)


def service(request: tuple[str, ...], answer: tuple[str, ...]) -> type:
    return type("Service", (), {"Request": message(*request), "Response": message(*answer)})


def action(goal: tuple[str, ...], result: tuple[str, ...]) -> type:
    return type("Action", (), {"Goal": message(*goal), "Result": message(*result)})


@pytest.fixture(autouse=True)
def types_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    told = ("success", "message")
    sense = service(("trial", "step", "sensing_action"), (*told, "observation"))
    request, answer = ("trial", "step", "task_action"), (*told, "reward")
    trial = service(("trial", "begin"), (*told, "steps", "done", "failed"))
    modules: Mapping[str, Mapping[str, type]] = {
        "holdfast_interfaces.srv": {
            "Sense": sense,
            "Act": service(request, answer),
            "Trial": trial,
        },
        "holdfast_interfaces.action": {"Act": action(request, answer)},
        "arm_msgs.srv": {"Probe": service(("axis", "speed"), ("force", "count"))},
        "arm_msgs.msg": {"Force": message("x", "y"), "Done": message("data")},
    }
    for name, contents in modules.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name.split(".")[0], types.ModuleType(name.split(".")[0]))
        monkeypatch.setitem(sys.modules, name, module)


def interface(**parameters: Any) -> RobotInterface:
    given = {f"environment.{key.replace('__', '.')}": value for key, value in parameters.items()}
    return RobotInterface(given, LABELS, 3)


PROBE = {"sense__type": "arm_msgs/srv/Probe", "sense__observation": "force"}


class TestReadyMade:
    def test_without_parameters_everybody_has_a_name(self) -> None:
        calls = interface().calls
        assert {role: (call.name, call.kind) for role, call in calls.items()} == {
            "sense": ("robot/sense", "srv"),
            "act": ("robot/act", "action"),
            "done": ("robot/trial", "srv"),
            "steps": ("robot/trial", "srv"),
            "reset": ("robot/trial", "srv"),
        }
        assert calls["reset"].constants == [(("begin",), True)]
        assert calls["act"].path("action") == ("task_action",)

    def test_all_the_defaults_come_to_the_same(self) -> None:
        defaults: dict[str, Any] = {key: default for key, (default, _) in ROBOT_PARAMETERS.items()}
        assert RobotInterface(defaults, LABELS, 3).calls == interface().calls

    def test_it_may_be_somewhere_else(self) -> None:
        calls = interface(sense__name="/left/sense").calls
        assert calls["sense"].name == "/left/sense"
        assert calls["sense"].path("index") == ("sensing_action",)
        assert len(calls) == 5

    def test_two_names_are_enough(self) -> None:
        calls = interface(done__name="none", steps__name="none", reset__name="none").calls
        assert list(calls) == ["sense", "act"]
        # Nobody knows the step after a restart, so it is not sent.
        assert calls["act"].path("step") is None
        assert calls["act"].path("trial") == ("trial",)


class TestMapped:
    def test_of_a_robot_with_types_of_its_own_nothing_is_assumed(self) -> None:
        calls = interface(**PROBE, act__name="robot/act").calls
        assert list(calls) == ["sense", "act"]

    def test_its_timeout_is_a_part_of_the_settings_own(self) -> None:
        act = interface(act__name="/arm/act", timeout_ms=1000.0).calls["act"]
        assert act.name == "/arm/act"
        assert act.timeout_s == pytest.approx(0.45)

    def test_a_topic_can_take_the_place_of_the_answer(self) -> None:
        topic = {
            "observation__topic": "/arm/force",
            "observation__type": "arm_msgs/msg/Force",
            "observation__fields": ["x", "y"],
        }
        made = interface(**topic, act__name="robot/act")
        assert list(made.calls) == ["act"]
        assert made.observation is not None
        assert made.observation.fields == ["x", "y"]
        assert not made.observation.taken_during

    @pytest.mark.parametrize(
        ("parameters", "message"),
        [
            (PROBE, "environment.act.name is empty"),
            (
                {"act__type": "arm_msgs/srv/Probe", "act__action": ["axis"]},
                "environment.sense.name and environment.observation.topic are empty",
            ),
            (
                {"sense__type": "arm_msgs/srv/Probe", "act__name": "robot/act"},
                "environment.sense.observation is empty",
            ),
            ({"sense__observation": "force"}, "environment.sense.observation: "),
            ({"sens__name": "x"}, "environment.sens.name is no parameter of a robot; did you mean"),
            ({"sense__name": 3}, "environment.sense.name is 3; expected text"),
            ({"act__action": [""]}, 'environment.act.action[0] is ""; expected text'),
            ({"act__action": ["x"] * 3}, "environment.act.action: "),
            ({"act__scale": ["a"]}, 'environment.act.scale[0] is "a"; expected a number'),
            ({"act__scale": float("nan")}, "environment.act.scale is NaN; expected a number"),
            ({"act__scale": [1.0, 1.0]}, "environment.act.scale has 2 numbers; it must have 3"),
            ({"act__constants": ["speed"]}, "it must be 'field: value'"),
            ({"act__constants": ["speed: 1"]}, "environment.act.constants: "),
            ({"sense__values": [1.0]}, "environment.sense.values has 1 numbers; it must have 0"),
            ({"sense__success": ["success", "message"]}, "environment.sense.success is "),
            (
                {"sense__timeout_ms": True},
                "environment.sense.timeout_ms is true; expected a number > 0",
            ),
            ({"act__timeout_ms": 40000, "done__timeout_ms": 30000}, "are 70000 together"),
            ({"discovery_timeout_ms": 0}, "environment.discovery_timeout_ms is 0"),
            ({"done__name": "none", "done__done": "done"}, "done.done needs environment.done.name"),
            ({"observation__fields": "x"}, "environment.observation.fields needs"),
            (
                {"done__type": "arm_msgs/msg/Done", "done__success": "data", "done__done": "data"},
                "environment.done.type is a message",
            ),
            ({"done__type": "arm_msgs/msg/Done"}, "environment.done.done is empty"),
            ({"sense__type": "arm_msgs/msg/Done"}, "it must be package/srv/Type or"),
            (
                {"steps__name": "none", "act__step": "trial"},
                "environment.act.step needs environment.steps.name",
            ),
        ],
    )
    def test_what_cannot_be_used_is_an_error_that_names_the_key(
        self, parameters: Mapping[str, Any], message: str
    ) -> None:
        with pytest.raises(ConfigurationError) as raised:
            interface(**parameters)
        assert message in str(raised.value)

    def test_a_place_for_the_sensing_action(self) -> None:
        with pytest.raises(
            ConfigurationError, match=r"environment\.sense\.observation: .* no field x"
        ):
            interface(**{**PROBE, "sense__observation": "{label}"}, act__name="robot/act")


def test_every_parameter_is_described() -> None:
    assert all(name.startswith("environment.") for name in ROBOT_PARAMETERS)
    assert all(text.endswith(".") for _, text in ROBOT_PARAMETERS.values())
