"""Files and sockets that this process may have open at a time, and what it needs of them.

With too few, each part fails in its own way: no event loop, a journal that cannot be opened, a
service to which nobody can connect. So the limit is looked at before anything is opened. What a
process may allow itself (the hard limit), it takes.
"""

from __future__ import annotations

import contextlib

from holdfast.errors import HoldfastError

__all__ = ["NEEDED", "DescriptorError", "allow_descriptors"]

NEEDED = 64
"""For any command. A robot was seen to have 21 open at a time, a service 9 without its robots."""


class DescriptorError(HoldfastError):
    """Fewer files and sockets may be open at a time than the process needs."""


def allow_descriptors(wanted: int = NEEDED) -> int:
    """See to it that this process may have enough files and sockets open at a time.

    Parameters
    ----------
    wanted : int
        The limit is raised to so many, as far as the process is allowed to; it is never lowered.

    Returns
    -------
    int
        How many may be open now; ``wanted`` if there is no limit.

    Raises
    ------
    DescriptorError
        If fewer than :data:`NEEDED` are allowed; the message says how the limit is raised.
    """
    try:
        import resource
    except ImportError:
        return wanted  # no such limit on this system
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    possible = wanted if hard == unlimited else min(wanted, hard)
    if soft != unlimited and soft < possible:
        # A system may have a bound of its own below the hard limit.
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (possible, hard))
            soft = possible
    if soft != unlimited and soft < NEEDED:
        raise DescriptorError(
            f"this process may have {soft} files and sockets open at a time (RLIMIT_NOFILE), and "
            f"needs {NEEDED}; raise the limit with 'ulimit -n {NEEDED}', for a service of systemd "
            f"with LimitNOFILE={NEEDED}"
        )
    return wanted if soft == unlimited else soft
