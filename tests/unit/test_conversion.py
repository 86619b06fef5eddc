"""The first use of a struct by two threads at once."""

from tests.programs import said_by

_PROGRAM = """
import threading
import msgspec
from holdfast.conversion import convert

made, begun, other = [], threading.Event(), threading.Event()

def whole():
    # Called while the fields of Outer are inspected.
    if not begun.is_set():
        begun.set()
        threading.Thread(target=use).start()
        other.wait(0.3)  # in vain where one thread at a time inspects
    return int

def use():
    made.append(convert({"inner": {"number": 2}}, Outer))
    other.set()

class Inner(msgspec.Struct):
    number: "whole()"

class Outer(msgspec.Struct):
    inner: Inner

made.append(convert({"inner": {"number": "1"}}, Outer, strict=False))
assert other.wait(60.0)
print(*sorted(map(str, made)))
"""


def test_a_struct_that_one_thread_inspects_is_used_by_another_afterwards() -> None:
    # In a process of its own: what goes wrong here ends it.
    assert said_by(_PROGRAM) == "Outer(inner=Inner(number=1)) Outer(inner=Inner(number=2))\n"
