"""``holdfast run``: the trials of a configuration, and what they leave in a directory."""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from holdfast.cli.endings import (
    EXIT_CAN_GO_ON,
    EXIT_ERROR,
    EXIT_WRONG_ANSWER,
    RunError,
    ended_by_signals,
    signal_of,
)
from holdfast.cli.options import (
    MAX_SEED,
    MAX_TRIALS,
    http_address,
    location,
    number,
    whole_number,
)
from holdfast.cli.overrides import Override, combined, parse_assignment
from holdfast.cli.terminal import counted, duration, print_files, print_summary, run_display
from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.printable import printable
from holdfast.runtime.command_line import MAX_JOBS

if TYPE_CHECKING:
    from holdfast.cli.robot_run import RobotRun
    from holdfast.configuration import Configuration
    from holdfast.outcome import TrialResult
    from holdfast.recording.recorder import RecordedEnvironment, Recorder, TrialRecord
    from holdfast.recording.repetition import Repetition
    from holdfast.recording.run_directory import RunDirectory
    from holdfast.recording.tables import RunSummary
    from holdfast.service.health import HttpAddress

__all__ = ["run"]

_RUNS = Path("runs")
_MIN_RATE_HZ = 0.001
_MAX_RATE_HZ = 10_000.0
_OF_SERVICES = ("recovery.launch", "offload.tls")
"""Keys without effect where no service is named."""

_OF_ENVIRONMENTS = ("environment.directory", "environment.arguments")
"""Keys without effect where no environment is named."""

_LONGEST_REPETITION_S = 30.0
"""A trial that took longer is not run again for its figure."""


def run(
    configuration_path: Annotated[
        Path,
        typer.Argument(
            metavar="CONFIG",
            parser=location("CONFIG"),
            show_default=False,
            help="Configuration file (YAML) of the run.",
        ),
    ],
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials",
            metavar="N",
            parser=whole_number("--trials", 1, MAX_TRIALS),
            help="Number of trials, instead of the file's.",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed",
            metavar="S",
            parser=whole_number("--seed", 0, MAX_SEED),
            help="Seed of all random draws, instead of the file's.",
        ),
    ] = None,
    problem: Annotated[
        str | None,
        typer.Option(
            "--problem",
            metavar="NAME",
            help="Problem to run, instead of the file's: a registered name or module:Class.",
        ),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="SECTION.KEY=VALUE",
            help="A value instead of the file's, as YAML: selector.method=random. May be repeated.",
            show_default=False,
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            "-j",
            metavar="N",
            parser=whole_number("--jobs", 1, MAX_JOBS),
            help=(
                "Largest number of processes (default: one for each core). It changes time only, "
                "never a result."
            ),
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            parser=location("--out"),
            help="Directory for the results (default: runs/CONFIG-seedS, numbered if taken).",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help=(
                "Go on with the run in DIR (default: the latest) and run the missing trials; with "
                "a larger --trials, more than it had."
            ),
        ),
    ] = False,
    resume_if_begun: Annotated[
        bool,
        typer.Option(
            "--resume-if-begun",
            help=(
                "Go on with the run in DIR if it has begun, else begin it; needs --out. For what "
                "repeats one command: a unit, a container."
            ),
        ),
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet",
            "-q",
            help="Show no progress and no summary: only errors. The files are the same.",
        ),
    ] = False,
    service: Annotated[
        list[str] | None,
        typer.Option(
            "--service",
            "-s",
            metavar="ENDPOINT",
            help=(
                "Let the service at ENDPOINT decide (tcp/10.0.0.7:7447); more of them are tried in "
                "this order."
            ),
            show_default=False,
        ),
    ] = None,
    recovery: Annotated[
        str | None,
        typer.Option(
            "--recovery",
            metavar="WHEN",
            help=("When to launch the local service: on_failure (the default), at_start or never."),
            show_default=False,
        ),
    ] = None,
    tls: Annotated[
        Path | None,
        typer.Option(
            "--tls",
            metavar="DIR",
            parser=location("--tls"),
            help="This robot's credentials, as holdfast keys makes them.",
            show_default=False,
        ),
    ] = None,
    environment: Annotated[
        str | None,
        typer.Option(
            "--environment",
            "-e",
            metavar="MODULE:CLASS",
            help="Act on this environment instead of a simulated one.",
            show_default=False,
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            parser=number("--rate", _MIN_RATE_HZ, _MAX_RATE_HZ, "Hz"),
            help="Task actions a second (default: as fast as it goes).",
            show_default=False,
        ),
    ] = None,
    health: Annotated[
        Any,  # typer would look for HttpAddress
        typer.Option(
            "--health",
            metavar="HOST:PORT",
            parser=http_address("--health"),
            help=(
                "Answer http://HOST:PORT/livez, and /readyz while somebody decides for the robot; "
                "a PORT alone is one of 127.0.0.1."
            ),
            show_default=False,
        ),
    ] = None,
    log: Annotated[
        str,
        typer.Option("--log", metavar="FORMAT", help="Format of the events shown: text or json."),
    ] = "text",
) -> None:
    """Run the trials of CONFIG and write what they come to into a directory.

    DIR gets trials.csv (a row for each trial), summary.json, config.yaml
    (with all defaults filled in; it can be run again), journal.sqlite (every
    decision of every trial) and trial.png (a figure of trial 0).

    With --service, --environment or --rate the trials are run one after
    another, as a robot does: every step is in the journal before it is
    performed, and DIR gets events.jsonl (what happened to the services) and
    timings.csv (how long each decision took) as well.

    Ctrl-C or a crash loses no trial and no step: the same command with
    --resume goes on.
    """
    if log not in ("text", "json"):
        raise InvalidValueError(f"--log is {log!r}; allowed are text and json")
    options = _Options(
        configuration_path=configuration_path,
        trials=trials,
        seed=seed,
        problem=problem,
        assignments=tuple(assignments or ()),
        jobs=jobs,
        out=out,
        resume=resume,
        resume_if_begun=resume_if_begun,
        quiet=quiet,
        services=tuple(service or ()),
        recovery=recovery,
        tls=tls,
        environment=environment,
        rate=rate,
        health=health,
        log=log,
    )
    with ended_by_signals():
        _run(options)


