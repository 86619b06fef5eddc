"""``holdfast run``: the trials of a configuration, and what they leave in a directory."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from holdfast.cli import exit_codes
from holdfast.cli.run_figure import Remark, draw_figure
from holdfast.cli.run_options import RunOptions
from holdfast.cli.terminal import (
    RecomputingDisplay,
    RunDisplay,
    counted,
    print_files,
    print_summary,
)
from holdfast.errors import HoldfastError, InvalidValueError, RunError, UnwritableOutputError
from holdfast.printable import printable
from holdfast.reports.view_target import require_rerun
from holdfast.runtime.files import require_free, shown_path

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.journal.run_directory import RunDirectory
    from holdfast.journal.tables import RunSummary
    from holdfast.planning.outcome import TrialResult
    from holdfast.robot.environment_maker import EnvironmentMaker
    from holdfast.runtime.events import EventSink
    from holdfast.runtime.service_manager import ServiceManager


_RUNS = Path("runs")
_NEED_A_SERVICE = ("recovery.launch", "offload.tls")
"""Keys without effect where no service is named."""

_ENVIRONMENT = "environment.object"
_MOST_FOR_A_DECISION_S = 90.0
_OF_ENVIRONMENTS = ("environment.directory", "environment.arguments")
"""Keys without effect where no environment is named."""


def main(arguments: Sequence[str]) -> int:
    """Run the trials and return the exit code."""
    options = RunOptions.parse("run", arguments)
    if options.after_reboot and not (options.resume or options.resume_if_begun):
        raise InvalidValueError("--after-reboot needs --resume or --resume-if-begun")
    if options.restart:
        from holdfast.cli.restart import run_until_it_ends

        if not options.resume_if_begun:
            raise InvalidValueError("--restart needs --resume-if-begun, to go on with what it had")
        from holdfast.runtime.watchdog import DEFAULT_WATCHDOG_S

        options.watchdog_s = options.watchdog_s or DEFAULT_WATCHDOG_S
        return run_until_it_ends(["run", *options.words("restart")])
    goes_on = options.resume or options.resume_if_begun
    with exit_codes.ended_by_signals(), exit_codes.goes_on(options if goes_on else None, "run"):
        return _run(options)


def _run(options: RunOptions) -> int:
    from holdfast.journal.run_directory import (
        FIGURE_NAME,
        RunDirectory,
        claim_default_directory,
        latest_default_directory,
    )
    from holdfast.planning.planner import Planner
    from holdfast.reports.belief_remarks import belief_remarks
    from holdfast.reports.recorder import Recorder
    from holdfast.robot.environment_maker import load_environment
    from holdfast.robot.lost_values import REMEDY, remark_on_lost_values
    from holdfast.robot.recomputing import resume_run, resume_run_if_begun
    from holdfast.robot.trials import run_trials
    from holdfast.runtime.machine import available_cores
    from holdfast.runtime.service_manager import ServiceManager

    manager = ServiceManager(options.watchdog_s)
    runs = _RUNS.absolute()  # before the user's code, which may change the current directory
    configuration = options.load()
    quiet = options.quiet
    as_robot = is_robot_run(options, configuration)
    _require_effect(options, configuration, as_robot=as_robot)
    # Before a directory is claimed: a module that cannot be imported leaves nothing behind.
    named_by = next((each for each in options.overrides() if each.key == _ENVIRONMENT), None)
    maker = (
        load_environment(configuration, None if named_by is None else named_by.option)
        if as_robot
        else None
    )
    notes = _Notes(options)
    if options.resume_if_begun or options.resume:
        if options.resume_if_begun:
            directory_path, open_run = _out_of_one_run(options), resume_run_if_begun
        else:
            directory_path = options.out or latest_default_directory(configuration, runs)
            open_run = resume_run
        with contextlib.closing(RecomputingDisplay(quiet=notes.is_quiet)) as recomputing:

            def on_progress(done: int, total: int) -> None:
                recomputing.show(done, total)
                manager.starting(within_s=_MOST_FOR_A_DECISION_S)

            directory = open_run(directory_path, configuration, on_progress)
    else:
        directory_path = options.out or claim_default_directory(configuration, runs)
        directory = RunDirectory.create(directory_path, configuration)
    with directory:
        if directory.before_upgrade is not None:
            notes.note(directory.before_upgrade.in_words())
        display = RunDisplay(configuration, directory.journal.results(), quiet=notes.is_quiet)
        if options.resume_if_begun and (complete := directory.complete_summary()) is not None:
            manager.ready()  # otherwise it takes the end for a failed start
            manager.close()
            notes.note(f"{directory_path}: complete, with {counted(complete.trials, 'trial')}")
            return _exit_code(complete)
        before, now = directory.services_before, configuration.offload.services
        if before is not None and before != now:
            notes.note(f"the run had {_listed(before)} before, and goes on with {_listed(now)}")
        recorder = Recorder(0, Planner(configuration.problem, configuration.planning))
        robot = RobotFindings()
        summary: RunSummary | None = None
        lost: list[tuple[str, ...]] = []
        reached: list[bool] = []
        which = "trials of this part" if directory.journal.finished() else "trials"
        started = perf_counter()

        def on_result(result: TrialResult) -> None:
            directory.add(result)
            reached.append(result.success)
            display.show(result)

        try:
            display.start(directory_path)
            try:
                if maker is not None:
                    robot = _run_as_robot(
                        options, configuration, directory, maker, on_result, manager, notes.note
                    )
                else:
                    manager.ready()
                    manager.close()
                    lost = run_trials(
                        configuration,
                        options.jobs or available_cores(),
                        directory.journal.finished(),
                        on_result,
                        recorder,
                    )
            except BaseException:
                # After SIGHUP there is no terminal to write to.
                with contextlib.suppress(OSError):
                    display.stop()
                # Tables of the finished trials. If the disk fails, the first error says so.
                with contextlib.suppress(HoldfastError):
                    summary = directory.write_tables(perf_counter() - started)
                raise
            display.stop()
            summary = directory.write_tables(perf_counter() - started)
            remark: Remark | None = None
            with notes.instead_of_errors("summary"):
                if not quiet:
                    print_summary(summary)
            with notes.instead_of_errors("notes"):
                if robot.missed_ticks:
                    were = "was" if robot.missed_ticks == 1 else "were"
                    notes.note(f"{counted(robot.missed_ticks, 'tick')} of --rate {were} missed")
                for service, reason in robot.refusals.items():
                    notes.note(f"{service} was asked no more: {reason}")
                _note_idle_services(configuration, summary, robot, notes)
            with notes.while_it_lasts(f"drawing {FIGURE_NAME} ..."):
                remark = draw_figure(configuration, directory, recorder)
        except KeyboardInterrupt as interruption:
            notes.ended_early(
                exit_codes.interrupted_by(interruption),
                f"{len(directory.journal.finished())} of {configuration.simulator.num_trials} "
                f"trials are finished and kept in {shown_path(directory_path)}",
                options.resume_command(directory_path),
            )
            raise
        except HoldfastError as error:
            from holdfast.errors import (
                LostJournalError,
                RebootedError,
                StaleEpochError,
                UnknownPerformanceError,
            )

            if isinstance(error, RebootedError):
                command = f"{options.resume_command(directory_path)} --after-reboot"
                raise RunError(error, command, exit_codes.EXIT_REBOOTED) from error
            cannot_go_on = (
                isinstance(error, UnknownPerformanceError | LostJournalError)
                or directory.journal.is_empty()
            )
            resume = None if cannot_go_on else options.resume_command(directory_path)
            # Of two processes of one run each would end the other, were both started again.
            again = resume is not None and not isinstance(error, StaleEpochError)
            exit_code = _exit_code(summary) or (
                exit_codes.EXIT_CAN_GO_ON if again else exit_codes.EXIT_ERROR
            )
            raise RunError(error, resume, exit_code) from error
        if not quiet:
            print_files(directory_path)
        if remark is not None:
            notes.note(remark.text)
        with notes.instead_of_errors("remarks on the beliefs"):
            problem, record = configuration.problem, recorder.record
            if told := remark_on_lost_values(lost, reached, which):
                notes.note(f"{told}. {REMEDY}")
            planning, is_told = configuration.planning, bool(told) or len(lost) > 1
            for text in belief_remarks(problem, planning, record, lost_are_told=is_told):
                notes.note(f"in trial {recorder.trial}, {text}")
        if summary.unverified_answers:
            notes.note(
                f"{summary.unverified_answers} questions that were drawn to be answered by the "
                "robot's own planner, too, were not: it failed, was too slow, or a part of the run "
                "ended before; events.jsonl and verification.csv say more"
            )
        if summary.wrong_answers:
            notes.note(
                "services answered otherwise than the robot's own planner; events.jsonl and "
                "verification.csv say where"
            )
        elif summary.not_deterministic:
            notes.note(
                "the robot's own planner came to two decisions in one state, so the problem is not "
                "deterministic; events.jsonl says where"
            )
        return _exit_code(summary) or (remark.exit_code if remark is not None else 0)


class RobotFindings:
    """An event sink, for what a robot's run finds besides its results."""

    def __init__(self, on_first_hold: Callable[[], None] = lambda: None) -> None:
        self._on_hold: Callable[[], None] | None = on_first_hold
        self.missed_ticks = 0  # ticks of --rate that came late
        # Why a service was given up, and could not be reached the last time, by its name.
        self.refusals: dict[str, str] = {}
        self.unreachable: dict[str, str] = {}

    def event(self, name: str, /, **fields: object) -> None:
        """Take an event."""
        if name == "refused" and fields["final"]:
            self.refusals[str(fields["service"])] = f"{fields['code']}: {fields['reason']}"
        elif name == "unreachable":
            self.unreachable[str(fields["service"])] = str(fields["reason"])
        elif name == "holding" and self._on_hold is not None:
            self._on_hold()
            self._on_hold = None

    def close(self) -> None:
        """Do nothing."""


