"""``python -m holdfast_ros.ros2``."""

from __future__ import annotations

import sys

from holdfast_ros.ros2.main import main

sys.exit(main())