@dataclass(frozen=True)
class _Options:
    """The command line, as it was given."""

    configuration_path: Path
    trials: int | None
    seed: int | None
    problem: str | None
    assignments: tuple[str, ...]
    jobs: int | None
    out: Path | None
    resume: bool
    resume_if_begun: bool
    quiet: bool
    services: tuple[str, ...]
    recovery: str | None
    tls: Path | None
    environment: str | None
    rate: float | None
    health: HttpAddress | None
    log: str

    def resume_command(self, directory: Path) -> str:
        """Return the command that goes on."""
        words = ["holdfast", "run", str(self.configuration_path)]
        options: list[tuple[str, object]] = [
            ("--trials", self.trials),
            ("--seed", self.seed),
            ("--problem", self.problem),
            *(("--set", assignment) for assignment in self.assignments),
            ("--jobs", self.jobs),
            *(("--service", service) for service in self.services),
            ("--recovery", self.recovery),
            ("--tls", self.tls),
            ("--environment", self.environment),
            ("--rate", self.rate),
            ("--health", self.health),
        ]
        for option, value in options:
            if value is not None:
                words += [option, str(value)]
        if self.log != "text":
            words += ["--log", self.log]
        return shlex.join([*words, "--out", str(directory), "--resume"])

    def overrides(self) -> list[Override]:
        """Return what was given instead of values of the file."""
        options = [
            ("--trials", "simulator.num_trials", self.trials),
            ("--seed", "simulator.seed", self.seed),
            ("--recovery", "recovery.launch", self.recovery),
            ("--tls", "offload.tls", None if self.tls is None else str(self.tls)),
            ("--environment", "environment.object", self.environment),
        ]
        given = [
            Override(f"{name} {value}", key, value)
            for name, key, value in options
            if value is not None
        ]
        if self.services:
            words = " ".join(f"--service {service}" for service in self.services)
            given.append(Override(words, "offload.services", list(self.services)))
        return [*map(parse_assignment, self.assignments), *given]

    def load(self) -> Configuration:
        """Read the configuration, with what was said instead."""
        from holdfast.configuration import load

        return load(
            self.configuration_path, problem=self.problem, overrides=combined(self.overrides())
        )


