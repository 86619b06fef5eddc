"""Both sources of decisions offer what the robot's loop asks of them."""

from __future__ import annotations

import inspect

import pytest

from holdfast.protocol.decision_source import DecisionSource, InProcessSource
from holdfast.protocol.dispatcher import Dispatcher

METHODS = [
    name
    for name, member in vars(DecisionSource).items()
    if inspect.isfunction(member) and not name.startswith("_")
]


@pytest.mark.parametrize("source", [Dispatcher, InProcessSource])
@pytest.mark.parametrize("name", METHODS)
def test_methods_take_the_same_parameters(source: type, name: str) -> None:
    asked = inspect.signature(getattr(DecisionSource, name)).parameters
    assert list(inspect.signature(getattr(source, name)).parameters) == list(asked)
