"""Addresses and the system's refusals as words, for messages."""

from __future__ import annotations

import errno
import os


def host_and_port(host: str, port: int) -> str:
    """Return HOST:PORT, with an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def system_words(number: int | None) -> str:
    """Return the system's text for an error number, as the rest of a sentence."""
    text = os.strerror(number or 0)
    return text[:1].lower() + text[1:]


def why_not_bound(error: OSError) -> str:
    """Return why a socket could not be bound to an address."""
    number = error.errno or 0  # of a name that is not found it is below 0
    # asyncio's own text names the address again.
    reason = os.strerror(number) if number > 0 else error.strerror or str(error)
    if number == errno.EADDRNOTAVAIL:
        reason += ": this machine has no such address (0.0.0.0 is all that it has)"
    return reason
