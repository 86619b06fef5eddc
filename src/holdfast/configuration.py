"""The configuration file: from the thesis's YAML to a problem and validated settings.

A run is described by one file, and whoever reads an error has that file open. So every complaint
names the file, the line, the key with its section, the value and what is allowed instead, and it
comes before anything is run. The sections and keys are the thesis's, so that its files load
unchanged; ``problem: NAME`` on top and the sections ``selector``, ``offload``, ``recovery`` and
``environment`` are ours, and optional. A problem or an environment of one's own is looked for
beside the file and in the current directory, or where ``problem_directory`` and
``environment.directory`` say. Missing sections and keys take their defaults, and
:meth:`Configuration.to_yaml` writes down every value that is in use.

The bounds themselves stand with the settings (:mod:`holdfast.settings`) and with each problem (its
``Model`` and ``StateSpacePlanner``); what involves two keys is checked here.
"""

from __future__ import annotations

import difflib
import inspect
import json
import re
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import msgspec.inspect

from holdfast.contract import GAUSSIAN_OBSERVATIONS, has_general_observations, resolution_of
from holdfast.entropy import MAX_PRIOR_NEIGHBORS_POINTS
from holdfast.errors import (
    ConfigurationError,
    HoldfastError,
    InvalidValueError,
    UnknownProblemError,
)
from holdfast.files import read_bounded
from holdfast.problems import registry
from holdfast.problems.problem import Problem, ProblemBase
from holdfast.settings import (
    ActiveSensingSettings,
    EnvironmentSettings,
    OffloadSettings,
    ParticleFilterSettings,
    PlanningSettings,
    RecoverySettings,
    SelectorSettings,
    SimulatorSettings,
    estimator_of,
    unfit_for_the_method,
)
from holdfast.user_code import account_of_user_error, in_words
from holdfast.yaml_document import MAX_BYTES, Document, KeyPath, dotted, read, write

__all__ = ["Configuration", "build_problem", "load", "settings_keys"]

_SETTINGS: Mapping[str, type[msgspec.Struct]] = {
    "particle_filter": ParticleFilterSettings,
    "active_sensing": ActiveSensingSettings,
    "simulator": SimulatorSettings,
    "selector": SelectorSettings,
    "offload": OffloadSettings,
    "recovery": RecoverySettings,
    "environment": EnvironmentSettings,
}

# In the order in which a resolved configuration lists them.
_SECTIONS = (
    "model",
    "particle_filter",
    "state_space_planner",
    "active_sensing",
    "simulator",
    "selector",
    "offload",
    "recovery",
    "environment",
)

_ON_TOP = ("problem", "problem_directory")

# The thesis's files do not name their problem; these keys of `model` do, together.
_TELLING_KEYS: Mapping[str, frozenset[str]] = {
    "peg_in_hole_2d": frozenset({"peg_width"}),
    "multitier_peg_in_hole_2d": frozenset({"holes"}),
    "capsule_robot": frozenset({"robot_radius"}),
    "peg_in_hole_3d": frozenset({"peg_dim", "hole_tolerance"}),
}

_Struct = TypeVar("_Struct", bound=msgspec.Struct)


