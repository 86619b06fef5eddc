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

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import msgspec

from holdfast.config.validation import close_match, dotted, find_mismatch
from holdfast.config.yaml_document import read
from holdfast.errors import ConfigurationError
from holdfast.ros.field_paths import Path, check_path, find_type, parse_path

__all__ = ["ROBOT_PARAMETERS", "ROLES", "ObservationTopic", "RobotCall", "RobotInterface"]

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
        "motion": ([], "Fields of the answer that are the measured motion, numbers or arrays."),
        "observation": ([], "Fields of the answer that are an observation, as a contact force."),
    },
    "done": {
        "done": ("", "Field of the answer or message: whether the task has succeeded."),
        "failed": ("", "Field of the answer or message: whether it has failed for good."),
        "reason": ("", "Text of the answer or message: why it has ended."),
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

_TOLD = {"success": "success", "message": "message"}
_SENT = {"trial": "trial", "step": "step"}

# Which field takes what, in the ready-made types. The parameters can say it otherwise.
_READY_MADE: Mapping[tuple[str, str], Mapping[str, Any]] = {
    ("sense", _SENSE): {
        **(_SENT | _TOLD),
        "index": "sensing_action",
        "observation": ["observation"],
    },
    **{
        ("act", name): {**(_SENT | _TOLD), "action": ["task_action"], "reward": "reward"}
        for name in (_ACT, _ACT_SERVICE)
    },
    ("done", _TRIAL): {**_TOLD, "trial": "trial", "done": "done", "failed": "failed"},
    ("steps", _TRIAL): {**_TOLD, "trial": "trial", "steps": "steps"},
    ("reset", _TRIAL): {**_TOLD, "trial": "trial", "constants": ["begin: true"]},
}

_PART = 0.45
"""Of ``environment.timeout_ms``: it is for a task action and for asking whether it was the last."""

_TIMEOUT = "environment.timeout_ms"

_REQUEST_KEYS = frozenset(("trial", "step", "index", "label", "fields", "action"))
_ANSWER_KEYS = frozenset(
    ("success", "message", "reward", "motion", "done", "failed", "reason", "steps")
)
"""Parameters that name fields of a request, or of an answer."""

_Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e300)]
_Finite = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300)]
_Numbers = _Finite | list[_Finite]
_Texts = str | list[Annotated[str, msgspec.Meta(min_length=1)]]


