"""The directory of a run: what is in it, and whether it may be written to.

A run's directory is claimed before its first trial, so that a wrong path costs no computing. The
journal is the source of ``trials.csv`` and ``summary.json``, which are made again when a run is
resumed. A run is resumed only with the same configuration and with code that decides the same,
because a table of trials that were decided in two ways would say nothing about either. Another
version of holdfast shows that by computing recorded decisions again
(:mod:`holdfast.robot.recomputing`). Services and links may differ: they change times, never a
decision.
"""

from __future__ import annotations

import contextlib
import itertools
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeAlias

import msgspec

from holdfast import __version__
from holdfast.config.loader import Configuration
from holdfast.config.source import SETTINGS, with_names_of_today
from holdfast.config.user_code import describe_problem_error
from holdfast.errors import DecidedOtherwiseError, OutputError, RebootedError
from holdfast.journal.fingerprint import EarlierCode, difference, fingerprint, read_earlier
from holdfast.journal.journal import Journal
from holdfast.journal.journal_file import (
    JOURNAL_NAME,
    OLD_JOURNAL_NAME,
    START_ANEW,
    boot_id,
    find_journal,
)
from holdfast.journal.journal_reader import JournalReader
from holdfast.journal.tables import RunSummary, SummaryBuilder, csv_lines
from holdfast.journal.timings import count_answers, count_verified
from holdfast.planning.outcome import TrialResult
from holdfast.runtime.files import write_atomically
from holdfast.runtime.machine import machine_of_here

CONFIGURATION_NAME = "config.yaml"
EVENTS_NAME = "events.jsonl"
FIGURE_NAME = "trial.png"
SUMMARY_NAME = "summary.json"
TIMINGS_NAME = "timings.csv"
VERIFICATION_NAME = "verification.csv"
TRIALS_NAME = "trials.csv"
RECOVERY_LOG_NAME = "recovery.log"

OUTPUT_NAMES = (
    TRIALS_NAME,
    SUMMARY_NAME,
    CONFIGURATION_NAME,
    FIGURE_NAME,
    JOURNAL_NAME,
    EVENTS_NAME,
    TIMINGS_NAME,
    VERIFICATION_NAME,
)
"""The last three are there only if services decided."""

_TAKEN_NAMES = (*OUTPUT_NAMES, OLD_JOURNAL_NAME)

_SECTIONS_WITHOUT_DECISIONS = ("offload", "recovery", "lost")
"""Sections that change no decision: what ``lost`` does to a belief is in the journal."""

_EARLIER_CODE = "earlier_code"
"""Key of the note about what other versions have decided."""

_BOOT = "boot"
"""Key of the note in which boot of the machine a robot may move."""

_DECISIONS = {
    "sensing": "the sensing action",
    "task": "the task action",
    None: "the state that a decision led to",
}

_SUMMARY = msgspec.json.Decoder(RunSummary)
_MAX_SUFFIX = 10_000
_MAX_UNUSED_BYTES = 1 << 22
"""Bound on a journal that holds a configuration and no trial."""


ComputeAgain: TypeAlias = Callable[
    [JournalReader, Configuration, str, Sequence[EarlierCode], Callable[[int, int], None]],
    EarlierCode,
]
"""Computes recorded decisions again: :func:`holdfast.robot.recomputing.compute_again`."""


