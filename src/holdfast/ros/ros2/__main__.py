"""``python -m holdfast.ros.ros2``."""

from __future__ import annotations

import sys

from holdfast.ros.ros2.main import main

sys.exit(main())
