"""``holdfast run``: the trials of a configuration, and what they leave in a directory."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from holdfast.cli.exit_codes import (
    EXIT_CAN_GO_ON,
    EXIT_ERROR,
    EXIT_REBOOTED,
    EXIT_WRONG_ANSWER,
    ended_by_signals,
    interrupted_by,
)
from holdfast.cli.overrides import Override, combined, parse_assignment
from holdfast.cli.run_figure import Remark, draw_figure
from holdfast.cli.terminal import RunDisplay, counted, print_files, print_summary
from holdfast.errors import HoldfastError, InvalidValueError, RunError, UnwritableOutputError
from holdfast.files import require_free, shown_path
from holdfast.printable import printable
from holdfast.recording.view_target import ViewTarget, require_rerun, viewer_url
from holdfast.runtime.command_line import (
    MAX_JOBS,
    MAX_SEED,
    MAX_TRIALS,
    Options,
    argument,
    bad_value,
    flag,
    location,
    number,
    option,
    whole_number,
)
from holdfast.runtime.log_lines import LogFormat
from holdfast.runtime.logs import log_option
from holdfast.service.options import http_address

if TYPE_CHECKING:
    from holdfast.cli.robot_run import RobotFindings
    from holdfast.config.loader import Configuration
    from holdfast.outcome import TrialResult
    from holdfast.recording.tables import RunSummary
    from holdfast.service.health import HttpAddress

__all__ = ["main"]

_RUNS = Path("runs")
_MIN_RATE_HZ = 0.001
_MAX_RATE_HZ = 10_000.0
_OF_SERVICES = ("recovery.launch", "offload.tls")
"""Keys without effect where no service is named."""

_OF_ENVIRONMENTS = ("environment.directory", "environment.arguments")
"""Keys without effect where no environment is named."""


class Viewer(NamedTuple):
    """The value of ``--view``, and the URL that it means; empty for a viewer of this machine."""

    given: str
    url: str

    def __str__(self) -> str:
        return self.given


def viewer(text: str) -> Viewer:
    """Read ``rerun`` or ``rerun=HOST:PORT``."""
    name, equals, place = text.partition("=")
    if name == "rerun":
        with contextlib.suppress(InvalidValueError):
            return Viewer(text, viewer_url(place) if equals else "")
    raise bad_value(text, "rerun, or rerun=HOST:PORT of a viewer that runs elsewhere")


class RunOptions(Options):
    """Run the trials of CONFIG and write their results into a directory.

    DIR gets trials.csv (a row for each trial), summary.json, config.yaml (with all defaults filled
    in; it can be run again), journal.sqlite (every decision of every trial) and trial.png (a figure
    of trial 0).

    With --service, --environment, --rate or --view the trials are run one after another, as a robot
    does: every step is in the journal before it is performed, and DIR gets events.jsonl (what
    happened to the services) and timings.csv (how long each decision took) as well.

    Ctrl-C or a crash loses no trial and no step: the same command with --resume goes on.
    """

    exit_codes: ClassVar = {3: None, 4: None, 5: None}
    needs_arguments = True

    configuration: Path = argument("CONFIG", "Configuration file (YAML) of the run.", location)
    trials: int | None = option(
        metavar="N",
        read=whole_number(1, MAX_TRIALS),
        key="simulator.num_trials",
        help="Number of trials, instead of the file's.",
    )
    seed: int | None = option(
        metavar="S",
        read=whole_number(0, MAX_SEED),
        key="simulator.seed",
        help="Seed of all random draws, instead of the file's.",
    )
    problem: str | None = option(
        metavar="NAME",
        help="Problem to run, instead of the file's: a registered name or module:Class.",
    )
    assignments: tuple[str, ...] = option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        many=True,
        help="A value instead of the file's, as YAML: selector.method=random.",
    )
    jobs: int | None = option(
        "-j",
        metavar="N",
        read=whole_number(1, MAX_JOBS),
        help="Largest number of processes (default: one for each core). Changes time only.",
    )
    out: Path | None = option(
        "-o",
        metavar="DIR",
        read=location,
        help="Directory for the results (default: runs/CONFIG-seedS, numbered if taken).",
    )
    resume: bool = flag(
        help="Go on with the run in DIR (default: the latest) and run the missing trials; with a "
        "larger --trials, more than it had.",
    )
    resume_if_begun: bool = flag(
        help="Go on with the run in DIR if it has begun, otherwise begin it; needs --out. For a "
        "unit or container that repeats one command.",
    )
    after_reboot: bool = flag(
        help="Let the robot go on although the machine was rebooted since it last moved; without "
        "this, a run that is resumed then ends with code 5.",
    )
    restart: bool = flag(
        help="Start the run again when its process dies or fails, but not after the codes 0, 3 and "
        "5 and a signal that ends it in order; needs --resume-if-begun. For a container, which the "
        "engine must not restart.",
    )
    quiet: bool = flag(
        "-q",
        help="Show no progress and no summary: only errors. The files are the same.",
    )
    service: tuple[str, ...] = option(
        "-s",
        metavar="ENDPOINT",
        many=True,
        key="offload.services",
        help="Let the service at ENDPOINT decide (tcp/10.0.0.7:7447); several are tried in this "
        "order.",
    )
    recovery: str | None = option(
        metavar="WHEN",
        key="recovery.launch",
        help="When to launch the local service: on_failure (the default), at_start or never.",
    )
    tls: Path | None = option(
        metavar="DIR",
        read=location,
        key="offload.tls",
        help="This robot's credentials, as holdfast keys makes them.",
    )
    environment: str | None = option(
        "-e",
        metavar="MODULE:CLASS",
        key="environment.object",
        help="Act on this environment instead of a simulated one.",
    )
    rate: float | None = option(
        metavar="HZ",
        read=number(_MIN_RATE_HZ, _MAX_RATE_HZ, "Hz"),
        help="Task actions a second (default: as fast as possible).",
    )
    health: HttpAddress | None = option(
        metavar="HOST:PORT",
        read=http_address,
        help="Answer http://HOST:PORT/livez, and /readyz while a service or the robot itself "
        "decides; a PORT alone is one of 127.0.0.1.",
    )
    metrics: HttpAddress | None = option(
        metavar="HOST:PORT",
        read=http_address,
        help="Offer this robot's metrics for Prometheus at http://HOST:PORT/metrics. The address "
        "may be that of --health.",
    )
    view: Viewer | None = option(
        metavar="rerun",
        read=viewer,
        help="Show the run in Rerun's viewer while it goes on (extra view); rerun=HOST:PORT is one "
        "that runs elsewhere.",
    )
    view_file: Path | None = option(
        metavar="FILE",
        read=location,
        help="Write what is shown to FILE (.rrd), with --view or without it.",
    )
    log: LogFormat = log_option("Format of the events shown: text or json.")

    def view_target(self) -> ViewTarget | None:
        """Return where to show the run while it goes on, if anywhere."""
        if self.view is None and self.view_file is None:
            return None
        file = None if self.view_file is None else str(self.view_file)
        return ViewTarget(None if self.view is None else self.view.url, file)

    def resume_command(self, directory: Path) -> str:
        """Return the command that goes on."""
        words = self.words(
            *("out", "resume", "resume_if_begun", "after_reboot", "restart", "quiet", "view_file")
        )
        out = self.table()["out"].words(directory)
        return shlex.join(["holdfast", "run", *words, *out, "--resume"])

    def overrides(self) -> list[Override]:
        """Return the values that replace those of the file."""
        given = []
        for name, each in self.table().items():
            value = getattr(self, name)
            if each.key is not None and value != each.default:
                plain = list(value) if each.many else value
                if isinstance(value, Path):
                    plain = shown_path(value)
                given.append(Override(" ".join(each.words(value)), each.key, plain))
        return [*map(parse_assignment, self.assignments), *given]

    def load(self) -> Configuration:
        """Read the configuration, with the values that replace those of the file."""
        from holdfast.config.loader import load

        path = shown_path(self.configuration)  # as messages name it
        return load(path, problem=self.problem, overrides=combined(self.overrides()))


def main(arguments: Sequence[str]) -> int:
    """Run the trials and return the exit code."""
    options = RunOptions.parse("run", arguments)
    if options.after_reboot and not (options.resume or options.resume_if_begun):
        raise InvalidValueError("--after-reboot needs --resume or --resume-if-begun")
    if options.restart:
        from holdfast.cli.restart import run_until_it_ends

        if not options.resume_if_begun:
            raise InvalidValueError("--restart needs --resume-if-begun, to go on with what it had")
        return run_until_it_ends(["run", *options.words("restart")])
    with ended_by_signals():
        return _run(options)


def _run(options: RunOptions) -> int:
    from holdfast.cli.robot_run import RobotFindings, is_robot_run, run_as_robot
    from holdfast.planning import Planner
    from holdfast.recording.belief_remarks import belief_remarks
    from holdfast.recording.recorder import Recorder
    from holdfast.recording.run_directory import (
        FIGURE_NAME,
        RunDirectory,
        claim_default_directory,
        latest_default_directory,
    )
    from holdfast.robot.environment import load_environment
    from holdfast.robot.trials import available_cores, run_trials
    from holdfast.runtime.service_manager import ServiceManager

    manager = ServiceManager()
    runs = _RUNS.absolute()  # before the user's code, which may change the current directory
    configuration = options.load()
    quiet = options.quiet
    as_robot = is_robot_run(options, configuration)
    _require_effect(options, configuration, as_robot=as_robot)
    # Before a directory is claimed: a module that cannot be imported leaves nothing behind.
    maker = load_environment(configuration) if as_robot else None
    if options.resume_if_begun:
        directory_path = _out_of_one_run(options)
        directory = RunDirectory.resume_if_begun(directory_path, configuration)
    elif options.resume:
        directory_path = options.out or latest_default_directory(configuration, runs)
        directory = RunDirectory.resume(directory_path, configuration)
    else:
        directory_path = options.out or claim_default_directory(configuration, runs)
        directory = RunDirectory.create(directory_path, configuration)
    with directory:
        notes = _Notes(options)
        display = RunDisplay(
            configuration, directory.journal.results(), quiet=quiet or options.log == "json"
        )
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
        started = perf_counter()

        def on_result(result: TrialResult) -> None:
            directory.add(result)
            display.show(result)

        try:
            display.start(directory_path)
            try:
                if maker is not None:
                    robot = run_as_robot(
                        options, configuration, directory, maker, on_result, manager, notes.note
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
                interrupted_by(interruption),
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
                raise RunError(error, command, EXIT_REBOOTED) from error
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
        with notes.instead_of_errors("remarks on the beliefs"):
            problem, record = configuration.problem, recorder.record
            for text in belief_remarks(problem, configuration.planning, record):
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
        return EXIT_WRONG_ANSWER
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
    if options.jobs is not None and as_robot:
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
        if given.key in _OF_SERVICES and given.value and not configuration.offload.services:
            raise InvalidValueError(
                f"{given.words} needs --service (or offload.services in "
                f"{shown_path(options.configuration)}): without a service it would do nothing"
            )
        if given.key in _OF_ENVIRONMENTS and given.value and not configuration.environment.object:
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
        self.on_terminal = not (self._quiet or self._as_json) and sys.stderr.isatty()

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
            sys.stderr.write(printable(f"\n{how}. {kept}\nGo on with: {command}\n"))

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