class RunDirectory:
    """An open directory of a run.

    Use :meth:`create`, or ``resume_run`` and ``resume_run_if_begun`` of
    :mod:`holdfast.robot.recomputing`, and close it or use it in a ``with`` statement.
    ``services_before`` are those of the part before, None for a new run, and ``before_upgrade`` is
    what another version decided, if this is the first to go on after it.
    """

    def __init__(
        self,
        path: Path,
        configuration: Configuration,
        journal: Journal,
        services_before: tuple[str, ...] | None = None,
        before_upgrade: EarlierCode | None = None,
    ) -> None:
        self.path = path
        self.configuration = configuration
        self.journal = journal
        self.services_before = services_before
        self.before_upgrade = before_upgrade
        meta = journal.meta()
        self.earlier_wall_time_s = float(meta.get("wall_time_s", "0"))
        self.earlier_code = read_earlier(meta.get(_EARLIER_CODE))

    @classmethod
    def create(
        cls, path: Path, configuration: Configuration, notes: Mapping[str, str] | None = None
    ) -> Self:
        """Claim a directory for a new run; it is made if it is not there.

        A run of which no trial is finished or begun does not keep its directory. ``notes`` are
        added to those about the run. Raises OutputError if it holds a run already, or cannot be
        written.
        """
        path = path.absolute()
        try:
            path.mkdir(parents=True, exist_ok=True)
            taken = [name for name in _TAKEN_NAMES if (path / name).exists()]
        except FileExistsError as error:
            raise OutputError(f"{path}: is a file, not a directory") from error
        except OSError as error:
            raise OutputError(f"{path}: cannot be made: {error.strerror}") from error
        _require_plain_files(path)
        text = configuration.to_yaml()
        made = {"machine": ", ".join(f"{name} {is_}" for name, is_ in machine_of_here().items())}
        meta = {"configuration": text} | fingerprint(configuration) | made | dict(notes or {})
        survives = configuration.recovery.journal_survives
        journal = _unused_journal(path)
        if taken and journal is None:
            raise OutputError(
                f"{path}: holds {', '.join(taken)} already; go on with that run (--resume), or "
                "choose another directory (--out) if the problem or the settings have changed"
            )
        try:
            if journal is not None:
                journal.survives = survives
                journal.restart(meta)
                for name in OUTPUT_NAMES:
                    if name not in (CONFIGURATION_NAME, JOURNAL_NAME):
                        (path / name).unlink(missing_ok=True)
            else:
                _require_writable_directory(path)
                journal = Journal.create(path / JOURNAL_NAME, meta, survives=survives)
            # After the journal, which only one run can have: so both are the same run's.
            write_atomically(path / CONFIGURATION_NAME, text)
            return cls(path, configuration, journal)
        except BaseException:
            if journal is not None:
                journal.close()
            raise

    @classmethod
    def resume(
        cls,
        path: Path,
        configuration: Configuration,
        compute_again: ComputeAgain,
        on_progress: Callable[[int, int], None] = lambda *_: None,
    ) -> Self:
        """Open the directory of a run that shall go on, perhaps to more trials than it had.

        If another version of holdfast began it, recorded decisions are computed again first, and
        must come out the same. ``on_progress`` gets how many were, and of how many. Raises
        OutputError if it holds no run, one of code that decides otherwise or with another
        configuration, one with a trial that the configuration does not ask for, one that is
        damaged, or one that is in use; or if it cannot be written.
        """
        path = path.absolute()
        if not path.is_dir():
            raise OutputError(f"{path}: there is no such directory, so no run to resume")
        file = find_journal(path, "resume")
        _require_plain_files(path)
        survives = configuration.recovery.journal_survives
        try:
            _require_writable_directory(path)
            if (path / OLD_JOURNAL_NAME).exists():
                Journal.convert(path / OLD_JOURNAL_NAME, path / JOURNAL_NAME)
            journal = Journal.open(path / JOURNAL_NAME, survives=survives)
        except OutputError as error:
            if not isinstance(error.__cause__, OSError):
                raise
            # If the journal is damaged as well, its reader raises first.
            JournalReader.read(file).close()
            raise OutputError(
                f"{error}; its journal is whole: go on when it can be written, or with a copy of "
                "the directory (--out)"
            ) from error
        try:
            text = configuration.to_yaml()
            meta = journal.meta()
            _require_same_configuration(path, meta.get("configuration", ""), text)
            _require_enough_trials(path, journal, configuration.simulator.num_trials)
            before_upgrade = _require_same_decisions(
                path, journal, configuration, compute_again, on_progress
            )
            if meta.get("configuration") != text:
                journal.set_meta(configuration=text)
                write_atomically(path / CONFIGURATION_NAME, text)
            before = _services_in(meta.get("configuration", ""))
            return cls(path, configuration, journal, before, before_upgrade)
        except BaseException:
            journal.close()
            raise

    @classmethod
    def resume_if_begun(
        cls,
        path: Path,
        configuration: Configuration,
        compute_again: ComputeAgain,
        on_progress: Callable[[int, int], None] = lambda *_: None,
    ) -> Self:
        """Open the directory of a run that has begun, else claim it for a new one.

        A process that was killed while it claimed the directory leaves a journal without a trial,
        or none: that counts as not begun, and so does any other content. Raises OutputError as
        :meth:`resume` and :meth:`create` do.
        """
        is_there = False
        with contextlib.suppress(OSError):  # create() reports it
            is_there = any((path / name).exists() for name in (JOURNAL_NAME, OLD_JOURNAL_NAME))
        if is_there:
            unused = _unused_journal(path)
            if unused is None:
                return cls.resume(path, configuration, compute_again, on_progress)
            # Whatever repeats the command does not begin it after a reboot, either.
            notes = {key: value for key, value in unused.meta().items() if key == _BOOT}
            unused.close()
            return cls.create(path, configuration, notes)
        return cls.create(path, configuration)

    def allow_robot(self, *, after_reboot: bool) -> None:
        """Let a robot move in this boot of the machine.

        Whatever starts a command again by itself (systemd, Docker, cron) does so after a reboot,
        too, where the robot may have been moved, or somebody may stand beside it. So the run goes
        on only in the boot in which it was begun, or in which a person has said ``after_reboot``.
        Raises RebootedError if the robot may not move. A boot that is not known is another one.
        """
        meta = self.journal.meta()
        before = meta.get(_BOOT, meta.get("steps_boot"))  # a run of 0.1 has only the second
        now = boot_id() or ""
        is_known = bool(before and now)
        if before is not None and not after_reboot and not (is_known and before == now):
            what = (
                "this machine was rebooted since the robot of this run last moved"
                if is_known
                else "nobody knows whether this machine was rebooted since the robot of this run "
                "last moved, because /proc/sys/kernel/random/boot_id could not be read"
            )
            raise RebootedError(
                f"{self.path}: {what}, and after a reboot no robot moves by itself; see whether it "
                "may, and say so (--after-reboot)"
            )
        if before != now:
            self.journal.set_meta(**{_BOOT: now})

    def complete_summary(self) -> RunSummary | None:
        """Return ``summary.json`` if all trials are finished and it covers them all, else None.

        A process that was killed after the last trial may have left none, or an old one.
        """
        trials = self.configuration.simulator.num_trials
        if len(self.journal.finished()) < trials:
            return None
        try:
            summary = _SUMMARY.decode((self.path / SUMMARY_NAME).read_bytes())
        except (OSError, msgspec.DecodeError):
            return None
        return summary if summary.finished == summary.trials == trials else None

    def add(self, result: TrialResult) -> None:
        """Write a finished trial, with its observations unless they can be simulated again."""
        self.journal.add(result, keep_steps=self.configuration.environment.object is not None)

    def write_tables(self, wall_time_s: float) -> RunSummary:
        """Write ``trials.csv`` and ``summary.json``; the time of earlier parts is added."""
        total_s = self.earlier_wall_time_s + wall_time_s
        self.journal.set_meta(wall_time_s=repr(total_s))
        builder = SummaryBuilder()

        def added() -> Iterator[TrialResult]:
            for result in self.journal.results():
                builder.add(result)
                yield result

        write_atomically(self.path / TRIALS_NAME, csv_lines(added()))
        summary = builder.build(
            problem=self.configuration.problem_name,
            seed=self.configuration.simulator.seed,
            version=__version__,
            trials=self.configuration.simulator.num_trials,
            wall_time_s=total_s,
            answers=count_answers(self.path / TIMINGS_NAME, self.journal.finished()),
            verified=count_verified(self.path / VERIFICATION_NAME),
            earlier_code=self.earlier_code,
        )
        write_atomically(self.path / SUMMARY_NAME, summary.to_json())
        return summary

    def close(self) -> None:
        """Close the journal and leave the directory to others."""
        self.journal.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def claim_default_directory(configuration: Configuration, parent: Path) -> Path:
    """Return a directory in ``parent`` that is free for a new run; both are made if missing.

    It is ``<stem of the configuration>-seed<seed>``, with ``-2``, ``-3``, ... if that is taken.
    Raises OutputError if it cannot be made.
    """
    for path in _default_directories(configuration, parent):
        free = _unused_journal(path)
        if free is not None:
            free.close()
            return path
        try:
            parent.mkdir(parents=True, exist_ok=True)
            # Making it is also the test whether it is free, so two runs never share one.
            path.mkdir()
        except FileExistsError:
            if not parent.is_dir():
                raise OutputError(f"{parent}: is a file, not a directory") from None
        except OSError as error:
            raise OutputError(f"{path}: cannot be made: {error.strerror}") from error
        else:
            return path
    raise OutputError(f"{parent}: more than {_MAX_SUFFIX} runs of one name; give --out")


