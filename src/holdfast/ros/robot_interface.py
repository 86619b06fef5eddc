"""A robot's interface in ROS, by parameters: names and types of its calls, and their fields.

Existing robots have their own services and actions. The parameters map them to the five calls that
holdfast needs, the roles:

- ``sense``: perform a sensing action;
- ``act``: perform a task action;
- ``done``: report whether the task is done;
- ``steps``: report how many task actions were performed in this trial;
- ``reset``: bring the robot to the start of a trial.

A robot that offers the ready-made ``robot/sense`` (``holdfast_interfaces/srv/Sense``),
``robot/act`` (``holdfast_interfaces/action/Act``) and ``robot/trial``
(``holdfast_interfaces/srv/Trial``, for the other three) needs no parameters at all. As soon as
``sense`` or ``act`` has another type, a role without a name does not exist: without ``done``
trials end at ``simulator.max_steps``, without ``steps`` a run that was killed in the middle of a
task action cannot be resumed, without ``reset`` a trial begins where the robot is.

:data:`ROBOT_PARAMETERS` lists every parameter. Nothing here imports ROS but the types that the
parameters name.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from holdfast.config.yaml_document import read
from holdfast.errors import ConfigurationError
from holdfast.ros.field_paths import Path, check_path, find_type, parse_path

__all__ = ["ROBOT_PARAMETERS", "ObservationTopic", "RobotCall", "RobotInterface"]

_SENSE, _ACT, _ACT_SERVICE, _TRIAL = (
    f"holdfast_interfaces/{name}" for name in ("srv/Sense", "action/Act", "srv/Act", "srv/Trial")
)

_DEFAULTS = {
    "sense": ("robot/sense", _SENSE),
    "act": ("robot/act", _ACT),
    **dict.fromkeys(("done", "steps", "reset"), ("robot/trial", _TRIAL)),
}
"""Name and type by role."""

ROLES = tuple(_DEFAULTS)

_OF_ALL: Mapping[str, tuple[object, str]] = {
    "name": (
        "",
        "Name of the service, the action or (done alone) the topic. 'none': not there; empty: "
        "the ready-made one, or not there if sense or act has a type of its own.",
    ),
    "type": ("", "Its type, package/srv/Type, package/action/Type or (done) package/msg/Type."),
    "timeout_ms": (
        0.0,
        "Longest time until the answer, of an action until its result; 0: 0.45 times "
        "environment.timeout_ms.",
    ),
    "trial": ("", "Field of the request that gets the number of the trial."),
    "step": ("", "Field of the request that gets how many task actions were performed so far."),
    "constants": ([], "Fields that always have one value, such as 'header.frame_id: base_link'."),
    "success": ("", "Truth value of the answer: whether it was done."),
    "message": ("", "Text of the answer: why not."),
}

_OWN: Mapping[str, Mapping[str, tuple[object, str]]] = {
    "sense": {
        "index": ("", "Field of the request that gets the index of the sensing action."),
        "label": ("", "Field of the request that gets the problem's label of it."),
        "fields": ([], "Fields of the request that get numbers which depend on it: see values."),
        "values": ([], "These numbers, first all for sensing action 0, then all for 1, ..."),
        "observation": (
            [],
            "Fields of the answer that are the observation, numbers or arrays; {index} and {label} "
            "in them stand for the sensing action's.",
        ),
    },
    "act": {
        "action": ([], "Fields of the request that get the task action: one array, or one each."),
        "scale": ([], "What its coordinates are multiplied by, for the robot's units."),
        "reward": ("", "Field of the answer that is the reward; NaN: none."),
    },
    "done": {
        "done": ("", "Field of the answer or message: whether the task has succeeded."),
        "failed": ("", "Field of the answer or message: whether it has failed for good."),
    },
    "steps": {"steps": ("", "Field of the answer that is the count.")},
    "reset": {},
}

_OBSERVATION: Mapping[str, tuple[object, str]] = {
    "topic": ("", "The observation is a message of this topic instead of a field of the answer."),
    "type": ("", "Type of the message, package/msg/Type."),
    "fields": ([], "As environment.sense.observation, of the message."),
    "taken": (
        "after",
        "'after': not before the sensing action was answered; 'during': not before it was "
        "requested. By header.stamp where the message has one, else by when it was received.",
    ),
}

ROBOT_PARAMETERS: Mapping[str, tuple[object, str]] = {
    "environment.discovery_timeout_ms": (
        5000.0,
        "How long a name may be offered by nobody before that is an error.",
    ),
    **{
        f"environment.{role}.{key}": described
        for role in ROLES
        for key, described in (*_OF_ALL.items(), *_OWN[role].items())
    },
    **{f"environment.observation.{key}": described for key, described in _OBSERVATION.items()},
}
"""Every parameter of a robot's interface: its default, and what it means.

