"""The machine of here, by name."""

from holdfast import _kernel
from holdfast.runtime.machine import available_cores, machine_of_here


def test_a_run_says_where_it_was_begun() -> None:
    found = machine_of_here()
    assert found["instruction set"] == _kernel.simd()
    assert found["cores"].startswith(f"{available_cores()} of ")
    assert all(found.values())
