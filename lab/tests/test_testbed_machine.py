"""The machine of a measurement, by name."""

from holdfast import _kernel
from holdfast_lab.testbed.machine import describe, kernel_hash


def test_all_that_a_time_depends_on_has_a_name() -> None:
    found = describe()
    assert found["instruction set"] == _kernel.simd()
    assert {"processor", "cores", "memory", "system", "Python", "NumPy", "holdfast"} <= set(found)
    assert all(found.values())
    assert kernel_hash() == kernel_hash() != ""
