"""holdfast: choose what to sense, and keep deciding the same whatever fails."""

from __future__ import annotations

__version__ = "0.1.0"