@dataclass(frozen=True)
class Configuration:
    """Everything that a run depends on, validated.

    Two configurations are equal if they say the same, wherever their files are.

    Attributes
    ----------
    problem : Problem
        The problem, built from ``model`` and ``state_space_planner``.
    problem_name : str
        Its registered name, or ``module:Class``.
    planning : PlanningSettings
        Settings of the planner.
    simulator : SimulatorSettings
        Trials, their length and their seed.
    model, state_space_planner : mapping
        The problem's two sections with all defaults filled in, as plain data.
    path : Path
        The file that this was read from.
    problem_directory : Path or None
        Where the module of ``module:Class`` was found; None for one that is installed.
    unlisted : tuple of str
        Arguments of the problem's constructor that have their default because a file cannot hold
        it, so that they are not in ``model``.
    offload : OffloadSettings
        Which services decide. ``tls`` is an absolute path.
    recovery : RecoverySettings
        The local service that decides while no other can.
    environment : EnvironmentSettings
        The world that the robot acts on. ``directory`` is where its module was found; None for one
        that is installed.
    """

    problem: Problem = field(compare=False, repr=False)
    problem_name: str
    planning: PlanningSettings
    simulator: SimulatorSettings
    model: Mapping[str, Any]
    state_space_planner: Mapping[str, Any]
    path: Path = field(compare=False)
    problem_directory: Path | None = field(default=None, compare=False)
    unlisted: tuple[str, ...] = field(default=(), compare=False)
    offload: OffloadSettings = field(default_factory=OffloadSettings)
    recovery: RecoverySettings = field(default_factory=RecoverySettings)
    environment: EnvironmentSettings = field(default_factory=EnvironmentSettings)

    def to_yaml(self) -> str:
        """Return the resolved configuration as a file that loads to an equal configuration.

        Returns
        -------
        str
            YAML with every key, those of the defaults included. A comment names the arguments of
            a problem's constructor whose defaults YAML cannot hold.
        """
        comment = (
            "# The configuration of a holdfast run, resolved: every key, with the value in use.\n"
        )
        if self.unlisted:
            comment += (
                "# Not listed, because YAML cannot hold what they are by default:\n"
                f"# {', '.join(f'model.{key}' for key in self.unlisted)}\n"
            )
        return comment + write(self._sections())

    def plain(self) -> dict[str, Any]:
        """Return the configuration as plain data, from which another process can rebuild it.

        Returns
        -------
        dict
            Text, numbers, lists and mappings; see :meth:`from_plain`.
        """
        return {"path": str(self.path.absolute()), "configuration": self._sections()}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Configuration:
        """Rebuild a configuration from :meth:`plain`, in another process as well.

        Parameters
        ----------
        plain : mapping
            What :meth:`plain` returned.

        Returns
        -------
        Configuration
            An equal configuration.

        Raises
        ------
        ConfigurationError
            If the data is not that of a configuration.
        """
        if not isinstance(plain.get("path"), str) or "configuration" not in plain:
            raise ConfigurationError(
                "a configuration as plain data has the keys path and configuration"
            )
        return _build(Document(plain["configuration"], {}), Path(plain["path"]), None, {})

    def _sections(self) -> dict[str, Any]:
        sections: dict[str, Any] = {
            "model": self.model,
            "state_space_planner": self.state_space_planner,
            "particle_filter": self.planning.particle_filter,
            "active_sensing": self.planning.active_sensing,
            "selector": self.planning.selector,
            "simulator": self.simulator,
            "offload": self.offload,
            "recovery": self.recovery,
            "environment": self.environment,
        }
        directory = self.problem_directory
        return {
            "problem": self.problem_name,
            **({} if directory is None else {"problem_directory": str(directory)}),
            **{name: msgspec.to_builtins(sections[name]) for name in _SECTIONS},
        }


