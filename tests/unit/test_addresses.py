"""Addresses and the system's refusals as words."""

import errno
import os

from holdfast.runtime.addresses import host_and_port, system_words, why_not_bound


def test_an_ipv6_address_has_brackets() -> None:
    assert host_and_port("robot.example", 7447) == "robot.example:7447"
    assert host_and_port("::1", 7447) == "[::1]:7447"


def test_the_system_s_text_goes_on_with_a_sentence() -> None:
    assert system_words(errno.ECONNREFUSED) == "connection refused"
    assert system_words(None) == "success"


def test_why_an_address_cannot_be_bound() -> None:
    assert why_not_bound(OSError(errno.EACCES, "what asyncio says")) == os.strerror(errno.EACCES)
    unknown = why_not_bound(OSError(errno.EADDRNOTAVAIL, "what asyncio says"))
    assert unknown.endswith("this machine has no such address (0.0.0.0 is all that it has)")
    # Names that are not found have numbers below 0.
    assert why_not_bound(OSError(-2, "Name or service not known")) == "Name or service not known"