def _run(options: _Options) -> None:
    from holdfast.cli.robot_run import RobotRun, is_robot_run, run_as_robot
    from holdfast.recording.recorder import RecordedEnvironment, Recorder
    from holdfast.recording.run_directory import (
        FIGURE_NAME,
        RunDirectory,
        claim_default_directory,
        latest_default_directory,
    )
    from holdfast.runtime.environment import load_environment
    from holdfast.runtime.service_manager import ServiceManager
    from holdfast.runtime.trials import available_cores, run_trials

    manager = ServiceManager()
    configuration = options.load()
    quiet = options.quiet
    as_robot = is_robot_run(configuration, options.rate)
    _require_effect(options, configuration, as_robot=as_robot)
    # Before a directory is claimed, too: what cannot be imported shall leave nothing behind.
    maker = load_environment(configuration) if as_robot else None
    if options.resume_if_begun:
        directory_path = _out_of_one_run(options)
        directory = RunDirectory.resume_if_begun(directory_path, configuration)
    elif options.resume:
        directory_path = options.out or latest_default_directory(configuration, _RUNS)
        directory = RunDirectory.resume(directory_path, configuration)
    else:
        directory_path = options.out or claim_default_directory(configuration, _RUNS)
        directory = RunDirectory.create(directory_path, configuration)
    with directory:
        earlier = directory.journal.tally()
        notes = _Notes(options)
        if options.resume_if_begun and (told := directory.told_summary()) is not None:
            manager.ready()  # else it would take the end for a failed start
            manager.close()
            notes.note(f"{directory_path}: complete, with {counted(told.trials, 'trial')}")
            raise SystemExit(_exit_code(told))
        before, now = directory.services_before, configuration.offload.services
        if before is not None and before != now:
            notes.note(f"the run had {_listed(before)} before, and goes on with {_listed(now)}")
        display = run_display(configuration, quiet=quiet or options.log == "json")
        recorder = Recorder(trial=0)
        recorded: RecordedEnvironment | None = None
        robot = RobotRun()
        summary: RunSummary | None = None
        started = perf_counter()

        def on_result(result: TrialResult) -> None:
            nonlocal recorded
            if result.trial == recorder.trial and configuration.environment.object is not None:
                # Its steps are in the journal until the result is.
                unfinished = directory.journal.unfinished()
                records = [] if unfinished is None else unfinished.records
                recorded = RecordedEnvironment(records, result)
            directory.add(result)
            display.show(result)

        try:
            display.start(earlier, directory_path)
            try:
                if maker is not None:
                    robot = run_as_robot(
                        configuration,
                        directory,
                        maker,
                        on_result,
                        rate_hz=options.rate,
                        log_format="json" if options.log == "json" else "text",
                        quiet=quiet,
                        manager=manager,
                        health=options.health,
                    )
                else:
                    manager.ready()
                    manager.close()
                    run_trials(
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
                # Tables of what is finished; if the disk is the trouble, the first error says so.
                with contextlib.suppress(HoldfastError):
                    summary = directory.write_tables(perf_counter() - started)
                raise
            display.stop()
            summary = directory.write_tables(perf_counter() - started)
            if not quiet:
                print_summary(summary)
            if robot.missed_ticks:
                were = "was" if robot.missed_ticks == 1 else "were"
                notes.note(f"{counted(robot.missed_ticks, 'tick')} of --rate {were} missed")
            for service, reason in robot.refusals.items():
                notes.note(f"{service} was asked no more: {reason}")
            for text in _idle_services(configuration, summary, robot):
                notes.note(text)
            with notes.while_it_lasts(f"drawing {FIGURE_NAME} ..."):
                remark = _draw_figure(configuration, directory, recorder, recorded)
        except KeyboardInterrupt as interruption:
            command = options.resume_command(directory_path)
            finished = directory.journal.tally().finished
            ended = signal_of(interruption)
            how = "Interrupted" if ended == signal.SIGINT else f"Ended by {ended.name}"
            notes.ended_early(
                how,
                f"{finished} of {configuration.simulator.num_trials} trials are finished and kept "
                f"in {directory_path}",
                command,
            )
            raise
        except HoldfastError as error:
            from holdfast.recording.journal import LostJournalError
            from holdfast.session.replies import StaleEpochError
            from holdfast.session.robot import UnknownPerformanceError

            cannot_go_on = (
                isinstance(error, UnknownPerformanceError | LostJournalError)
                or directory.journal.unfinished_trial() is None
            )
            resume = None if cannot_go_on else options.resume_command(directory_path)
            # Of two processes of one run each would end the other, were both started again.
            again = resume is not None and not isinstance(error, StaleEpochError)
            exit_code = _exit_code(summary) or (EXIT_CAN_GO_ON if again else EXIT_ERROR)
            raise RunError(error, resume, exit_code) from error
        if not quiet:
            print_files(directory_path)
        if remark is not None:
            notes.note(remark.text)
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
        exit_code = _exit_code(summary) or (remark.exit_code if remark is not None else 0)
        if exit_code:
            raise SystemExit(exit_code)


def _out_of_one_run(options: _Options) -> Path:
    """Return the directory of a run of which the command does not say whether it has begun."""
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
        return EXIT_WRONG_ANSWER
    return 0


def _listed(services: Sequence[str]) -> str:
    words = " ".join(f"--service {service}" for service in services)
    return words or "no service"


def _idle_services(configuration: Configuration, summary: RunSummary, robot: RobotRun) -> list[str]:
    """Say which of the services named decided nothing without a refusal: perhaps mistyped."""
    sensing = summary.sensing_decisions_by_service
    task = summary.task_answers_by_service
    if sensing is None or task is None or not summary.finished:
        return []
    return [
        f"{service} decided nothing"
        + (
            f": {robot.unreachable[service]}"
            if service in robot.unreachable
            else "; events.jsonl says why"
        )
        for service in configuration.offload.services
        if service not in sensing and service not in task and service not in robot.refusals
    ]


def _require_effect(options: _Options, configuration: Configuration, *, as_robot: bool) -> None:
    """Refuse options that would do nothing, rather than let somebody believe that they do."""
    if options.jobs is not None and as_robot:
        raise InvalidValueError(
            f"--jobs is {options.jobs}, but a robot runs its trials one after another: leave it "
            "out, or leave out --service, --environment and --rate (and offload.services and "
            "environment.object)"
        )
    if options.health is not None and not as_robot:
        raise InvalidValueError(
            f"--health {options.health} is for a robot: give --service, --environment or --rate "
            "(or offload.services or environment.object), without which the trials are a batch"
        )
    if configuration.offload.services:
        from holdfast.runtime.links import check_services

        # Before a directory is claimed: a mistyped one claims none.
        on_command_line = any(given.key == "offload.services" for given in options.overrides())
        check_services(
            configuration, None if on_command_line else f"{options.configuration_path}: "
        )
    for given in options.overrides():
        if given.key in _OF_SERVICES and given.value and not configuration.offload.services:
            raise InvalidValueError(
                f"{given.words} needs --service (or offload.services in "
                f"{options.configuration_path}): without a service it would do nothing"
            )
        if given.key in _OF_ENVIRONMENTS and given.value and not configuration.environment.object:
            raise InvalidValueError(
                f"{given.words} needs --environment (or environment.object in "
                f"{options.configuration_path}): without an environment it would do nothing"
            )
    if options.log == "json" and not as_robot:
        raise InvalidValueError(
            "--log json needs --service, --environment or --rate (or offload.services or "
            f"environment.object in {options.configuration_path}): without them there are no events"
        )


class _Notes:
    """What a run has to say besides its progress: as text, or as an event among events.

    Parameters
    ----------
    options : _Options
    """

    def __init__(self, options: _Options) -> None:
        self._as_json = options.log == "json"
        self._quiet = options.quiet
        self.on_terminal = not (self._quiet or self._as_json) and sys.stderr.isatty()

    def note(self, text: str) -> None:
        """Say something that is good to know; nothing if the run is to be quiet."""
        if self._quiet:
            return
        if self._as_json:
            self._event("note", reason=text)
        else:
            sys.stderr.write(f"note: {printable(text)}\n")

    def ended_early(self, how: str, kept: str, command: str) -> None:
        """Say how a run ended before its end, what is kept, and how to go on."""
        if self._as_json:
            self._event("interrupted", reason=f"{how}. {kept}", resume_command=command)
        else:
            sys.stderr.write(printable(f"\n{how}. {kept}\nGo on with: {command}\n"))

    @contextlib.contextmanager
    def while_it_lasts(self, text: str) -> Iterator[None]:
        """Show on a terminal what is being done, until it is done."""
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
        from holdfast.runtime.logs import tell_event

        tell_event("robot", name, **fields)


class _Remark(NamedTuple):
    """What is to be said about the figure, and the exit code if that was not in order."""

    text: str
    exit_code: int = 0


def _draw_figure(
    configuration: Configuration,
    directory: RunDirectory,
    recorder: Recorder,
    recorded: RecordedEnvironment | None,
) -> _Remark | None:
    """Draw trial 0 and return None, or what is to be said about it."""
    from holdfast.recording.run_directory import FIGURE_NAME

    if configuration.environment.object is not None and recorded is None:
        if (directory.path / FIGURE_NAME).exists():
            return None
        recorded = _world_of(directory, recorder.trial)
        if recorded is None:
            return _Remark(
                f"no figure, because trial {recorder.trial} ended in an earlier part of the run, "
                "which did not keep its observations"
            )
    if recorder.record.result is None:
        again_s = _time_of_sensing(directory, recorder.trial)
        if again_s > _LONGEST_REPETITION_S:
            return _Remark(
                f"no figure, because trial {recorder.trial} would have to be run again for it, "
                f"with {duration(again_s)} of sensing decisions"
            )
    try:
        from holdfast.recording.figure import trial_figure
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] != "matplotlib":
            raise
        return _Remark("no figure, because matplotlib is not installed: pip install matplotlib")

    try:
        return _draw_trial(configuration, directory, recorder, recorded, trial_figure)
    except (HoldfastError, KeyboardInterrupt):
        raise
    except BaseException as error:
        from holdfast.user_code import account_of_user_error

        account = account_of_user_error(error, configuration.problem_name)
        if account is None:
            raise
        raise HoldfastError(f"the figure of trial {recorder.trial}: {account}") from error


