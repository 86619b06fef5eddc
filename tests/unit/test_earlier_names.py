"""An earlier name goes when it was said to; that it warns, the tests of the name itself show."""

from packaging.version import Version

import holdfast
from holdfast.earlier_names import EARLIER_NAMES


def test_no_name_is_overdue() -> None:
    for name, (now, goes) in EARLIER_NAMES.items():
        assert Version(holdfast.__version__) < Version(goes), f"{name} goes: {now} is its name"
