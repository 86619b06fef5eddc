"""The node's parameters: the settings' own keys, and a few of the node's.

What is not given is the configuration file's value or, without one there, the default. ROS's
parameters know no null, for which an empty text stands, and no list of mappings, for which there is
``assignments``. Values are checked by the settings' own code when the node is configured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import msgspec.inspect

from holdfast.config.loader import Configuration, load
from holdfast.config.source import SETTINGS
from holdfast.config.yaml_document import read
from holdfast.errors import ConfigurationError
from holdfast.printable import brief
from holdfast.validation import close_match, described, dotted, find_mismatch

_SECTIONS_OF_PROBLEMS = ("model.", "state_space_planner.")
_ARGUMENTS = "environment.arguments."
_OF_ROS = ("use_sim_time", "start_type_description_service")
_OF_ROS_SECTIONS = ("qos_overrides.",)
_Text = Annotated[str, msgspec.Meta(max_length=4096)]


class OwnParameters(msgspec.Struct, frozen=True, kw_only=True):
    """The node's own parameters."""

    configuration: _Text = ""
    problem: _Text = ""
    assignments: list[str] = []
    run_directory: _Text = ""
    rate_hz: Annotated[float, msgspec.Meta(ge=0.0, le=10_000.0)] = 0.0
    frame_id: _Text = "task"
    map_frame: _Text = "map"
    autostart: bool = False
    after_reboot: bool = False
    environment: Literal["configuration", "ros", "executive"] = msgspec.field(
        default="configuration", name="environment.kind"
    )
    act: Literal["action", "service"] = msgspec.field(default="action", name="environment.act")
    discovery_timeout_ms: Annotated[float, msgspec.Meta(gt=0.0, le=1e300)] = msgspec.field(
        default=5000.0, name="environment.discovery_timeout_ms"
    )
    decide_timeout_s: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 1.0
    pause_timeout_s: Annotated[float, msgspec.Meta(ge=0.0, le=3600.0)] = 5.0
    belief_rate_hz: Annotated[float, msgspec.Meta(ge=0.0, le=1000.0)] = 10.0
    publish_entropies: bool = True
    bond_heartbeat_period: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 0.1


OWN: Mapping[str, str] = {
    "configuration": "configuration file (YAML) of the run",
    "problem": "problem to run, instead of the file's: a registered name or module:Class",
    "assignments": "values that a parameter cannot hold, each SECTION.KEY=YAML",
    "run_directory": "directory of the run; default: runs/CONFIGURATION-seedS in the current "
    "directory",
    "rate_hz": "task actions a second; 0: as fast as it goes",
    "frame_id": "frame of the poses: the problem's own coordinates",
    "map_frame": "frame in which frame_id stands upright, for /tf_static; empty: publish none",
    "autostart": "whether the node configures and activates itself",
    "after_reboot": "whether a run goes on although the machine was rebooted since it last moved",
    "environment.kind": "what the robot acts on: configuration (what the file names, else a "
    "simulated world), ros (what offers robot/sense, robot/act and robot/trial), executive "
    "(whoever calls ~/decide)",
    "environment.act": "what robot/act is: action or service",
    "environment.discovery_timeout_ms": "how long nobody may offer one of these before that is an "
    "error, ms",
    "decide_timeout_s": "a call of ~/decide is answered within this time, s",
    "pause_timeout_s": "how long a run that is to be held waits for the robot, s",
    "belief_rate_hz": "beliefs published a second, at most",
    "publish_entropies": "whether to compute each decision's entropies once more and publish them",
    "bond_heartbeat_period": "period of the heartbeat for Nav2's lifecycle manager, s; 0: none. "
    "It needs the package bond",
}
"""What the node's own parameters mean."""

OWN_DEFAULTS: Mapping[str, Any] = msgspec.to_builtins(OwnParameters())

_OBJECTS = {
    "executive": "holdfast_ros.executive:ExecutiveEnvironment",
    "ros": "holdfast_ros.ros2_environment:RosEnvironment",
}
"""What the run's configuration names, so that no other world goes on with that run."""

_FOR_OPTIONS = {
    " (--resume)": "",
    " (--trials)": "",
    "(--after-reboot)": "(after_reboot)",
    "(--out)": "(run_directory)",
    "give --out": "give run_directory",
}
"""What a message's words for those who use the command are for those who use the node."""


class NodeParameters(NamedTuple):
    """What the parameters come to."""

    own: OwnParameters
    configuration: Configuration
    run_directory: Path  # absolute


