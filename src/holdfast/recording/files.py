"""Files that are there whole or not at all: :mod:`holdfast.files`, under its older name."""

from __future__ import annotations

from holdfast.files import OutputError, write_atomically

__all__ = ["OutputError", "write_atomically"]
