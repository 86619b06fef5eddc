"""What a link's methods raise; the contracts of the links show that nobody else notices it."""

from __future__ import annotations

from typing import cast

import pytest

from holdfast.transport.links import Link, ends_link


class Fragile:
    """Stands for a link."""

    def __init__(self) -> None:
        self.failed: list[Exception] = []

    def fail(self, error: Exception) -> None:
        self.failed.append(error)


def test_an_exception_ends_the_link_and_goes_no_further() -> None:
    @ends_link
    def take(link: Link, error: BaseException, *, twice: bool) -> None:
        """Take a frame."""
        assert twice
        raise error

    link, defect = Fragile(), ValueError("year 10000")
    take(cast(Link, link), defect, twice=True)
    assert link.failed == [defect]
    assert (take.__name__, take.__doc__) == ("take", "Take a frame.")
    with pytest.raises(KeyboardInterrupt):  # this process is asked to end
        take(cast(Link, link), KeyboardInterrupt(), twice=True)
    assert link.failed == [defect]