A list that is empty may be left out, and one of a single text may be that text.
"""

# Which field takes what, in the ready-made types. The parameters can say it otherwise.
_READY_MADE: Mapping[tuple[str, str], Mapping[str, object]] = {
    ("sense", _SENSE): {
        "trial": "trial",
        "step": "step",
        "index": "sensing_action",
        "observation": ["observation"],
    },
    **{
        ("act", name): {
            "trial": "trial",
            "step": "step",
            "action": ["task_action"],
            "reward": "reward",
        }
        for name in (_ACT, _ACT_SERVICE)
    },
    ("done", _TRIAL): {"trial": "trial", "done": "done", "failed": "failed"},
    ("steps", _TRIAL): {"trial": "trial", "steps": "steps"},
    ("reset", _TRIAL): {"trial": "trial", "constants": ["begin: true"]},
}

_PART = 0.45
"""Of ``environment.timeout_ms``: it is for a task action and for asking whether it was the last."""

_OF_THE_SETTINGS = ("kind", "object", "directory", "timeout_ms", "arguments")
"""Keys of the section ``environment`` that are not about ROS."""

_REQUEST_KEYS = ("trial", "step", "index", "label", "fields", "action")
_ANSWER_KEYS = ("success", "message", "reward", "done", "failed", "steps")


class RobotCall(NamedTuple):
    """One role: whom to call, and which field takes what.

    Attributes
    ----------
    kind : str
        ``srv``, ``action`` or ``msg``.
    type : type
        The generated class.
    paths : dict of str to list of tuple
        By key (``trial``, ``index``, ``action``, ...) the fields that it names. Those of
        ``observation`` are in ``observation``.
    observation : list of str
        With ``{index}`` and ``{label}`` still in them.
    constants : list of (path, value)
    """

    role: str
    name: str
    type_name: str
    kind: str
    type: Any
    timeout_s: float
    paths: Mapping[str, Sequence[Path]]
    observation: Sequence[str]
    constants: Sequence[tuple[Path, Any]]
    scale: Sequence[float]
    values: Sequence[float]

    def key(self, key: str) -> str:
        """Return the whole name of a parameter of this role."""
        return f"environment.{self.role}.{key}"

    def path(self, key: str) -> Path | None:
        """Return the one field that a key names, if it does."""
        paths = self.paths.get(key)
        return paths[0] if paths else None

    def __str__(self) -> str:
        """Return a description for messages."""
        word = {"srv": "service", "action": "action", "msg": "topic"}[self.kind]
        return f"{word} {self.name} ({self.key('name')})"


class ObservationTopic(NamedTuple):
    """Messages that are observations."""

    name: str
    type_name: str
    type: Any
    fields: Sequence[str]
    taken_during: bool


class RobotInterface:
    """A robot's interface, as parameters map it.

    Parameters
    ----------
    parameters : mapping of str to object
        Those of :data:`ROBOT_PARAMETERS`, by name, with or without ``environment.`` before it;
        sections may be mappings themselves. Of the settings' own section ``environment``
        ``timeout_ms`` is read, and its other keys are left alone.
    sensing_actions : sequence of str
        The problem's labels.
    action_size : int
        Coordinates of the problem's task actions.

    Attributes
    ----------
    calls : dict of str to RobotCall
        By role; those that are not there are missing.
    timeout_s : float
        For an observation that nobody is asked for, and for each call by default.

    Raises
    ------
    ConfigurationError
        If a parameter is unknown, of another type or out of its bounds, a type cannot be imported,
        or does not have a field that a parameter names. The message names the parameter.
    """

    def __init__(
        self, parameters: Mapping[str, object], sensing_actions: Sequence[str], action_size: int
    ) -> None:
        given = _flat(parameters)
        self._sensing_actions = list(sensing_actions)
        self._action_size = action_size
        self._values = _Values(given)
        self._timeout_ms = self._values.positive("environment.timeout_ms", 60_000.0)
        self.timeout_s = 1e-3 * _PART * self._timeout_ms
        discovery_ms = self._values.positive("environment.discovery_timeout_ms", 5000.0)
        self.discovery_timeout_s = 1e-3 * discovery_ms
        self.observation = self._observation_topic()
        own = self.observation is not None or any(
            self._values.text(f"environment.{role}.type") not in ready
            for role, ready in (("sense", ("", _SENSE)), ("act", ("", _ACT, _ACT_SERVICE)))
        )
        self.calls: dict[str, RobotCall] = {}
        for role in ROLES:
            call = self._call(role, own=own)
            if call is not None:
                self.calls[role] = call
        self._check_whole()

    def _observation_topic(self) -> ObservationTopic | None:
        values, section = self._values, "environment.observation."
        name = values.text(f"{section}topic")
        if not name:
            for key in ("type", "fields"):
                if values.texts(f"{section}{key}"):
                    raise ConfigurationError(f"{section}{key} needs {section}topic")
            return None
        type_name = values.text(f"{section}type")
        found = find_type(type_name, f"{section}type", ("msg",))
        fields = values.texts(f"{section}fields")
        if not fields:
            raise ConfigurationError(
                f"{section}fields is empty; it must name the fields of {type_name} that are the "
                "observation"
            )
        self._check_observation(found, fields, f"{section}fields")
        taken = values.text(f"{section}taken") or "after"
        if taken not in ("after", "during"):
            raise ConfigurationError(f"{section}taken is {taken!r}; it must be 'after' or 'during'")
        return ObservationTopic(name, type_name, found, fields, taken == "during")

    def _call(self, role: str, *, own: bool) -> RobotCall | None:
        values, section = self._values, f"environment.{role}."
        type_name = values.text(f"{section}type")
        by_default = own and (not type_name or role in ("done", "steps", "reset"))
        default_name, default_type = _DEFAULTS[role]
        name = values.text(f"{section}name") or ("" if by_default else default_name)
        if name in ("", "none"):
            for key in (*_OF_ALL, *_OWN[role]):
                if key != "name" and values.is_given(f"{section}{key}"):
                    raise ConfigurationError(f"{section}{key} needs {section}name")
            return None
        type_name = type_name or default_type
        kinds = ("srv", "action", "msg") if role == "done" else ("srv", "action")
        found = find_type(type_name, f"{section}type", kinds)
        kind = type_name.split("/")[1]
        ready: Mapping[str, object] = {}
        if (role, type_name) in _READY_MADE:
            answered = {"success": "success", "message": "message"}
            ready = {**_READY_MADE[role, type_name], **answered}
        texts = {
            key: values.texts(f"{section}{key}", ready.get(key, []))
            for key, (default, _) in (*_OF_ALL.items(), *_OWN[role].items())
            if isinstance(default, str | list) and key not in ("name", "type", "scale", "values")
        }
        if role == "sense" and self.observation is not None:
            if values.is_given(f"{section}observation"):
                raise ConfigurationError(
                    f"{section}observation and environment.observation.topic are both given; the "
                    "observation comes from one of them"
                )
            texts["observation"] = []
        paths = {
            key: [parse_path(text, f"{section}{key}") for text in given]
            for key, given in texts.items()
            if key not in ("observation", "constants") and given
        }
        constants = [self._constant(text, f"{section}constants") for text in texts["constants"]]
        request, answer = {
            "srv": ("Request", "Response"),
            "action": ("Goal", "Result"),
            "msg": (None, None),
        }[kind]
        if request is not None:
            for key in _REQUEST_KEYS:
                for path in paths.get(key, ()):
                    check_path(getattr(found, request), path, f"{section}{key}")
            for path, _ in constants:
                check_path(getattr(found, request), path, f"{section}constants")
        elif constants or any(key in paths for key in (*_REQUEST_KEYS, "success", "message")):
            raise ConfigurationError(f"{section}type is a message, so nothing is requested of it")
        answers = found if answer is None else getattr(found, answer)
        for key in _ANSWER_KEYS:
            for path in paths.get(key, ()):
                check_path(answers, path, f"{section}{key}")
        self._check_observation(answers, texts.get("observation", []), f"{section}observation")
        call = RobotCall(
            role,
            name,
            type_name,
            kind,
            found,
            1e-3 * values.positive(f"{section}timeout_ms", _PART * self._timeout_ms),
            paths,
            texts.get("observation", []),
            constants,
            values.numbers(f"{section}scale") if role == "act" else (),
            values.numbers(f"{section}values") if role == "sense" else (),
        )
        self._check_sizes(call)
        return call

    def _check_sizes(self, call: RobotCall) -> None:
        for key, paths in call.paths.items():
            if len(paths) > 1 and key not in ("fields", "action"):
                raise ConfigurationError(f"{call.key(key)} must name one field")
        if call.role == "sense":
            fields, values = len(call.paths.get("fields", ())), len(call.values)
            needed = fields * len(self._sensing_actions)
            if values != needed:
                raise ConfigurationError(
                    f"{call.key('values')} has {values} numbers; it must have {needed}: "
                    f"{len(self._sensing_actions)} sensing actions, {fields} in "
                    f"{call.key('fields')}"
                )
        elif call.role == "act":
            size = self._action_size
            fields, scales = len(call.paths.get("action", ())), len(call.scale)
            if fields not in (1, size):
                raise ConfigurationError(
                    f"{call.key('action')} names {fields} fields; it must be 1, an array, or "
                    f"{size}, one for each coordinate of a task action"
                )
            if scales not in (0, 1, size):
                raise ConfigurationError(
                    f"{call.key('scale')} has {scales} numbers; it must have {size}, one for each "
                    "coordinate of a task action, or a single one"
                )
        elif call.role in ("done", "steps") and call.role not in call.paths:
            raise ConfigurationError(
                f"{call.key(call.role)} is empty; it must name the field of {call.type_name} that "
                "tells"
            )

    def _check_whole(self) -> None:
        calls = self.calls
        if "act" not in calls:
            raise ConfigurationError(
                "environment.act.name is empty; it must name the service or action that performs a "
                "task action"
            )
        if "sense" not in calls and self.observation is None:
            raise ConfigurationError(
                "environment.sense.name and environment.observation.topic are empty; one of them "
                "must say where observations come from"
            )
        sense = calls.get("sense")
        if sense is not None and self.observation is None and not sense.observation:
            raise ConfigurationError(
                "environment.sense.observation is empty; it must name the fields of "
                f"{sense.type_name} that are the observation"
            )
        if "steps" not in calls:
            for role, call in calls.items():
                if "step" in call.paths:
                    if self._values.is_given(call.key("step")):
                        raise ConfigurationError(
                            f"{call.key('step')} needs environment.steps.name: without a count of "
                            "the robot's own nobody knows it after a restart"
                        )
                    paths = {key: path for key, path in call.paths.items() if key != "step"}
                    calls[role] = call._replace(paths=paths)
        # Performing a task action and asking whether the task is done share one deadline.
        done = calls.get("done")
        both_s = calls["act"].timeout_s + (0.0 if done is None else done.timeout_s)
        if 1e3 * both_s > self._timeout_ms:
            raise ConfigurationError(
                f"environment.act.timeout_ms and environment.done.timeout_ms are {1e3 * both_s:g} "
                f"together; that must not be more than environment.timeout_ms, {self._timeout_ms:g}"
            )

    def _check_observation(self, message_type: Any, texts: Sequence[str], key: str) -> None:
        for text in texts:
            for index, label in enumerate(self._sensing_actions):
                check_path(message_type, observation_path(text, index, label, key), key)

    @staticmethod
    def _constant(text: str, key: str) -> tuple[Path, Any]:
        entries = read(text.encode(), key).data
        if not isinstance(entries, dict) or len(entries) != 1:
            raise ConfigurationError(f"{key} has {text!r}; it must be 'field: value'")
        ((name, value),) = entries.items()
        return parse_path(name, key), value


def observation_path(text: str, index: int, label: str, key: str) -> Path:
    """Return the path of an observation's field for one sensing action."""
    return parse_path(text.replace("{index}", str(index)).replace("{label}", label), key)