def is_robot_run(options: RunOptions, configuration: Configuration) -> bool:
    """Return whether a run needs more than a batch of simulated trials does."""
    return (
        bool(configuration.offload.services)
        or configuration.environment.object is not None
        or options.rate is not None
        or options.view_target() is not None
    )


def _run_as_robot(
    options: RunOptions,
    configuration: Configuration,
    directory: RunDirectory,
    maker: EnvironmentMaker,
    on_result: Callable[[TrialResult], None],
    manager: ServiceManager,
    note: Callable[[str], None],
) -> RobotFindings:
    """Run the missing trials one after another, step by step, with services that may die."""
    from holdfast.robot.health import RobotWatch
    from holdfast.robot.robot_run import perform_trials
    from holdfast.runtime.logs import EventLog

    def hint() -> None:
        if configuration.recovery.launch == "never":
            note(
                "the robot goes on when a service answers; with --recovery on_failure "
                "(recovery.launch) it launches a local service that decides meanwhile"
            )

    view = None
    if (target := options.view_target()) is not None:
        from holdfast.reports.live_view import LiveView

        view = LiveView(configuration, target, directory.path, note)
    findings = RobotFindings(hint)
    sinks: list[EventSink] = [findings]
    if not options.quiet:
        sinks.insert(0, EventLog(sys.stderr, format=options.log, component="robot"))
    findings.missed_ticks = perform_trials(
        configuration,
        directory,
        maker,
        on_result,
        rate_hz=options.rate,
        sinks=sinks,
        after_reboot=options.after_reboot,
        watch=lambda events: RobotWatch(manager, options.health, options.metrics, events),
        view=view,
    )
    return findings


