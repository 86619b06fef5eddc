"""All exceptions of holdfast.

Every error that holdfast raises on purpose is a :class:`HoldfastError`, except defects of the
caller. The message names the value, its bound and the key of the configuration, because its reader
has the file open, not this code.
"""

from __future__ import annotations

import copyreg
import os
import traceback
from errno import EDQUOT, ENOSPC


class HoldfastError(Exception):
    """Base of every error that holdfast raises on purpose."""

    def __reduce__(self) -> tuple[object, ...]:
        # Else a pool of processes, which passes errors on, would have to call __init__ again.
        return copyreg.__newobj__, (type(self), *self.args), vars(self)  # type: ignore[attr-defined]


class InvalidValueError(HoldfastError, ValueError):
    """A value is outside its bounds: a negative variance, a NaN in an observation, k >= N."""


class ConfigurationError(HoldfastError):
    """A configuration file cannot be used; the message says which file, key and value."""


class UnknownProblemError(ConfigurationError):
    """The problem's name is not registered, and its class cannot be imported."""


class OtherCodeError(HoldfastError):
    """Robot and service run different code of holdfast or the problem, and may decide differently.

    The message names the problem and the digests of both.
    """


class ProblemError(HoldfastError):
    """A function of the problem violated its contract."""


class InterruptedComputationError(HoldfastError):
    """A computation was ended from another thread, because nobody awaits its result."""


class EnvironmentFailedError(HoldfastError):
    """The environment raised, stalled, or violated its contract."""


class CheckpointError(HoldfastError):
    """A checkpoint does not decode to a valid planning state."""


class TransportError(HoldfastError):
    """An endpoint cannot be used: it is malformed, in use, or lacks credentials."""


class TrialError(HoldfastError):
    """An error of holdfast or of the problem's code, with the trial in which it occurred.

    Attributes
    ----------
    arm : Arm or None
        Whose trial it was, in a pool (:mod:`holdfast.robot.trial_pool`).
    """

    arm: object | None = None


class RunError(HoldfastError):
    """An error that ended a run; the message has the reason and the command.

    Attributes
    ----------
    command : str or None
        The command that continues the run; None if it cannot continue.
    """

    def __init__(self, error: HoldfastError, command: str | None, exit_code: int = 2) -> None:
        cause: BaseException | None = error
        while cause is not None and getattr(cause, "errno", None) not in (ENOSPC, EDQUOT):
            cause = cause.__cause__
        self.reason = f"{error}; make room on the disk first" if cause else str(error)
        super().__init__(f"{self.reason}\nGo on with: {command}" if command else self.reason)
        self.command = command
        self.exit_code = exit_code


class OptionError(HoldfastError):
    """A command-line value is not allowed; the message names the option and the bound."""


class UnwritableOutputError(HoldfastError):
    """The standard output cannot be written, although its reader has not closed it."""


class OutputError(HoldfastError):
    """The output of a run cannot be written or read, or does not belong to this run."""


class UntrustedCodeError(HoldfastError):
    """A recorded run names code, and its reader has not said that it may be run."""


class ServiceRefusedError(HoldfastError):
    """Every available service refuses to decide, and a retry would not help."""


class MessageError(HoldfastError):
    """Bytes that do not decode to a message within its bounds.

    Attributes
    ----------
    code : str
        As in :class:`Refused`.
    """

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class RecordError(HoldfastError):
    """A record of the journal does not decode, or does not follow from those before it."""


class StaleEpochError(HoldfastError):
    """Another process has taken this run over; this robot must stop."""


class HeldError(HoldfastError):
    """The robot holds still: its environment failed. The run can be resumed."""


class RebootedError(HoldfastError):
    """The machine was rebooted since the robot last moved; a person must let the run go on."""


class UnknownPerformanceError(HoldfastError):
    """The last task action before a crash may or may not have been performed."""


class IllegalTransitionError(RuntimeError):
    """An event that cannot occur in this status: a defect of the caller."""


class LostJournalError(OutputError):
    """The journal was removed or replaced while it was open."""


class DecidedOtherwiseError(RecordError):
    """A recomputed decision of a trial differs from the recorded one.

    Attributes
    ----------
    kind : {"sensing", "task"} or None
        Kind of the recorded decision; None at the end of the records.
    """

    def __init__(self, trial: int, step: int, kind: str | None) -> None:
        super().__init__(
            f"trial {trial}: the decision of step {step} differs when it is computed again: the "
            "problem is not deterministic, or a service decided differently"
        )
        self.trial = trial
        self.step = step
        self.kind = kind


class WorkerDiedError(HoldfastError):
    """A worker process ended unexpectedly, or was ended because its trial was overdue.

    Attributes
    ----------
    arm : Arm or None
        What it ran, in its trial ``trial``.
    how : str
        How it ended, as the predicate of a sentence; ``killed`` if by a signal.
    """

    arm: object = None
    trial = -1
    how = ""
    killed = overdue = False


class TrialCrashError(RuntimeError):
    """An unexpected error in a worker process; the message holds its traceback, ``arm`` the arm."""

    arm: object = None


class MissingRosbagsError(HoldfastError):
    """The library rosbags is not installed."""


class ViewError(HoldfastError):
    """A run cannot be shown: Rerun is not installed, or its viewer cannot be reached."""


class DescriptorError(HoldfastError):
    """The process needs more open files and sockets than its limit."""


class HealthError(HoldfastError):
    """The server for health and metrics cannot listen at an address."""


class MetricsError(HoldfastError):
    """A package that metrics need is missing."""


class ServiceProcessError(HoldfastError):
    """A process of a service has ended before it served."""


class CredentialsError(HoldfastError):
    """Credentials cannot be made or used; the message names the file and the reason."""


class CredentialsGoneError(CredentialsError):
    """Credentials are missing or unreadable, have expired, or were revoked."""


class FrameError(TransportError):
    """Received bytes are no valid frame; the message completes a sentence about the sender."""


class KeysExhaustedError(TransportError):
    """A key has encrypted its maximum number of datagrams; a new link has new keys."""


DEFECT = "defect"
"""Name of the event that reports an exception that no code of ours expects."""

_MAX_TRACEBACK = 4000
"""Characters; the end is kept, where the exception is."""


def how_to_install(package: str, extra: str | None = None) -> str:
    """Return what installs a package or its extra: pip, or in an image ``HOLDFAST_INSTALL``."""
    if (of_image := os.environ.get("HOLDFAST_INSTALL")) is not None:
        return of_image.replace("{}", package)
    return f"pip install {package}" if extra is None else f"pip install 'holdfast-sensing[{extra}]'"


def defect_fields(error: BaseException) -> dict[str, str]:
    """Return the fields of a :data:`DEFECT`: what was raised, and where."""
    trace = "".join(traceback.format_exception(error))
    return {"reason": f"{type(error).__name__}: {error}", "traceback": trace[-_MAX_TRACEBACK:]}