class _Values:
    """Parameters by name, held to their types."""

    def __init__(self, given: Mapping[str, object]) -> None:
        self._given = given
        for key in given:
            if key not in ROBOT_PARAMETERS and key.split(".")[1] not in _OF_THE_SETTINGS:
                close = difflib.get_close_matches(key, ROBOT_PARAMETERS, n=1)
                suggestion = f"; did you mean {close[0]}?" if close else ""
                raise ConfigurationError(f"{key} is no parameter of a robot{suggestion}")

    def is_given(self, key: str) -> bool:
        value = self._given.get(key)
        return (
            value is not None
            and not (isinstance(value, str | Sequence) and len(value) == 0)
            and value != ROBOT_PARAMETERS[key][0]
        )

    def text(self, key: str) -> str:
        value = self._given.get(key)
        if value is None:
            return ""
        if not isinstance(value, str):
            raise ConfigurationError(f"{key} is {value!r:.80}; it must be a text")
        return value

    def texts(self, key: str, default: object = ()) -> list[str]:
        value = self._given.get(key)
        if not self.is_given(key):
            value = default
        if isinstance(value, str):
            return [value] if value else []
        if not isinstance(value, Sequence) or not all(
            isinstance(entry, str) and entry for entry in value
        ):
            raise ConfigurationError(f"{key} is {value!r:.80}; it must be a text, or a list of it")
        return list(value)

    def numbers(self, key: str) -> list[float]:
        value = self._given.get(key)
        if value is None:
            return []
        entries = list(value) if isinstance(value, Sequence) else [value]
        numbers = [_number(entry) for entry in entries]
        if isinstance(value, str) or None in numbers:
            raise ConfigurationError(f"{key} is {value!r:.80}; it must be a list of finite numbers")
        return [number for number in numbers if number is not None]

    def positive(self, key: str, default: float) -> float:
        value = self._given.get(key)
        if value is None or (value == 0 and ROBOT_PARAMETERS.get(key, (1,))[0] == 0):
            return default
        number = _number(value)
        if number is None or not number > 0.0:
            raise ConfigurationError(f"{key} is {value!r:.80}; it must be a number above 0")
        return number


def _number(value: object) -> float | None:
    """Return a finite number; None if it is anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def _flat(parameters: Mapping[str, object], prefix: str = "environment.") -> dict[str, object]:
    """Return the parameters of the environment by their whole names."""
    flat: dict[str, object] = {}
    for key, value in parameters.items():
        name = f"{prefix}{key.removeprefix('environment.')}"
        if key == "environment" and isinstance(value, Mapping):
            flat.update(_flat(value))
        elif isinstance(value, Mapping):
            flat.update(_flat(value, f"{name}."))
        else:
            flat[name] = value
    return flat