def _out_of_one_run(options: RunOptions) -> Path:
    """Return the directory of ``--resume-if-begun``."""
    if options.resume:
        raise InvalidValueError(
            "--resume and --resume-if-begun: the second one begins a run that is not there, the "
            "first one does not; leave one of them out"
        )
    if options.out is None:
        raise InvalidValueError("--resume-if-begun needs --out DIR, the directory of this one run")
    return options.out


def _exit_code(summary: RunSummary | None) -> int:
    """Return the exit code of a run that came to its end."""
    if summary is not None and (summary.wrong_answers or summary.not_deterministic):
        return exit_codes.EXIT_WRONG_ANSWER
    return 0


def _listed(services: Sequence[str]) -> str:
    words = " ".join(f"--service {service}" for service in services)
    return words or "no service"


def _note_idle_services(
    configuration: Configuration, summary: RunSummary, robot: RobotFindings, notes: _Notes
) -> None:
    """Name the services that decided nothing without a refusal: perhaps mistyped."""
    sensing = summary.sensing_decisions_by_service
    task = summary.task_answers_by_service
    if sensing is None or task is None or not summary.finished:
        return
    for service in configuration.offload.services:
        if service not in {*sensing, *task, *robot.refusals}:
            reason = robot.unreachable.get(service)
            why = "; events.jsonl says why" if reason is None else f": {reason}"
            notes.note(f"{service} decided nothing{why}")


