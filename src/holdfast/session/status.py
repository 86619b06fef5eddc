"""The three statuses of a run and the one table of how they follow each other.

They are the thesis's: *standard* while the cloud decides and the local service was never needed,
*local recovery* while no cloud service can be used, *keep alive* when a cloud service decides again
and the local one stays ready for the next time. All transitions are in :data:`TRANSITIONS`, and
``docs/status.md`` is made from it; what is not in the table is a defect and raises.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType

__all__ = ["TRANSITIONS", "Cause", "IllegalTransitionError", "Status", "diagram", "next_status"]


class Status(Enum):
    """Who decides."""

    STANDARD = "standard"
    """A cloud service does; the local one was never needed."""

    LOCAL_RECOVERY = "local_recovery"
    """The local service does, and the cloud is tried at every turn."""

    KEEP_ALIVE = "keep_alive"
    """A cloud service does again; the local one stays ready."""


class Cause(Enum):
    """What changes the status."""

    CLOUD_LOST = "no cloud service can be used"
    CLOUD_ANSWERED = "a cloud service has answered"


class IllegalTransitionError(RuntimeError):
    """A cause that cannot occur in a status: a defect of the caller."""


TRANSITIONS: Mapping[tuple[Status, Cause], Status] = MappingProxyType(
    {
        (Status.STANDARD, Cause.CLOUD_LOST): Status.LOCAL_RECOVERY,
        (Status.LOCAL_RECOVERY, Cause.CLOUD_ANSWERED): Status.KEEP_ALIVE,
        (Status.KEEP_ALIVE, Cause.CLOUD_LOST): Status.LOCAL_RECOVERY,
    }
)


def next_status(status: Status, cause: Cause) -> Status:
    """Return the status that follows.

    Raises
    ------
    IllegalTransitionError
        If the table does not have that transition.
    """
    try:
        return TRANSITIONS[status, cause]
    except KeyError:
        raise IllegalTransitionError(f"{cause.name} in status {status.value}") from None


def diagram() -> str:
    """Return the table as a Mermaid state diagram."""
    lines = ["stateDiagram-v2", f"    [*] --> {Status.STANDARD.value}"]
    lines += [
        f"    {before.value} --> {after.value}: {cause.value}"
        for (before, cause), after in TRANSITIONS.items()
    ]
    return "\n".join(lines) + "\n"
