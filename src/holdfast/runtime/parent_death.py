"""The parent-death signal: a process ends with its parent, however that one ends (Linux).

A parent that is killed cannot end its children. The system does, if a child has set its
parent-death signal (``prctl(2)``).

This file is also run as a program, so it imports nothing of holdfast.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def end_with_parent(parent: int) -> None:
    """End this process at once when its parent ends; does nothing where there is no Linux.

    ``parent`` is its process id; if it has ended already, this process ends here. The signal comes
    when the thread that started this process ends.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != parent:
            os._exit(1)


def parent_death_prefix() -> tuple[str, ...]:
    """Return a command prefix: the command after it ends at once when this process does.

    Empty where there is no Linux. A service that ends with its standard input needs none.
    """
    if sys.platform != "linux":
        return ()
    return (sys.executable, "-I", "-S", __file__, str(os.getpid()))


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])