class RobotCall(NamedTuple):
    """One role: whom to call, and which field takes what.

    ``kind`` is ``srv``, ``action`` or ``msg``, and ``type`` the generated class. ``paths`` has by
    key (``trial``, ``index``, ``action``, ...) the fields that it names, except those of
    ``observation``, which still have ``{index}`` and ``{label}`` in them.
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

    The parameters are those of :data:`ROBOT_PARAMETERS`, by name, and ``environment.timeout_ms``.
    ``calls`` has the roles that are there. ``timeout_s`` is for an observation that nobody is asked
    for, and for each call by default.

    Raises ConfigurationError if a parameter is unknown, of another type or out of its bounds, a
    type cannot be imported, or does not have a field that a parameter names.
    """

    def __init__(
        self, parameters: Mapping[str, Any], sensing_actions: Sequence[str], action_size: int
    ) -> None:
        values = _given(parameters)
        self._sensing_actions = list(sensing_actions)
        self._action_size = action_size
        self._timeout_ms = float(parameters.get(_TIMEOUT, 60_000.0))
        self.timeout_s = 1e-3 * _PART * self._timeout_ms
        self.discovery_timeout_s = 1e-3 * values.get("environment.discovery_timeout_ms", 5000.0)
        self.observation = self._observation_topic(_section(values, "environment.observation."))
        own = self.observation is not None or any(
            values.get(f"environment.{role}.type", ready[0]) not in ready
            for role, ready in (("sense", (_SENSE,)), ("act", (_ACT, _ACT_SERVICE)))
        )
        self.calls: dict[str, RobotCall] = {}
        for role in ROLES:
            call = self._call(role, _section(values, f"environment.{role}."), own=own)
            if call is not None:
                self.calls[role] = call
        self._check_whole()
        self._check_step(values)

    def _observation_topic(self, given: Mapping[str, Any]) -> ObservationTopic | None:
        section = "environment.observation."
        if "topic" not in given:
            for key in ("type", "fields"):
                if key in given:
                    raise ConfigurationError(f"{section}{key} needs {section}topic")
            return None
        type_name = given.get("type", "")
        found = find_type(type_name, f"{section}type", ("msg",))
        fields = given.get("fields", [])
        if not fields:
            raise ConfigurationError(
                f"{section}fields is empty; it must name the fields of {type_name} that are the "
                "observation"
            )
        self._check_observation(found, fields, f"{section}fields")
        taken = given.get("taken", "after")
        if taken not in ("after", "during"):
            raise ConfigurationError(f"{section}taken is {taken!r}; it must be 'after' or 'during'")
        return ObservationTopic(given["topic"], type_name, found, fields, taken == "during")

    def _call(self, role: str, given: dict[str, Any], *, own: bool) -> RobotCall | None:
        section = f"environment.{role}."
        default_name, default_type = _DEFAULTS[role]
        nobody = own and ("type" not in given or role not in ("sense", "act"))
        name = given.pop("name", "" if nobody else default_name)
        if name in ("", "none"):
            for key in given:
                raise ConfigurationError(f"{section}{key} needs {section}name")
            return None
        type_name = given.pop("type", default_type)
        kinds = ("srv", "action", "msg") if role == "done" else ("srv", "action")
        found = find_type(type_name, f"{section}type", kinds)
        kind = type_name.split("/")[1]
        if role == "sense" and self.observation is not None and "observation" in given:
            raise ConfigurationError(
                f"{section}observation and environment.observation.topic are both given; the "
                "observation comes from one of them"
            )
        values = {**_READY_MADE.get((role, type_name), {}), **given}
        observation = values.get("observation", []) if self.observation is None else []
        constants = [
            self._constant(text, f"{section}constants") for text in values.get("constants", ())
        ]
        paths = {
            key: [parse_path(text, f"{section}{key}") for text in _listed(value)]
            for key, value in values.items()
            if key in _REQUEST_KEYS | _ANSWER_KEYS
        }
        if kind == "msg":
            if constants or not paths.keys() <= {"done", "failed", "reason"}:
                raise ConfigurationError(
                    f"{section}type is a message, so nothing is requested of it"
                )
            request, answer = None, found
        elif kind == "action":
            request, answer = found.Goal, found.Result
        else:
            request, answer = found.Request, found.Response
        for key, named in paths.items():
            for path in named:
                message = request if key in _REQUEST_KEYS else answer
                check_path(message, path, f"{section}{key}")
        for path, _ in constants:
            check_path(request, path, f"{section}constants")
        self._check_observation(answer, observation, f"{section}observation")
        call = RobotCall(
            role,
            name,
            type_name,
            kind,
            found,
            1e-3 * values.get("timeout_ms", _PART * self._timeout_ms),
            paths,
            observation,
            constants,
            values.get("scale", ()),
            values.get("values", ()),
        )
        self._check_sizes(call)
        return call

    def _check_sizes(self, call: RobotCall) -> None:
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
        # Performing a task action and asking whether the task is done share one deadline.
        done = calls.get("done")
        both_s = calls["act"].timeout_s + (0.0 if done is None else done.timeout_s)
        if 1e3 * both_s > self._timeout_ms:
            raise ConfigurationError(
                f"environment.act.timeout_ms and environment.done.timeout_ms are {1e3 * both_s:g} "
                f"together; that must not be more than environment.timeout_ms, {self._timeout_ms:g}"
            )

    def _check_step(self, values: Mapping[str, Any]) -> None:
        """Send no step to a robot that keeps no count: nobody knows it after a restart."""
        if "steps" in self.calls:
            return
        for role, call in self.calls.items():
            if call.key("step") in values:
                raise ConfigurationError(
                    f"{call.key('step')} needs environment.steps.name: without a count of the "
                    "robot's own nobody knows it after a restart"
                )
            paths = {key: path for key, path in call.paths.items() if key != "step"}
            self.calls[role] = call._replace(paths=paths)

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


def _given(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that say more than their defaults, of their types."""
    values: dict[str, Any] = {}
    for key, value in parameters.items():
        if key == _TIMEOUT:
            continue
        if key not in ROBOT_PARAMETERS:
            hint = close_match(key, ROBOT_PARAMETERS)
            raise ConfigurationError(f"{key} is no parameter of a robot{hint}")
        default, _ = ROBOT_PARAMETERS[key]
        if value in (None, "", [], default):
            continue
        if mismatch := find_mismatch(value, _type_of(key, default)):
            raise ConfigurationError(f"{dotted((key, *mismatch.path))} {mismatch.in_words()}")
        values[key] = _listed(value) if isinstance(default, list) else value
    return values


def _type_of(key: str, default: object) -> Any:
    if isinstance(default, float):
        return _Positive
    if key.endswith((".scale", ".values")):
        return _Numbers
    return _Texts if isinstance(default, list) else str


def _section(values: Mapping[str, Any], section: str) -> dict[str, Any]:
    return {
        key.removeprefix(section): value for key, value in values.items() if key.startswith(section)
    }


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
