"""Unexpected exceptions of a link: they end that link and nothing else."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

if TYPE_CHECKING:
    from holdfast.transport.links import Link

__all__ = ["ends_link"]

_Arguments = ParamSpec("_Arguments")
_AnyLink = TypeVar("_AnyLink", bound="Link")


def ends_link(
    method: Callable[Concatenate[_AnyLink, _Arguments], None],
) -> Callable[Concatenate[_AnyLink, _Arguments], None]:
    """Have an exception of a method end its link, by :meth:`Link.fail`.

    For the methods by which anything else enters a link: the event loop, the scheduler, the owner.
    """

    @functools.wraps(method)
    def guarded(link: _AnyLink, /, *arguments: _Arguments.args, **named: _Arguments.kwargs) -> None:
        try:
            method(link, *arguments, **named)
        except Exception as error:  # noqa: BLE001 - what a peer sends may raise anything
            link.fail(error)

    return guarded
