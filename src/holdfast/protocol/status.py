"""The three statuses of a run and the one table of their transitions.

They are those of Scott's master's thesis (see the README). *Standard*: the cloud decides, and
the local service was never needed. *Local recovery*: no cloud service is usable. *Keep alive*: a
cloud service decides again, and the local one stays ready. ``docs/status.md`` is generated from
:data:`TRANSITIONS`; any other transition is a defect and raises.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType

from holdfast.errors import IllegalTransitionError


class Status(Enum):
    """Which service decides."""

    STANDARD = "standard"
    """A cloud service; the local one was never needed."""

    LOCAL_RECOVERY = "local_recovery"
    """The local service, or nobody until it is up; the cloud is tried with each question, too."""

    KEEP_ALIVE = "keep_alive"
    """A cloud service again; the local one stays ready."""


MEANINGS: Mapping[Status, str] = MappingProxyType(
    {
        Status.STANDARD: "the cloud decides, the local service was never needed",
        Status.LOCAL_RECOVERY: "the local service decides, the cloud is tried again",
        Status.KEEP_ALIVE: "the cloud decides, the local service stays ready",
    }
)
"""The statuses in a few words, for a screen."""


class Cause(Enum):
    """What changes the status."""

    CLOUD_LOST = "no cloud service can be used"
    CLOUD_ANSWERED = "a cloud service has answered"


TRANSITIONS: Mapping[tuple[Status, Cause], Status] = MappingProxyType(
    {
        (Status.STANDARD, Cause.CLOUD_LOST): Status.LOCAL_RECOVERY,
        (Status.LOCAL_RECOVERY, Cause.CLOUD_ANSWERED): Status.KEEP_ALIVE,
        (Status.KEEP_ALIVE, Cause.CLOUD_LOST): Status.LOCAL_RECOVERY,
    }
)


def next_status(status: Status, cause: Cause) -> Status:
    """Return the status that follows; IllegalTransitionError if the table has none."""
    try:
        return TRANSITIONS[status, cause]
    except KeyError:
        raise IllegalTransitionError(f"{cause.name} in status {status.value}") from None


class StatusTracker:
    """The status of a robot's process, with how often and since when the cloud is lost."""

    def __init__(self) -> None:
        self._lost_at: float | None = None
        self.status = Status.STANDARD
        self.recoveries = 0

    @property
    def is_recovering(self) -> bool:
        """Whether the cloud is considered lost."""
        return self.status is Status.LOCAL_RECOVERY

    def change(
        self, cause: Cause, reason: str, now: float, silence_s: float | None = None
    ) -> dict[str, object]:
        """Change the status; return the fields of the log event.

        ``silence_s`` says how long the cloud has been silent, if it is lost and was ever there.
        Raises IllegalTransitionError, and changes nothing, if the table does not have that.
        """
        before, self.status = self.status, next_status(self.status, cause)
        fields: dict[str, object] = {"from": before.value, "to": self.status.value}
        if cause is Cause.CLOUD_LOST:
            self._lost_at = now
            self.recoveries += 1
            if silence_s is not None:
                fields["silent_ms"] = 1e3 * silence_s
        elif self._lost_at is not None:
            fields["outage_ms"] = 1e3 * (now - self._lost_at)
        return {**fields, "reason": reason}


def diagram() -> str:
    """Return the table as a Mermaid state diagram."""
    lines = ["stateDiagram-v2", f"    [*] --> {Status.STANDARD.value}"]
    lines += [
        f"    {before.value} --> {after.value}: {cause.value}"
        for (before, cause), after in TRANSITIONS.items()
    ]
    return "\n".join(lines) + "\n"