def _require_effect(options: RunOptions, configuration: Configuration, *, as_robot: bool) -> None:
    """Refuse options that would have no effect."""
    if options.jobs not in (None, 1) and as_robot:
        raise InvalidValueError(
            f"--jobs is {options.jobs}, but a robot runs its trials one after another: leave it "
            "out, or leave out --service, --environment, --rate and --view (and offload.services "
            "and environment.object)"
        )
    for name, address in (("--health", options.health), ("--metrics", options.metrics)):
        if address is not None and not as_robot:
            raise InvalidValueError(
                f"{name} {address} is for a robot: give --service, --environment or --rate "
                "(or offload.services or environment.object), without which the trials are a batch"
            )
    if configuration.offload.services:
        from holdfast.robot.links import check_services

        # Before a directory is claimed: a mistyped one claims none.
        on_command_line = any(given.key == "offload.services" for given in options.overrides())
        check_services(
            configuration, None if on_command_line else f"{shown_path(options.configuration)}: "
        )
    for given in options.overrides():
        if given.key in _NEED_A_SERVICE and given.value and not configuration.offload.services:
            raise InvalidValueError(
                f"{given.words} needs --service (or offload.services in "
                f"{shown_path(options.configuration)}): without a service it would do nothing"
            )
        if (
            given.key.startswith(_OF_ENVIRONMENTS)
            and given.value
            and not configuration.environment.object
        ):
            raise InvalidValueError(
                f"{given.words} needs --environment (or environment.object in "
                f"{shown_path(options.configuration)}): without an environment it would do nothing"
            )
    target = options.view_target()
    if target is not None:
        require_rerun(target)
        if options.view_file is not None:
            require_free(options.view_file, "--view-file", directory=False)
    if options.log == "json" and not as_robot:
        raise InvalidValueError(
            "--log json needs --service, --environment or --rate (or offload.services or "
            f"environment.object in {shown_path(options.configuration)}): without them there are "
            "no events"
        )


class _Notes:
    """Messages of a run besides its progress: as text, or as an event among events."""

    def __init__(self, options: RunOptions) -> None:
        self._as_json = options.log == "json"
        self._quiet = options.quiet
        self.is_quiet = self._quiet or self._as_json
        self.on_terminal = not self.is_quiet and sys.stderr.isatty()

    def note(self, text: str) -> None:
        """Print a note, unless the run is quiet."""
        if self._quiet:
            return
        if self._as_json:
            self._event("note", reason=text)
        else:
            sys.stderr.write(f"note: {printable(text)}\n")

    @contextlib.contextmanager
    def instead_of_errors(self, what: str) -> Iterator[None]:
        """Note that something fails which a finished run can do without."""
        try:
            yield
        except UnwritableOutputError:
            raise
        except Exception as error:  # noqa: BLE001
            from holdfast.config.user_code import in_words

            self.note(f"no {what}, because of {in_words(error)}")

    def ended_early(self, how: str, kept: str, command: str) -> None:
        """Print how a run was interrupted, what is kept, and how to go on."""
        if self._as_json:
            self._event("interrupted", reason=f"{how}. {kept}", resume_command=command)
        else:
            exit_codes.say_interrupted(how, kept, command)

    @contextlib.contextmanager
    def while_it_lasts(self, text: str) -> Iterator[None]:
        """Show a text on a terminal until the block is done."""
        if not self.on_terminal:
            yield
            return
        sys.stderr.write(text)
        sys.stderr.flush()
        try:
            yield
        finally:
            sys.stderr.write(f"\r{' ' * len(text)}\r")
            sys.stderr.flush()

    @staticmethod
    def _event(name: str, **fields: object) -> None:
        from holdfast.runtime.logs import write_event

        write_event("robot", name, **fields)
