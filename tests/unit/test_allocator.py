import os
import platform
import sys

import pytest
from tests.programs import completed

pytestmark = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="another C library has no arenas, or other ones"
)

THREADS = 7

# All of them live at the same time: what one arena is free of, the next thread would take.
PROGRAM = f"""
import ctypes, sys, threading
from holdfast.service.allocator import limit_arenas

if sys.argv[1] == "limited":
    limit_arenas()
library = ctypes.CDLL(None)
library.malloc.restype = library.fopen.restype = ctypes.c_void_p
allocated, told = threading.Barrier({THREADS + 1}), threading.Barrier({THREADS + 1})

def allocate():
    library.free(ctypes.c_void_p(library.malloc(5000)))
    allocated.wait()
    told.wait()

threads = [threading.Thread(target=allocate) for _ in range({THREADS})]
for thread in threads:
    thread.start()
allocated.wait()
output = ctypes.c_void_p(library.fopen(b"/dev/stdout", b"w"))
library.malloc_info(0, output)
library.fclose(output)
told.wait()
"""


def arenas(how: str, **variables: str) -> int:
    """Count the arenas of a process in which several threads have allocated."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("MALLOC_ARENA_MAX", "GLIBC_TUNABLES")
    }
    done = completed(
        [sys.executable, "-c", PROGRAM, how], env={**environment, **variables}, timeout=120.0
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.count("<heap nr=")


def test_threads_have_arenas_of_their_own_until_these_are_limited() -> None:
    assert arenas("unlimited") == THREADS + 1
    assert arenas("limited") == 2


@pytest.mark.parametrize(
    "variables",
    [{"MALLOC_ARENA_MAX": "5"}, {"GLIBC_TUNABLES": "glibc.malloc.arena_max=5"}],
    ids=str,
)
def test_whoever_starts_the_process_may_choose(variables: dict[str, str]) -> None:
    assert arenas("limited", **variables) == 5


def test_what_else_is_chosen_does_not_count() -> None:
    assert arenas("limited", GLIBC_TUNABLES="glibc.malloc.tcache_count=7") == 2