def latest_default_directory(configuration: Configuration, parent: Path) -> Path:
    """Return the last of the directories that :func:`claim_default_directory` has made.

    Raises OutputError if there is none.
    """
    paths = _default_directories(configuration, parent)
    made = list(itertools.takewhile(Path.exists, paths))
    if not made:
        first = next(_default_directories(configuration, parent))
        raise OutputError(f"{first}: there is no such directory, so no run to resume; give --out")
    return made[-1]


def _default_directories(configuration: Configuration, parent: Path) -> Iterator[Path]:
    name = f"{configuration.path.stem}-seed{configuration.simulator.seed}"
    parent = parent.absolute()
    yield parent / name
    for number in range(2, _MAX_SUFFIX):
        yield parent / f"{name}-{number}"


def _unused_journal(path: Path) -> Journal | None:
    """Return the open journal of a run that has done nothing yet, None if there is none."""
    # One that is absent, in use, damaged or not ours cannot be used.
    with contextlib.suppress(OutputError, OSError):
        if (path / JOURNAL_NAME).stat().st_size < _MAX_UNUSED_BYTES:
            journal = Journal.open(path / JOURNAL_NAME)
            if journal.is_empty():
                return journal
            journal.close()
    return None


def _require_writable_directory(path: Path) -> None:
    """Raise OutputError unless a file can be made there."""
    try:
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _require_plain_files(path: Path) -> None:
    """Raise OutputError if a run would write elsewhere, through a link or into a device.

    A directory may be somebody else's, copied or unpacked.
    """
    for name in (*_TAKEN_NAMES, RECOVERY_LOG_NAME):
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISREG((path / name).lstat().st_mode):
                raise OutputError(
                    f"{path / name}: is no file but a link, directory or device; a run writes "
                    "into its own directory alone: remove it"
                )