def _world_of(directory: RunDirectory, trial: int) -> RecordedEnvironment | None:
    from holdfast.recording.recorder import RecordedEnvironment

    records = directory.journal.kept_steps(trial)
    if records is None:
        return None
    result = next(each for each in directory.journal.results() if each.trial == trial)
    return RecordedEnvironment(records, result)


def _time_of_sensing(directory: RunDirectory, trial: int) -> float:
    for result in directory.journal.results():
        if result.trial == trial:
            return 1e-3 * result.mean_sensing_ms * result.sensing_decisions
    return 0.0


def _draw_trial(
    configuration: Configuration,
    directory: RunDirectory,
    recorder: Recorder,
    recorded: RecordedEnvironment | None,
    draw: Callable[[Configuration, TrialRecord, Path], None],
) -> _Remark | None:
    from holdfast.recording.repetition import repeat
    from holdfast.recording.run_directory import FIGURE_NAME

    trial = recorder.trial
    remark = None
    if recorder.record.result is None:
        # It ran in a worker, in an earlier part of the run, or as a robot's: it is run again. A
        # world of the user's answers what it has answered.
        kept = directory.journal.decisions(trial)
        found = repeat(configuration, kept, trial, recorded, observer=recorder)
        if found.deviation is not None:
            remark = _remark_on(found, configuration, directory, trial, recorded)
        if found.error is not None:
            return remark
    record: TrialRecord = recorder.record
    if recorded is not None:
        record.result = recorded.result  # the reward of its last step is there alone
    draw(configuration, record, directory.path / FIGURE_NAME)
    return remark


