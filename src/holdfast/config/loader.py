"""The configuration file: from the thesis's YAML to a problem and validated settings.

One file describes a run, and it is checked before anything is run. The sections and keys are the
thesis's, so that its files load unchanged; ``problem: NAME`` on top and the sections ``selector``,
``offload``, ``recovery`` and ``environment`` are ours, and optional. The module of a user's problem
or environment is looked for beside the file and in the current directory, or in
``problem_directory`` and ``environment.directory``. Missing sections and keys take their defaults,
and :meth:`Configuration.to_yaml` writes every value in use.

The bounds stand with the settings (:mod:`holdfast.planning.settings`) and with each problem (its
``Model`` and ``StateSpacePlanner``). Checks that involve two keys are here, those of planning with
its settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from holdfast.config.problem_builder import build_from, find_problem, schemas_of
from holdfast.config.reading import absolute_endpoint, read_bounded
from holdfast.config.registry import names
from holdfast.config.source import SECTIONS, Source, module_directory, name_of_today
from holdfast.config.yaml_document import MAX_BYTES, Document, read, write
from holdfast.errors import ConfigurationError, InvalidValueError
from holdfast.numerics.arrays import plain
from holdfast.planning.settings import (
    UNINFORMED_METHODS,
    ActiveSensingSettings,
    EnvironmentSettings,
    LostSettings,
    OffloadSettings,
    ParticleFilterSettings,
    PlanningSettings,
    RecoverySettings,
    SelectorSettings,
    SimulatorSettings,
    unfit_for_the_method,
)
from holdfast.printable import did_you_mean
from holdfast.problems.attributes import resolution_of, sensing_labels
from holdfast.problems.problem import Problem
from holdfast.validation import shown


@dataclass(frozen=True)
class Configuration:
    """Everything that a run depends on, validated.

    Two configurations are equal if they say the same, wherever their files are.

    Attributes
    ----------
    problem : Problem
        Built from ``model`` and ``state_space_planner``.
    problem_name : str
        Its registered name, or ``module:Class``.
    model, state_space_planner : mapping
        The problem's two sections with all defaults filled in, as plain data.
    path : Path
        The file that this was read from; absolute.
    problem_directory : Path or None
        Where the module of ``module:Class`` was found; None for one that is installed.
    unlisted : tuple of str
        Arguments of the problem's constructor that have their default because a file cannot hold
        it, so that they are not in ``model``.
    offload : OffloadSettings
        ``tls`` is an absolute path.
    environment : EnvironmentSettings
        ``directory`` is where its module was found; None for one that is installed.
    given, overrides : mapping
        The keys that the file or an override gives, by section; what replaces the file's values.
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
    lost: LostSettings = field(default_factory=LostSettings)
    environment: EnvironmentSettings = field(default_factory=EnvironmentSettings)
    given: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    overrides: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)

    def to_yaml(self) -> str:
        """Return the resolved configuration as a file that loads to an equal configuration.

        It has every key, those of the defaults included. A comment names the arguments of a
        problem's constructor whose defaults YAML cannot hold.
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
        """Return the configuration as plain data, from which another process can rebuild it."""
        return {"path": str(self.path), "configuration": self._sections()}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Configuration:
        """Rebuild a configuration from :meth:`plain`, in another process as well.

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
            "lost": self.lost,
            "environment": self.environment,
        }
        directory = self.problem_directory
        return {
            "problem": self.problem_name,
            **({} if directory is None else {"problem_directory": str(directory)}),
            **{name: msgspec.to_builtins(sections[name]) for name in SECTIONS},
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
    problem : str, optional
        Name of the problem, instead of the one that the file gives or implies.
    num_trials, seed : int, optional
        Instead of the file's ``simulator.num_trials`` and ``simulator.seed``.
    overrides : mapping, optional
        Further values instead of the file's, by ``section.key`` (``offload.services``). None is a
        value, too. Paths among them are relative to the current directory.

    Raises
    ------
    ConfigurationError
        If the file cannot be read or used.
    UnknownProblemError
        If it names a problem that is neither registered nor importable.
    """
    path = Path(path)
    document = read(_content(path), str(path))
    of_simulator = {"simulator.num_trials": num_trials, "simulator.seed": seed}
    given = {name: value for name, value in of_simulator.items() if value is not None}
    return _build(document, path, problem, plain({**given, **(overrides or {})}))


def _content(path: Path) -> bytes:
    """Return the content of the file, at most one byte over the limit."""
    try:
        if path.suffix != ".py":
            return read_bounded(path, MAX_BYTES + 1)
        problem, what = f"{path.stem}:CLASS", "is Python"
    except FileNotFoundError:
        problem, what = str(path), "there is no such file"
        if problem not in names() and ":" not in problem:
            beside = [str(each) for each in path.parent.glob("*.y*ml")]
            raise ConfigurationError(f"{path}: {what}{did_you_mean(problem, beside)}") from None
    except IsADirectoryError:
        raise ConfigurationError(f"{path}: is a directory, not a configuration file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigurationError(f"{path}: cannot be read: {reason}") from None
    raise ConfigurationError(
        f"{path}: {what}; {problem} is a problem, and a run needs a configuration file: one with "
        f"the line 'problem: {problem}' is enough"
    )


def _build(
    document: Document, path: Path, problem_name: str | None, overrides: Mapping[str, Any]
) -> Configuration:
    """Check everything and build the problem."""
    source = Source(document, path, overrides)
    name, problem_class, directory = find_problem(source, name_of_today(problem_name))
    source.schemas |= schemas_of(problem_class)
    particle_filter = source.section("particle_filter", ParticleFilterSettings)
    active_sensing = source.section("active_sensing", ActiveSensingSettings)
    selector = source.section("selector", SelectorSettings)
    simulator = source.section("simulator", SimulatorSettings)
    recovery = source.section("recovery", RecoverySettings)
    offload = _checked_offload(source, source.section("offload", OffloadSettings), recovery)
    lost = source.section("lost", LostSettings)
    environment = _located_environment(source, source.section("environment", EnvironmentSettings))
    given = {section: tuple(keys) for section, keys in source.sections.items()}
    built = build_from(source, name, problem_class)

    of_states = selector.method == "state_entropy"
    has_a_list = isinstance(selector.resolution, tuple)
    if of_states or (has_a_list and selector.method not in UNINFORMED_METHODS):
        try:
            resolution_of(built.problem, selector.resolution, of_states=of_states)
        except InvalidValueError as error:
            key = "method" if selector.resolution is None else "resolution"
            raise source.error(
                ("selector", key), str(error).removeprefix(f"selector.{key} ")
            ) from None
    planning = PlanningSettings(
        particle_filter=particle_filter,
        active_sensing=active_sensing,
        selector=selector,
        sensing_interval=simulator.sensing_intervals,
    )
    if (unfit := unfit_for_the_method(planning)) is not None:
        raise source.error(*unfit)
    actions = sensing_labels(built.problem)
    if selector.method == "fixed" and selector.sensing_action >= len(actions):
        raise source.error(
            ("selector", "sensing_action"),
            f"is {selector.sensing_action}; {name} has the sensing actions 0 to {len(actions) - 1}"
            f" ({', '.join(actions)})",
        )
    return Configuration(
        **built._asdict(),
        problem_name=name,
        planning=planning,
        simulator=simulator,
        path=source.directory / path.name,
        problem_directory=directory,
        offload=offload,
        recovery=recovery,
        lost=lost,
        environment=environment,
        given=given,
        overrides={**({"problem": problem_name} if problem_name else {}), **overrides},
    )


def _checked_offload(
    source: Source, offload: OffloadSettings, recovery: RecoverySettings
) -> OffloadSettings:
    """Check what involves two values, and make paths absolute."""
    for index, service in enumerate(offload.services):
        first = offload.services.index(service)
        if first != index:
            raise source.error(
                ("offload", "services", index),
                f"is {shown(service)}, as offload.services[{first}] is already; each stands once,"
                " in order of preference",
            )
    deadline_ms, timeout_ms = offload.decision_deadline_ms, offload.decision_timeout_ms
    if deadline_ms is not None and recovery.launch == "never":
        raise source.error(
            ("offload", "decision_deadline_ms"),
            f"is {deadline_ms:g}; then the local service decides instead, which is never there"
            " with recovery.launch never; leave one of the two out",
        )
    if deadline_ms is not None and deadline_ms >= timeout_ms:
        raise source.error(
            ("offload", "decision_deadline_ms"),
            f"is {deadline_ms:g}; it must be below offload.decision_timeout_ms, after which a"
            f" decision is given up, which is {timeout_ms:g}",
        )
    if offload.detection_timeout_ms > timeout_ms:
        raise source.error(
            ("offload", "detection_timeout_ms"),
            f"is {offload.detection_timeout_ms:g}; it must be at most offload.decision_timeout_ms,"
            f" after which a decision is given up, which is {timeout_ms:g}",
        )
    services = tuple(absolute_endpoint(service, source.current) for service in offload.services)
    offload = msgspec.structs.replace(offload, services=services)
    if offload.tls is None:
        return offload
    directory = source.directory_of(("offload", "tls")) / offload.tls
    return msgspec.structs.replace(offload, tls=str(directory.resolve()))


def _located_environment(source: Source, settings: EnvironmentSettings) -> EnvironmentSettings:
    """Find the directory of the environment's module; what makes the environment imports it."""
    name = settings.object
    if name is None:
        return settings
    key = ("environment", "directory")
    module, colon, _ = name.partition(":")
    if not colon:
        if settings.directory is not None and (
            source.is_overridden(key) or not source.is_overridden(("environment", "object"))
        ):
            raise source.error(
                key,
                f"is {shown(settings.directory)}; only an environment that is named module:Class"
                " has one",
            )
        return msgspec.structs.replace(settings, directory=None)
    directory = module_directory(source, key, settings.directory, module)
    return msgspec.structs.replace(
        settings, directory=None if directory is None else str(directory)
    )
