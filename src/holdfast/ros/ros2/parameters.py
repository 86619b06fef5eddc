"""The node's parameters: the settings' own keys, and a few of the node's.

Every setting is a parameter of its key's name (``particle_filter.num_particles``); what is not
given is the configuration file's value or, without one there, the default. ROS's parameters know no
null, for which an empty text stands, and no list of mappings, for which there is ``assignments``,
each ``SECTION.KEY=YAML``, as ``holdfast run --set`` has it.

Values are checked by the settings' own code: a parameter may have any type, and errors are reported
when the node is configured, with key, value and limit.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from holdfast.config.loader import Configuration, load, settings_keys
from holdfast.config.yaml_document import read
from holdfast.errors import ConfigurationError
from holdfast.ros.robot_interface import ROBOT_PARAMETERS

__all__ = ["OWN", "NodeParameters", "in_parameters", "known_parameters", "read_parameters"]

_SECTIONS_OF_PROBLEMS = ("model.", "state_space_planner.")
_ENVIRONMENT = "environment."
_OF_ROS = ("use_sim_time", "start_type_description_service")
_OF_ROS_SECTIONS = ("qos_overrides.",)


class _Own(NamedTuple):
    default: Any
    text: str


OWN: Mapping[str, _Own] = {
    "configuration": _Own("", "configuration file (YAML) of the run"),
    "problem": _Own("", "problem to run, instead of the file's: a registered name or module:Class"),
    "assignments": _Own([], "values that a parameter cannot hold, each SECTION.KEY=YAML"),
    "run_directory": _Own(
        "", "directory of the run; default: runs/CONFIGURATION-seedS in the current directory"
    ),
    "rate_hz": _Own(0.0, "task actions a second; 0: as fast as it goes"),
    "frame_id": _Own("task", "frame of the poses: the problem's own coordinates"),
    "autostart": _Own(False, "whether the node configures and activates itself"),
    "environment.kind": _Own(
        "configuration",
        "what the robot acts on: configuration (what the file names, else a simulated world), ros "
        "(the user's robot, through ROS), executive (whoever calls ~/decide)",
    ),
    "decide_timeout_s": _Own(1.0, "a call of ~/decide is answered within this time, s"),
    "pause_timeout_s": _Own(5.0, "how long a run that is to be held waits for the robot, s"),
    "belief_rate_hz": _Own(10.0, "beliefs published a second, at most"),
    "publish_entropies": _Own(
        True, "whether to compute the entropies of each decision once more, to publish them"
    ),
}
"""The node's own parameters, with default and meaning."""

KINDS = ("configuration", "ros", "executive")

_BOUNDS = {
    "rate_hz": (0.0, 10_000.0),
    "decide_timeout_s": (0.0, 60.0),
    "pause_timeout_s": (0.0, 3600.0),
    "belief_rate_hz": (0.0, 1000.0),
}
"""Smallest and largest value of those that are numbers."""

_OBJECTS = {
    "executive": "holdfast.ros.executive:ExecutiveEnvironment",
    "ros": "holdfast.ros.ros2_environment:RosEnvironment",
}
"""What the run's configuration names, so that no other world goes on with that run."""


_FOR_OPTIONS = {
    " (--resume)": "",
    " (--trials)": "",
    "(--out)": "(run_directory)",
    "give --out": "give run_directory",
}
"""What a message's words for those who use the command are for those who use the node."""


class NodeParameters(NamedTuple):
    """What the parameters come to.

    Attributes
    ----------
    run_directory : Path
        Absolute.
    environment : str
        One of :data:`KINDS`.
    mapping : dict
        What says how the robot is reached through ROS, by the parameters' names.
    """

    configuration: Configuration
    run_directory: Path
    rate_hz: float | None
    frame_id: str
    environment: str
    mapping: dict[str, Any]
    decide_timeout_s: float
    pause_timeout_s: float
    belief_rate_hz: float
    publish_entropies: bool


def known_parameters() -> dict[str, str]:
    """Return what each parameter means, by name; those of the problem's own sections excepted."""
    robot = {name: text for name, (_, text) in ROBOT_PARAMETERS.items()}
    return {name: own.text for name, own in OWN.items()} | settings_keys() | robot


def in_parameters(text: str) -> str:
    """Return a message with the parameters' names for the command's options."""
    for option, parameter in _FOR_OPTIONS.items():
        text = text.replace(option, parameter)
    return text


