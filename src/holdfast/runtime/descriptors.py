"""The limit on open files and sockets of this process.

With too few, each part fails in its own way: no event loop, no journal, no connections. So the
limit is checked before anything is opened, and raised as far as the hard limit allows.
"""

from __future__ import annotations

import contextlib

from holdfast.errors import DescriptorError

NEEDED = 64
"""For any command. A robot was seen to have 21 open at a time, a service 9 without its robots."""


def allow_descriptors(wanted: int = NEEDED, needed: int = NEEDED, instead: str = "") -> int:
    """Raise the limit on open files and sockets to ``wanted``, as far as the hard limit allows.

    Returns how many may be open now; ``wanted`` if there is no limit. Raises DescriptorError if
    fewer than ``needed`` are allowed; the message says how to raise the limit, and what to do
    ``instead``.
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
    if soft != unlimited and soft < needed:
        raise DescriptorError(
            f"this process may have {soft} files and sockets open at a time (RLIMIT_NOFILE), and "
            f"needs {needed}; raise the limit with 'ulimit -n {needed}', for a service of systemd "
            f"with LimitNOFILE={needed}{instead}"
        )
    return wanted if soft == unlimited else soft