def _remark_on(
    found: Repetition,
    configuration: Configuration,
    directory: RunDirectory,
    trial: int,
    recorded: RecordedEnvironment | None,
) -> _Remark:
    """Say who was wrong if a trial was decided otherwise when it was run again."""
    from holdfast.recording.repetition import repeat, wrong_service
    from holdfast.recording.run_directory import TIMINGS_NAME

    def again() -> Repetition:
        world = None if recorded is None else recorded.from_the_beginning()
        kept = directory.journal.decisions(trial)
        return repeat(configuration, kept, trial, world, anew=True)

    assert found.deviation is not None
    step, kind = found.deviation
    service = wrong_service(found, again, directory.path / TIMINGS_NAME, trial)
    missing = "the figure: " if found.error is None else "no figure, because "
    if service is not None:
        return _Remark(
            f"{missing}trial {trial} was run again for it by the robot's own planner, twice, and "
            f"came to other decisions, both times to the same: {service} answered with another "
            f"{kind} action at step {step}",
            EXIT_WRONG_ANSWER,
        )
    if found.error is not None:
        return _Remark(f"no figure, because {found.error}")
    return _Remark(
        f"trial {trial} decided otherwise when it was run again for the figure, "
        f"so the problem {configuration.problem_name} is not deterministic"
    )
