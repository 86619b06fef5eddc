"""A domain of ROS 2 for each test: what other tests do at the same time is not heard there."""

import contextlib
import fcntl
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

FIRST, LAST = 1, 100
"""Those that are safe to use on every system."""


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Claim a domain that no other test has."""
    numbers = list(range(FIRST, LAST + 1))
    random.SystemRandom().shuffle(numbers)
    for number in numbers:
        with Path(tempfile.gettempdir(), f"holdfast-ros-domain-{number}").open("w") as claim:
            try:
                fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield number
            return
    raise RuntimeError(f"all domains from {FIRST} to {LAST} are taken")
