"""The table of schemes: each has an implementation."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

from holdfast.transport.endpoints import SCHEMES
from holdfast.transport.schemes import Scheme, load_scheme


@pytest.mark.parametrize("name", SCHEMES)
def test_each_is_implemented_by_a_class_with_the_same_methods(name: str) -> None:
    scheme = load_scheme(name)
    assert isinstance(scheme, Scheme)
    for method, base in inspect.getmembers(Scheme, inspect.isfunction):
        if not method.startswith("_"):
            assert inspect.signature(getattr(type(scheme), method)) == inspect.signature(base)
    scheme.close()


def test_what_no_endpoint_uses_is_not_imported() -> None:
    program = (
        "import sys; from holdfast.transport.schemes import load_scheme; "
        "load_scheme('tcp'); print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    loaded = {name for name in done.stdout.split() if name.startswith("holdfast.transport.")}
    assert not loaded & {"holdfast.transport.datagram_links", "holdfast.transport.tls"}