def _require_same_decisions(
    path: Path,
    journal: Journal,
    configuration: Configuration,
    compute_again: ComputeAgain,
    on_progress: Callable[[int, int], None],
) -> EarlierCode | None:
    """Raise OutputError unless this code decides as the code that the journal is of.

    Note in the journal, and return, what that code has decided; None if it is the same code.
    """
    meta, here = journal.meta(), fingerprint(configuration)
    found = difference(meta, here)
    if found is None:
        return None
    if found.is_the_problems:
        raise OutputError(
            f"{path}: that run cannot go on: {found.words}, so the trials would not compare; "
            f"{START_ANEW}"
        )
    earlier = read_earlier(meta.get(_EARLIER_CODE))
    former = f"go on with the former, or {START_ANEW}"
    try:
        before_upgrade = compute_again(journal, configuration, found.made_by, earlier, on_progress)
    except OutputError:  # of a journal that is damaged
        raise
    except DecidedOtherwiseError as error:
        raise OutputError(
            f"{path}: that run cannot go on: {found.words}, and it decides otherwise, first in "
            f"trial {error.trial}, step {error.step} ({_DECISIONS[error.kind]}); {former}"
        ) from error
    except Exception as error:  # whatever the problem raises, which is anybody's code
        why = describe_problem_error(configuration.problem_name, error)
        raise OutputError(
            f"{path}: that run cannot go on: {found.words}, and its decisions cannot be computed "
            f"again: {why}; {former}"
        ) from error
    text = msgspec.json.encode((*earlier, before_upgrade)).decode()
    journal.set_meta(**here, **{_EARLIER_CODE: text})
    return before_upgrade


