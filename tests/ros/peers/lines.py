"""How a peer and the test that runs it talk: a message is a line of JSON, its fields by name.

A client reads requests and writes what the service has answered; a server writes requests and reads
what it is to answer. JSON keeps every bit of a number.
"""

from __future__ import annotations

import json
import sys
from typing import Any


def read() -> dict[str, Any] | None:
    """Return the next message, None at the end."""
    line = sys.stdin.readline()
    return json.loads(line) if line else None


def write(message: dict[str, Any]) -> None:
    """Tell a message."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()
