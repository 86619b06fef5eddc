"""How much Hypothesis draws: little each time, much in the slow tests."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st


def examples(quick: int, slow: int) -> pytest.MarkDecorator:
    """Return a parameter ``examples`` for a test: few of them, and many in the slow tests."""
    many = pytest.param(slow, marks=pytest.mark.slow, id="slow")
    return pytest.mark.parametrize("examples", [pytest.param(quick, id="quick"), many])


def always(examples: int, check: Callable[..., None], *strategies: st.SearchStrategy[Any]) -> None:
    """Check something of so many values of these strategies, the same ones each time."""
    bounded = settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    bounded(given(*strategies)(check))()