def load(
    path: str | Path,
    *,
    problem: str | None = None,
    num_trials: int | None = None,
    seed: int | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Configuration:
    """Read a configuration file.

    Parameters
    ----------
    path : str or Path
        The YAML file.
    problem : str, optional
        Name of the problem, instead of the one that the file gives or implies.
    num_trials, seed : int, optional
        Instead of the file's ``simulator.num_trials`` and ``simulator.seed``.
    overrides : mapping, optional
        Further values instead of the file's, by ``section.key`` (``offload.services``). None is a
        value, too. Paths among them are relative to the current directory.

    Returns
    -------
    Configuration
        The problem and the settings.

    Raises
    ------
    ConfigurationError
        If the file cannot be read or used.
    UnknownProblemError
        If it names a problem that is neither registered nor importable.
    """
    path = Path(path)
    document = read(_content(path), str(path))
    given: dict[str, Any] = {}
    if num_trials is not None:
        given["simulator.num_trials"] = num_trials
    if seed is not None:
        given["simulator.seed"] = seed
    given |= overrides or {}
    return _build(
        document, path, problem, {_section_and_key(name): value for name, value in given.items()}
    )


def settings_keys() -> dict[str, str]:
    """Return every ``section.key`` whose meaning does not depend on the problem.

    Returns
    -------
    dict of str
        What its value may be, and its default, in words.
    """
    keys = {}
    for section, schema in _SETTINGS.items():
        defaults = msgspec.to_builtins(schema())
        fields = msgspec.inspect.type_info(schema).fields  # type: ignore[attr-defined]
        for item in fields:
            default = json.dumps(defaults[item.encode_name])
            keys[f"{section}.{item.encode_name}"] = f"{_described(item.type)}; default {default}"
    return keys


def build_problem(
    name: str,
    problem_class: type,
    model: Mapping[str, Any],
    state_space_planner: Mapping[str, Any],
) -> Problem:
    """Build a problem from plain data that did not come from a file.

    Parameters
    ----------
    name : str
        What the problem is called in messages.
    problem_class : type
        As :func:`holdfast.problems.registry.problem_class` returns it.
    model, state_space_planner : mapping
        The problem's two sections.

    Raises
    ------
    ConfigurationError
        If the data does not fit the problem.
    """
    sections = {"model": model, "state_space_planner": state_space_planner}
    source = _Source(Document(sections, {}), Path(name), {})
    schemas = {**_SETTINGS, **_schemas_of(problem_class)}
    return _build_problem(source, name, problem_class, schemas)[0]


def _section_and_key(name: str) -> tuple[str, str]:
    section, _, key = name.partition(".")
    return section, key


def _content(path: Path) -> bytes:
    """Return what is in the file, but no more than one byte over the limit."""
    try:
        return read_bounded(path, MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigurationError(f"{path}: there is no such file") from None
    except IsADirectoryError:
        raise ConfigurationError(f"{path}: is a directory, not a configuration file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigurationError(f"{path}: cannot be read: {reason}") from None


class _Source:
    """A configuration before it is checked, and the way to say where in it something is wrong."""

    def __init__(
        self, document: Document, path: Path, overrides: Mapping[tuple[str, str], Any]
    ) -> None:
        self.path = path
        self._document = document
        self._overrides = frozenset(overrides)
        data = document.data
        if data is None:
            raise ConfigurationError(
                f"{path}: is empty; a configuration has the sections {', '.join(_SECTIONS)}"
            )
        if not isinstance(data, Mapping):
            raise ConfigurationError(
                f"{path}: is {_kind(data)} at the top, where a mapping of the sections"
                f" {', '.join(_SECTIONS)} is needed"
            )
        for name in data:
            if name not in (*_ON_TOP, *_SECTIONS):
                raise self.unknown((name,), (*_ON_TOP, *_SECTIONS))
        self.problem: Any = data.get("problem")
        self.problem_directory: Any = data.get("problem_directory")
        self.sections: dict[str, dict[str, Any]] = {}
        for name in _SECTIONS:
            section = data.get(name)
            if section is not None and not isinstance(section, Mapping):
                raise self.error((name,), f"is {_shown(section)}; expected a mapping of keys")
            self.sections[name] = dict(section or {})
        for (name, key), value in overrides.items():
            if name not in _SECTIONS:
                raise self.unknown((name,), _SECTIONS)
            self.sections[name][key] = value

    def place(self, path: KeyPath) -> str:
        """Return the file, and the line of the value at ``path`` where there is one."""
        line = self._document.line(path)
        return f"{self.path}" if line is None else f"{self.path}, line {line}"

    def is_overridden(self, path: KeyPath) -> bool:
        """Tell whether the value at ``path`` was given instead of the file's."""
        return path[:2] in self._overrides

    def directory_of(self, path: KeyPath) -> Path:
        """Return the directory to which a relative path that stands at ``path`` is relative."""
        return Path.cwd() if self.is_overridden(path) else self.path.absolute().parent.resolve()

    def error(self, path: KeyPath, message: str) -> ConfigurationError:
        """Return an error about the value at ``path``."""
        if self.is_overridden(path):
            return ConfigurationError(
                f"{dotted(path)}, given instead of what {self.path} says, {message}"
            )
        return ConfigurationError(f"{self.place(path)}: {dotted(path)} {message}")

    def unknown(
        self, path: KeyPath, allowed: Collection[str], belongs_to: Iterable[str] = ()
    ) -> ConfigurationError:
        """Return an error about a key that is not one of ``allowed``."""
        what = "section" if len(path) == 1 else "key"
        homes = [section for section in belongs_to if section != path[0]]
        hint = (
            f"is a key of {' and '.join(homes)}, not of {dotted(path[:-1])}"
            if homes
            else f"is not a known {what}{_close_match(str(path[-1]), allowed)}"
        )
        text = f"{hint}\nallowed: {', '.join(allowed) or 'no keys'}"
        if len(path) == 2 and self.is_overridden(path):
            # The key itself was given instead of the file's, which has nothing to do with it.
            return ConfigurationError(f"{dotted(path)} {text}")
        return self.error(path, text)


def _build(
    document: Document,
    path: Path,
    problem_name: str | None,
    overrides: Mapping[tuple[str, str], Any],
) -> Configuration:
    """Check everything and build the problem."""
    source = _Source(document, path, overrides)
    name, problem_class, directory = _find_problem(source, problem_name)
    schemas = {**_SETTINGS, **_schemas_of(problem_class)}
    particle_filter = _convert(source, "particle_filter", ParticleFilterSettings, schemas)
    active_sensing = _convert(source, "active_sensing", ActiveSensingSettings, schemas)
    selector = _convert(source, "selector", SelectorSettings, schemas)
    simulator = _convert(source, "simulator", SimulatorSettings, schemas)
    recovery = _convert(source, "recovery", RecoverySettings, schemas)
    offload = _checked_offload(
        source, _convert(source, "offload", OffloadSettings, schemas), recovery
    )
    environment = _located_environment(
        source, _convert(source, "environment", EnvironmentSettings, schemas)
    )
    problem, model, planner, unlisted = _build_problem(source, name, problem_class, schemas)

    num_particles = particle_filter.num_particles
    num_neighbors = active_sensing.num_nearest_neighbors
    estimator = estimator_of(selector, num_particles)
    if (
        selector.method in ("action_entropy", "path_entropy", "state_entropy")
        and estimator in {"nearest_neighbor", "prior_neighbors"}
        and num_neighbors >= num_particles
    ):
        raise source.error(
            ("active_sensing", "num_nearest_neighbors"),
            f"is {num_neighbors}; the {estimator} estimator needs it below"
            f" particle_filter.num_particles, which is {num_particles}",
        )
    of_states = selector.method == "state_entropy"
    has_a_list = isinstance(selector.resolution, tuple)
    if of_states or (has_a_list and selector.method not in ("random", "fixed")):
        try:
            resolution_of(problem, selector.resolution, of_states=of_states)
        except InvalidValueError as error:
            key = "method" if selector.resolution is None else "resolution"
            raise source.error(
                ("selector", key), str(error).removeprefix(f"selector.{key} ")
            ) from None
    if (
        selector.method in ("action_entropy", "path_entropy", "state_entropy")
        and estimator == "prior_neighbors"
        and num_particles > MAX_PRIOR_NEIGHBORS_POINTS
    ):
        raise source.error(
            ("particle_filter", "num_particles"),
            f"is {num_particles}; the prior_neighbors estimator allows"
            f" {MAX_PRIOR_NEIGHBORS_POINTS}",
        )
    planning = PlanningSettings(
        particle_filter=particle_filter,
        active_sensing=active_sensing,
        selector=selector,
        sensing_interval=simulator.sensing_intervals,
    )
    if (unfit := unfit_for_the_method(planning)) is not None:
        raise source.error(*unfit)
    num_actions = len(problem.sensing_actions)
    if selector.method == "fixed" and selector.sensing_action >= num_actions:
        raise source.error(
            ("selector", "sensing_action"),
            f"is {selector.sensing_action}; {name} has the sensing actions 0 to {num_actions - 1}"
            f" ({', '.join(problem.sensing_actions)})",
        )
    return Configuration(
        problem=problem,
        problem_name=name,
        planning=planning,
        simulator=simulator,
        model=model,
        state_space_planner=planner,
        path=path,
        problem_directory=directory,
        unlisted=unlisted,
        offload=offload,
        recovery=recovery,
        environment=environment,
    )


def _schemas_of(problem_class: type) -> dict[str, type[msgspec.Struct]]:
    """Return the types of a problem's own sections, as far as it declares them."""
    schemas: dict[str, type[msgspec.Struct]] = {}
    for section, attribute in (("model", "Model"), ("state_space_planner", "StateSpacePlanner")):
        schema = getattr(problem_class, attribute, None)
        if isinstance(schema, type) and issubclass(schema, msgspec.Struct):
            schemas[section] = schema
    return schemas


def _find_problem(source: _Source, name: str | None) -> tuple[str, type, Path | None]:
    """Return the problem's name, its class and the directory where its module was looked up.

    The name is given, written in the file or told by its keys.
    """
    given = name is not None
    if name is None:
        if source.problem is None:
            name = _infer_problem(source)
        elif isinstance(source.problem, str):
            name = source.problem
        else:
            raise source.error(
                ("problem",),
                f"is {_shown(source.problem)}; expected one of {', '.join(registry.names())},"
                " or module:Class",
            )
    directory = _problem_directory(source, name, given=given)
    try:
        problem_class = registry.problem_class(
            name, search_directory=directory or source.path.absolute().parent
        )
    except UnknownProblemError as error:
        if given or source.problem is None:
            raise
        raise UnknownProblemError(f"{source.place(('problem',))}: {error}") from error
    return name, problem_class, directory


def _problem_directory(source: _Source, name: str, *, given: bool) -> Path | None:
    """Return the directory that holds the problem's module; None if it is installed."""
    value = source.problem_directory
    key = ("problem_directory",)
    if value is not None and not isinstance(value, str):
        raise source.error(key, f"is {_shown(value)}; expected the path of a directory")
    module, colon, _ = name.partition(":")
    if not colon:
        if value is not None and not given:
            raise source.error(
                key, f"is {_shown(value)}; only a problem that is named module:Class has one"
            )
        return None
    return _module_directory(source, key, value, module)


def _module_directory(source: _Source, key: KeyPath, value: str | None, module: str) -> Path | None:
    """Return the directory that holds a user's module, as ``value`` at ``key`` says.

    If it is None, that is the file's own, else the current one, for a resolved configuration stands
    in the directory of its run, far from the module; None if it is in neither.
    """
    package = module.partition(".")[0]
    if value is not None:
        directory = source.directory_of(key) / value
        if not directory.is_dir():
            raise source.error(key, f"is {_shown(value)}, where there is no directory")
        if not _holds(directory, package):
            raise source.error(key, f"is {_shown(value)}, where there is no module {package}")
        return directory.resolve()
    beside = source.path.absolute().parent.resolve()
    return next(
        (directory for directory in (beside, Path.cwd()) if _holds(directory, package)), None
    )


def _checked_offload(
    source: _Source, offload: OffloadSettings, recovery: RecoverySettings
) -> OffloadSettings:
    """Check what involves two values, and make paths absolute."""
    for index, service in enumerate(offload.services):
        first = offload.services.index(service)
        if first != index:
            raise source.error(
                ("offload", "services", index),
                f"is {_shown(service)}, as offload.services[{first}] is already; each stands once,"
                " in order of preference",
            )
    deadline_ms, timeout_ms = offload.decision_deadline_ms, offload.decision_timeout_ms
    if deadline_ms is not None:
        key = ("offload", "decision_deadline_ms")
        if recovery.launch == "never":
            raise source.error(
                key,
                f"is {deadline_ms:g}; then the local service decides instead, which is never there"
                " with recovery.launch never; leave one of the two out",
            )
        if deadline_ms >= timeout_ms:
            raise source.error(
                key,
                f"is {deadline_ms:g}; it must be below offload.decision_timeout_ms, after which a"
                f" decision is given up, which is {timeout_ms:g}",
            )
    if offload.detection_timeout_ms > timeout_ms:
        raise source.error(
            ("offload", "detection_timeout_ms"),
            f"is {offload.detection_timeout_ms:g}; it must be at most offload.decision_timeout_ms,"
            f" after which a decision is given up, which is {timeout_ms:g}",
        )
    if offload.tls is None:
        return offload
    directory = source.directory_of(("offload", "tls")) / offload.tls
    return msgspec.structs.replace(offload, tls=str(directory.resolve()))


def _located_environment(source: _Source, settings: EnvironmentSettings) -> EnvironmentSettings:
    """Check the name of the environment and find its module, without importing it."""
    name = settings.object
    if name is None:
        return settings
    key = ("environment", "object")
    module, colon, class_name = name.partition(":")
    if not colon:
        directory_key = ("environment", "directory")
        if settings.directory is not None and (
            source.is_overridden(directory_key) or not source.is_overridden(key)
        ):
            raise source.error(
                directory_key,
                f"is {_shown(settings.directory)}; only an environment that is named module:Class"
                " has one",
            )
        return msgspec.structs.replace(settings, directory=None)
    if not all(part.isidentifier() for part in [*module.split("."), class_name]):
        raise source.error(
            key, f"is {_shown(name)}; expected module:Class or the name of an entry point"
        )
    directory = _module_directory(source, ("environment", "directory"), settings.directory, module)
    package = module.partition(".")[0]
    if directory is None and package not in sys.modules and PathFinder.find_spec(package) is None:
        raise source.error(
            key,
            f"is {_shown(name)}; there is no module {package} beside {source.path.name}, in the"
            " current directory or among the installed ones",
        )
    return msgspec.structs.replace(
        settings, directory=None if directory is None else str(directory)
    )


def _holds(directory: Path, module: str) -> bool:
    return PathFinder.find_spec(module, [str(directory)]) is not None


def _infer_problem(source: _Source) -> str:
    """Return the one problem that the keys of ``model`` tell."""
    keys = set(source.sections["model"])
    names = registry.names()
    told = [name for name in names if name in _TELLING_KEYS and _TELLING_KEYS[name] <= keys]
    if len(told) == 1:
        return told[0]
    why = (
        f"the keys of its model belong to {' and '.join(told)}"
        if told
        else "the keys of its model do not tell it"
    )
    raise ConfigurationError(
        f"{source.path}: names no problem, and {why}; put 'problem: NAME' on top\n"
        f"problems: {', '.join(names)}"
    )


def _convert(
    source: _Source,
    section: str,
    schema: type[_Struct],
    schemas: Mapping[str, type[msgspec.Struct]],
) -> _Struct:
    """Return one section as its validated struct."""
    data = source.sections[section]
    try:
        return msgspec.convert(data, type=schema)
    except msgspec.ValidationError as error:
        raise _explain(source, section, schema, schemas, str(error)) from None


def _explain(
    source: _Source,
    section: str,
    schema: type[msgspec.Struct],
    schemas: Mapping[str, type[msgspec.Struct]],
    text: str,
) -> ConfigurationError:
    """Turn msgspec's account of what is wrong in a section into ours.

    Its texts are ``Expected `int` >= 1 - at `$.holes[2].depth```: the path is taken from there, the
    value from the data, and what is allowed from the type.
    """
    found = re.search(r"^(?P<what>.*?)(?: - at (?:`key` in )?`\$(?P<path>.*)`)?$", text, re.DOTALL)
    what = found["what"] if found else text
    inner: list[str | int] = []
    for key, index in re.findall(r"\.?([^.\[\]]+)|\[(\d+)\]", (found and found["path"]) or ""):
        inner.append(int(index) if index else key)
    path = (section, *inner)
    if "[...]" in text or "`key` in" in text:
        # msgspec does not say under which key of a free mapping the value stands.
        return source.error(path, f"holds something that is not allowed: {what}")
    field_type = _type_at(msgspec.inspect.type_info(schema), inner)

    if named := re.match(r"Object contains unknown field `(.*)`", what, re.DOTALL):
        key = named[1]
        allowed = _keys(field_type)
        homes = [] if inner else [name for name, other in schemas.items() if key in _fields(other)]
        return source.unknown((*path, key), allowed, homes)
    if named := re.match(r"Object missing required field `(.*)`", what):
        return source.error((*path, named[1]), "is missing; it has no default")

    value: Any = source.sections[section]
    for part in inner:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            return source.error(path, f"is not allowed: {what}")
    choices = _choices(field_type)
    close = _close_match(value, choices) if isinstance(value, str) else ""
    if isinstance(value, str) and isinstance(field_type, msgspec.inspect.VarTupleType):
        close = f", as in [{value}]"
    length = f" (a list of {len(value)})" if isinstance(value, list) else ""
    expected = _described(field_type) or what
    return source.error(path, f"is {_shown(value)}{length}; expected {expected}{close}")


def _build_problem(
    source: _Source,
    name: str,
    problem_class: type,
    schemas: Mapping[str, type[msgspec.Struct]],
) -> tuple[Problem, dict[str, Any], dict[str, Any], tuple[str, ...]]:
    """Return the problem, its two sections with their defaults, and the defaults left out."""
    resolved: dict[str, dict[str, Any]] = {}
    unlisted: tuple[str, ...] = ()
    for section in ("model", "state_space_planner"):
        if section in schemas:
            settings = _convert(source, section, schemas[section], schemas)
            resolved[section] = msgspec.to_builtins(settings)
        else:
            resolved[section] = source.sections[section]
    arguments = resolved
    if "model" not in schemas and "state_space_planner" not in schemas:
        defaults = _keyword_arguments(source, problem_class)
        arguments = {
            section: {key: _in_the_form_of(defaults.get(key), value) for key, value in keys.items()}
            for section, keys in resolved.items()
        }
        left = {
            key: _as_plain(default)
            for key, default in defaults.items()
            if key not in resolved["model"] and key not in resolved["state_space_planner"]
        }
        unlisted = tuple(key for key, plain in left.items() if plain is _NOT_PLAIN)
        resolved["model"].update(
            {key: plain for key, plain in left.items() if plain is not _NOT_PLAIN}
        )
    model, planner = resolved["model"], resolved["state_space_planner"]
    # A class that only has the members of the protocol is built as ProblemBase builds.
    build = getattr(problem_class, "from_settings", None)
    try:
        if build is None:
            problem = ProblemBase.from_settings.__func__(  # type: ignore[attr-defined]
                problem_class, arguments["model"], arguments["state_space_planner"]
            )
        else:
            problem = build(arguments["model"], arguments["state_space_planner"])
        missing = [member for member in _needed_members(problem) if not hasattr(problem, member)]
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        complaint = _cannot_be_built(source, name, resolved, error)
        if complaint is None:
            raise
        raise complaint from error
    if missing:
        raise ConfigurationError(
            f"{source.path}: {name} is no problem: it lacks {', '.join(missing)}"
        )
    return problem, model, planner, unlisted


def _keyword_arguments(source: _Source, problem_class: type) -> dict[str, Any]:
    """Check keys that are arguments of the constructor, and return those arguments' defaults."""
    build = getattr(problem_class, "from_settings", None)
    if getattr(build, "__func__", None) not in (None, ProblemBase.from_settings.__func__):  # type: ignore[attr-defined]
        return {}
    try:
        parameters = inspect.signature(problem_class).parameters.values()
    except (TypeError, ValueError):
        return {}  # compiled code does not always tell; then its constructor complains
    named = {
        parameter.name: parameter.default
        for parameter in parameters
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        for section in ("model", "state_space_planner"):
            for key in source.sections[section]:
                if key not in named:
                    homes = [other for other, schema in _SETTINGS.items() if key in _fields(schema)]
                    raise source.unknown((section, key), list(named), homes)
    return {
        key: default for key, default in named.items() if default is not inspect.Parameter.empty
    }


_NOT_PLAIN = object()


def _as_plain(value: Any) -> Any:
    """Return what a file holds to mean ``value``; ``_NOT_PLAIN`` if there is no such thing."""
    if isinstance(value, list | tuple):
        items = [_as_plain(item) for item in value]
        return _NOT_PLAIN if any(item is _NOT_PLAIN for item in items) else items
    if isinstance(value, dict):
        values = {key: _as_plain(item) for key, item in value.items()}
        plain = all(isinstance(key, str) for key in values) and not any(
            item is _NOT_PLAIN for item in values.values()
        )
        return values if plain else _NOT_PLAIN
    # Exactly these types: a subclass (an enumeration, a NumPy number) would come back as another.
    if value is None or type(value) in (bool, str):
        return value
    if type(value) is int:
        return value if -(2**63) <= value < 2**63 else _NOT_PLAIN
    if type(value) is float:
        return value if abs(value) < float("inf") else _NOT_PLAIN
    return _NOT_PLAIN


def _in_the_form_of(default: Any, value: Any) -> Any:
    """Return ``value`` with a tuple for each list that stands where the default has a tuple.

    So a constructor gets the same from a file in which its defaults are written down.
    """
    if not isinstance(value, list) or not isinstance(default, list | tuple):
        return value
    # A longer list continues like the default's last item.
    forms = [*default[: len(value)], *default[-1:] * (len(value) - len(default))]
    items = [_in_the_form_of(form, item) for form, item in zip(forms, value, strict=False)]
    items += value[len(items) :]
    return tuple(items) if isinstance(default, tuple) else items


def _cannot_be_built(
    source: _Source, name: str, sections: Mapping[str, Mapping[str, Any]], error: BaseException
) -> ConfigurationError | None:
    """Return the problem's own complaint, with the line of the first of its keys named there.

    A complaint about no key is a defect of the problem and comes with its frames; None means that
    the problem is ours, and so is the defect.
    """
    text = str(error) if isinstance(error, HoldfastError | ValueError) else in_words(error)
    text = text or type(error).__name__
    mentioned = [
        (at.start(), (section, key))
        for section, keys in sections.items()
        for key in keys
        if (at := re.search(rf"(?<!\w){re.escape(key)}(?!\w)", text))
    ]
    # ProblemBase wraps the TypeError of a call that does not fit; the constructor may raise one.
    cause = error.__cause__ if isinstance(error.__cause__, TypeError) else error
    refused = isinstance(error, HoldfastError | msgspec.ValidationError | ValueError)
    account = account_of_user_error(cause, name)
    if account is not None and not (refused and mentioned and cause is error):
        return ConfigurationError(f"{source.path}: {account}")
    if name in registry.BUILT_IN and not refused and not isinstance(error, TypeError):
        return None
    if mentioned:
        return ConfigurationError(f"{source.place(min(mentioned)[1])}: {text}")
    return ConfigurationError(f"{source.path}: {name} cannot be built: {text}")


def _needed_members(problem: Any) -> list[str]:
    """Return the names of the attributes and methods that a problem has to have."""
    names = [name for name in (*Problem.__annotations__, *vars(Problem)) if name[0] != "_"]
    if has_general_observations(problem):
        # Its own likelihood is in their place.
        return [name for name in names if name not in GAUSSIAN_OBSERVATIONS]
    return names


def _fields(schema: type[msgspec.Struct]) -> list[str]:
    return [field.encode_name for field in msgspec.structs.fields(schema)]


def _alternatives(field_type: msgspec.inspect.Type | None) -> list[msgspec.inspect.Type]:
    """Return the members of a union, or the type itself."""
    while isinstance(field_type, msgspec.inspect.Metadata):
        field_type = field_type.type
    if isinstance(field_type, msgspec.inspect.UnionType):
        return [inner for member in field_type.types for inner in _alternatives(member)]
    return [] if field_type is None else [field_type]


def _type_at(
    field_type: msgspec.inspect.Type, path: Collection[str | int]
) -> msgspec.inspect.Type | None:
    """Return the type that a struct gives to the value at ``path``, None where that is unclear."""
    current: msgspec.inspect.Type | None = field_type
    for part in path:
        following: msgspec.inspect.Type | None = None
        for candidate in _alternatives(current):
            if isinstance(candidate, msgspec.inspect.StructType):
                fields = {field.encode_name: field.type for field in candidate.fields}
                following = fields.get(str(part))
            elif isinstance(candidate, msgspec.inspect.ListType | msgspec.inspect.VarTupleType):
                following = candidate.item_type
            elif isinstance(candidate, msgspec.inspect.TupleType) and isinstance(part, int):
                following = candidate.item_types[part]
        current = following
    return current


def _keys(field_type: msgspec.inspect.Type | None) -> list[str]:
    """Return the keys of a mapping of that type."""
    return [
        field.encode_name
        for candidate in _alternatives(field_type)
        if isinstance(candidate, msgspec.inspect.StructType)
        for field in candidate.fields
    ]


def _choices(field_type: msgspec.inspect.Type | None) -> list[str]:
    """Return the texts of which a value of that type is one."""
    return [
        str(value)
        for candidate in _alternatives(field_type)
        if isinstance(candidate, msgspec.inspect.LiteralType)
        for value in candidate.values
    ]


def _described(field_type: msgspec.inspect.Type | None) -> str:
    """Return in words what a value of that type may be; empty where we have no words."""
    words = []
    for candidate in _alternatives(field_type):
        match candidate:
            case msgspec.inspect.IntType():
                words.append(f"a whole number{_bounds(candidate)}")
            case msgspec.inspect.FloatType():
                words.append(f"a number{_bounds(candidate)}")
            case msgspec.inspect.StrType():
                words.append(f"text{_lengths(candidate, ' characters')}")
            case msgspec.inspect.BoolType():
                words.append("true or false")
            case msgspec.inspect.NoneType():
                words.append("null")
            case msgspec.inspect.LiteralType():
                choices = ", ".join(map(str, candidate.values))
                words.append(f"one of {choices}" if len(candidate.values) > 1 else choices)
            case msgspec.inspect.TupleType():
                words.append(f"a list of {len(candidate.item_types)}")
            case msgspec.inspect.ListType() | msgspec.inspect.VarTupleType():
                words.append(f"a list{_lengths(candidate)}")
            case msgspec.inspect.DictType():
                words.append("a mapping of keys")
            case msgspec.inspect.StructType():
                words.append(f"a mapping with the keys {', '.join(_keys(candidate))}")
            case _:
                return ""
    return " or ".join(words)


def _bounds(number: msgspec.inspect.IntType | msgspec.inspect.FloatType) -> str:
    bounds = ((">=", number.ge), (">", number.gt), ("<=", number.le), ("<", number.lt))
    given = [
        f"{sign} {f'{bound:g}' if isinstance(bound, float) else bound}"
        for sign, bound in bounds
        if bound is not None
    ]
    return f" {' and '.join(given)}" if given else ""


def _lengths(
    items: msgspec.inspect.ListType | msgspec.inspect.VarTupleType | msgspec.inspect.StrType,
    unit: str = "",
) -> str:
    bounds = (("at least", items.min_length), ("at most", items.max_length))
    given = [f"{sign} {bound}" for sign, bound in bounds if bound is not None]
    return f" of {' and '.join(given)}{unit}" if given else ""


def _close_match(text: str, allowed: Iterable[str]) -> str:
    """Return a question after the allowed texts of which this is a part, or after the nearest."""
    texts = list(allowed)
    part = rf"(?:^|_){re.escape(text.lower())}(?:_|$)"
    close = [each for each in texts if re.search(part, each)]
    if len(close) != 2:
        close = difflib.get_close_matches(text.lower(), texts, n=1)
    return f"; did you mean {' or '.join(close)}?" if close else ""


def _kind(value: Any) -> str:
    """Return in words what a value at the top of a file is."""
    return "a list" if isinstance(value, list) else _shown(value)


def _shown(value: Any) -> str:
    """Return a value as the file may have it, on one line and not long."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else f"{text[:57]}..."