def known_parameters() -> dict[str, str]:
    """Return what each parameter means, by name; those of the problem's own sections excepted."""
    keys = dict(OWN)
    for section, schema in SETTINGS.items():
        defaults = msgspec.to_builtins(schema())
        for item in msgspec.inspect.type_info(schema).fields:  # type: ignore[attr-defined]
            default = json.dumps(defaults[item.encode_name])
            keys[f"{section}.{item.encode_name}"] = f"{described(item.type)}; default {default}"
    return keys


def in_parameters(text: str) -> str:
    """Return a message with the parameters' names for the command's options."""
    for option, parameter in _FOR_OPTIONS.items():
        text = text.replace(option, parameter)
    return text


def read_parameters(values: Mapping[str, Any]) -> NodeParameters:
    """Check the parameters, and load the configuration that they make.

    ``values`` are plain data by the parameter's name; None means not given. Raises HoldfastError if
    a value cannot be used.
    """
    given = {name: value for name, value in values.items() if value is not None}
    of_own = {name: given[name] for name in OWN if name in given}
    if mismatch := find_mismatch(of_own, OwnParameters):
        raise ConfigurationError(f"{dotted(mismatch.path)} {mismatch.in_words()}")
    own = msgspec.convert(of_own, OwnParameters)  # noqa: TID251 - as the node begins
    overrides: dict[str, Any] = {}
    for name, value in given.items():
        if name in OWN or name in _OF_ROS or name.startswith(_OF_ROS_SECTIONS):
            continue
        if name.startswith(_ARGUMENTS):
            arguments = overrides.setdefault(_ARGUMENTS[:-1], {})
            arguments[name.removeprefix(_ARGUMENTS)] = value
        elif refusal := refusal_of_name(name):
            raise ConfigurationError(refusal)
        else:
            overrides[name] = None if value == "" else value
    for index, assignment in enumerate(own.assignments):
        key, value = _assigned(index, assignment)
        overrides[key] = value
    if own.environment in _OBJECTS:
        for key in ("object", "directory", "arguments"):
            if overrides.get(f"environment.{key}"):
                raise ConfigurationError(
                    f"environment.{key} is given, and environment.kind is {own.environment}, which "
                    "needs none; leave one of the two out"
                )
        # The file's own environment is for other uses of it.
        overrides["environment.object"] = _OBJECTS[own.environment]
        overrides |= {"environment.directory": None, "environment.arguments": {}}
    if not own.configuration:
        raise ConfigurationError(
            "configuration is empty; it must name the configuration file (YAML) of the run, as in "
            "-p configuration:=peg_in_hole_2d.yaml"
        )
    here = Path.cwd()  # before the problem's code, which may go elsewhere
    configuration = load(own.configuration, problem=own.problem or None, overrides=overrides)
    default = Path("runs") / f"{Path(own.configuration).stem}-seed{configuration.simulator.seed}"
    return NodeParameters(own, configuration, here / (own.run_directory or default))


def _assigned(index: int, assignment: str) -> tuple[str, Any]:
    key, equals, text = assignment.partition("=")
    section, dot, name = key.strip().partition(".")
    if not (equals and dot and section and name and "." not in name and text.strip()):
        raise ConfigurationError(
            f"assignments[{index}] is {brief(assignment)}; expected SECTION.KEY=YAML, such as "
            "offload.tls=null"
        )
    return f"{section}.{name}", read(text.encode(), f"assignments[{index}]").data


def refusal_of_name(name: str) -> str:
    """Return why there is no parameter of a name; empty if there is, or a problem may have it."""
    known = known_parameters()
    others = (*_OF_ROS_SECTIONS, *_SECTIONS_OF_PROBLEMS, _ARGUMENTS)
    if name in known or name in _OF_ROS or name.startswith(others):
        return ""
    return f"{name} is no parameter of this node{close_match(name, known)}"


def in_force(read: NodeParameters) -> dict[str, Any]:
    """Return the values in force by the parameter's name, those that a parameter can hold."""
    values = msgspec.to_builtins(read.own) | {"run_directory": str(read.run_directory)}
    for section, settings in read.configuration.plain()["configuration"].items():
        if isinstance(settings, Mapping):
            values |= {f"{section}.{key}": value for key, value in settings.items()}
    shown = {name: "" if value is None else value for name, value in values.items()}
    return {name: value for name, value in shown.items() if _fits(value)}


def _fits(value: Any) -> bool:
    if isinstance(value, list | tuple):
        kinds = {type(each) for each in value}
        return len(kinds) == 1 and kinds <= {bool, int, float, str}
    return isinstance(value, str | float) or (isinstance(value, int) and abs(value) < 2**63)
