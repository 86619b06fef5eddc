"""Ports for tests, at each of which nobody has been for a long while.

A port that the system chooses may have been another test's a moment ago, whose robot still tries to
reach the service that was killed there; and while a service is away, the system may give its port
to somebody else, if only to connect from. So tests take theirs from below those that the system
chooses from, each worker of pytest-xdist its own, one after another.
"""

import os

from holdfast_lab.testbed.processes import Ports

FIRST, END = 10_000, 20_000
"""Linux chooses from 32768 on, unless it is told otherwise; chaos trials from 20000 on."""

WORKERS = 4
"""So many of them share no port; nor do as many that test ROS 1 beside them (.ci/run)."""

_SIZE = (END - FIRST) // (2 * WORKERS)
_BLOCK = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % WORKERS
_BLOCK += WORKERS * ("ROS1" in os.environ)

free_port = Ports(FIRST + _BLOCK * _SIZE, FIRST + (_BLOCK + 1) * _SIZE).free