def read_parameters(values: Mapping[str, Any]) -> NodeParameters:
    """Check the parameters, and load the configuration that they make.

    ``values`` are plain data by the parameter's name; None means not given.

    Raises
    ------
    HoldfastError
        If a value cannot be used; the message names the parameter, the value and what is allowed.
    """
    given = {name: value for name, value in values.items() if value is not None}
    own = {name: _own_value(name, given) for name in OWN}
    environment = own["environment.kind"]
    if environment not in KINDS:
        raise ConfigurationError(
            f"environment.kind is {environment!r:.80}; expected one of {', '.join(KINDS)}"
        )
    settings = settings_keys()
    overrides: dict[str, Any] = {}
    mapping: dict[str, Any] = {}
    for name, value in given.items():
        if name in OWN or name in _OF_ROS or name.startswith(_OF_ROS_SECTIONS):
            continue
        if name in settings or name.startswith(_SECTIONS_OF_PROBLEMS):
            overrides[name] = None if value == "" else value
        elif name.startswith("environment.arguments."):
            arguments = overrides.setdefault("environment.arguments", {})
            arguments[name.removeprefix("environment.arguments.")] = value
        elif name.startswith(_ENVIRONMENT) and environment == "ros":
            mapping[name] = value
        else:
            raise _unknown(name)
    for index, assignment in enumerate(own["assignments"]):
        key, value = _assigned(index, assignment)
        overrides[key] = value
    if environment in _OBJECTS:
        for key in ("object", "directory", "arguments"):
            if overrides.get(f"environment.{key}"):
                raise ConfigurationError(
                    f"environment.{key} is given, and environment.kind is {environment}, which "
                    "needs none; leave one of the two out"
                )
        # The file's own environment is for other uses of it.
        overrides["environment.object"] = _OBJECTS[environment]
        overrides |= {"environment.directory": None, "environment.arguments": {}}
    path = own["configuration"]
    if not path:
        raise ConfigurationError(
            "configuration is empty; it must name the configuration file (YAML) of the run, as in "
            "-p configuration:=peg_in_hole_2d.yaml"
        )
    configuration = load(path, problem=own["problem"] or None, overrides=overrides)
    default = Path("runs") / f"{Path(path).stem}-seed{configuration.simulator.seed}"
    return NodeParameters(
        configuration,
        Path(own["run_directory"] or default).absolute(),
        own["rate_hz"] or None,
        own["frame_id"],
        environment,
        mapping | {"environment.timeout_ms": configuration.environment.timeout_ms},
        own["decide_timeout_s"],
        own["pause_timeout_s"],
        own["belief_rate_hz"],
        own["publish_entropies"],
    )


def _own_value(name: str, given: Mapping[str, Any]) -> Any:
    """Return the value of one of the node's own parameters, of its default's type."""
    default = OWN[name].default
    value = given.get(name, default)
    if isinstance(default, bool):
        right, words = isinstance(value, bool), "true or false"
    elif isinstance(default, float):
        low, high = _BOUNDS[name]
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        right = is_number and math.isfinite(value) and low <= value <= high
        words = f"a number from {low:g} to {high:g}"
        value = float(value) if right else value
    elif isinstance(default, list):
        right = isinstance(value, list) and all(isinstance(item, str) for item in value)
        words = "a list of texts"
    else:
        right, words = isinstance(value, str) and len(value) <= 4096, "a text, 4096 characters"
    if not right:
        raise ConfigurationError(f"{name} is {value!r:.80}; expected {words}")
    return value


def _assigned(index: int, assignment: str) -> tuple[str, Any]:
    key, equals, text = assignment.partition("=")
    section, dot, name = key.strip().partition(".")
    if not (equals and dot and section and name and "." not in name and text.strip()):
        raise ConfigurationError(
            f"assignments[{index}] is {assignment!r:.80}; expected SECTION.KEY=YAML, such as "
            "offload.tls=null"
        )
    return f"{section}.{name}", read(text.encode(), f"assignments[{index}]").data


def _unknown(name: str) -> ConfigurationError:
    if name in ROBOT_PARAMETERS:
        return ConfigurationError(f"{name} needs environment.kind ros: else it would do nothing")
    close = difflib.get_close_matches(name, known_parameters(), n=1)
    hint = f"; did you mean {close[0]}?" if close else ""
    return ConfigurationError(f"{name} is no parameter of this node{hint}")
