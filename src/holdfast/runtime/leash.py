"""A process that ends with the one that started it, however that one ends (Linux).

Signals to be handled in order are one thing; a parent that is killed is another: nobody is left who
wants what its children compute, and nobody who would end them. The system does it, if the child
asks for that.

This file is imported, and run as a program too; so it imports nothing of holdfast.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

__all__ = ["end_with_parent", "leash"]

_PR_SET_PDEATHSIG = 1


def end_with_parent(parent: int) -> None:
    """Let this process end at once when its parent does. Elsewhere than on Linux: do nothing.

    Strictly, what counts is the end of the thread that started this process.

    Parameters
    ----------
    parent : int
        Its process. If that has ended already, this one ends here.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != parent:
            os._exit(1)


def leash() -> tuple[str, ...]:
    """Return a command that becomes another one, which ends at once when this process does.

    Empty elsewhere than on Linux. A service that ends when its standard input does needs none.
    """
    if sys.platform != "linux":
        return ()
    return (sys.executable, "-I", "-S", __file__, str(os.getpid()))


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])