def _require_same_configuration(path: Path, there: str, here: str) -> None:
    found = configuration_difference(there, here)
    if found is not None:
        key, old, new = found
        raise OutputError(
            f"{path}: that run has another configuration: {key} is {old} there and {new} here; "
            "use the same one, or another directory (--out)"
        )


def configuration_difference(first: str, second: str) -> tuple[str, str, str] | None:
    """Return the first key that changes a decision and differs in two resolved configurations.

    With both values, for a person; None if there is none.
    """
    return first_difference(*(_compared(recorded_configuration(text)) for text in (first, second)))


def recorded_configuration(text: str, journal: Path | str = "a journal") -> Any:
    """Return a configuration from a journal, as plain data; somebody else may have written it."""
    from holdfast.config.yaml_document import read

    data = read(text.encode(), f"the configuration in {journal}").data
    return with_names_of_today(data) if isinstance(data, Mapping) else data


def _compared(configuration: Any) -> Any:
    """Leave out what changes no decision: number of trials, services, directories."""
    if not isinstance(configuration, Mapping):
        return configuration
    left_out = ("problem_directory", *_SECTIONS_WITHOUT_DECISIONS)
    kept = {key: value for key, value in configuration.items() if key not in left_out}
    if isinstance(kept.get("simulator"), Mapping):
        kept["simulator"] = {
            key: value for key, value in kept["simulator"].items() if key != "num_trials"
        }
    # A run from before a key existed lacks it, and its default is what was done then.
    for name, schema in SETTINGS.items():
        if isinstance(kept.get(name), Mapping):
            defaults = msgspec.json.decode(msgspec.json.encode(schema()))
            kept[name] = {**defaults, **kept[name]}
    environment = kept.pop("environment", None)
    if isinstance(environment, Mapping) and environment.get("object") is not None:
        kept["environment"] = world_of(environment)
    return kept


def world_of(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return what says which world an environment is; the rest is how it is reached."""
    return {"object": environment.get("object"), "arguments": environment.get("arguments") or {}}


def _services_in(text: str) -> tuple[str, ...]:
    match recorded_configuration(text):
        case {"offload": {"services": [*services]}}:
            return tuple(map(str, services))
    return ()


def _require_enough_trials(path: Path, journal: Journal, num_trials: int) -> None:
    finished, begun = journal.finished(), journal.unfinished_trial()
    last = max(finished if begun is None else {*finished, begun}, default=-1)
    state = "begun" if last == begun else "finished"
    if last >= num_trials:
        raise OutputError(
            f"{path}: trial {last} of that run is {state}, so simulator.num_trials (--trials) is "
            f"at least {last + 1}, not {num_trials}; use another directory (--out) for fewer"
        )


def first_difference(there: Any, here: Any, key: str = "") -> tuple[str, str, str] | None:
    """Return the first key whose value differs, and both values, None if there is none."""
    inner: dict[str, tuple[Any, Any]] = {}
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        dot = "." if key else ""
        inner = {f"{dot}{name}": (there.get(name), here.get(name)) for name in [*here, *there]}
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = zip(there, here, strict=True)
        inner = {f"[{index}]": pair for index, pair in enumerate(pairs)}
    elif there != here:
        old, new = ("not given" if value is None else repr(value) for value in (there, here))
        return key or "the whole", old, new
    found = (first_difference(*pair, f"{key}{name}") for name, pair in inner.items())
    return next(filter(None, found), None)
