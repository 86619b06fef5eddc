"""``python -m ros1_master_guard``."""

import sys

from ros1_master_guard.command import main

sys.exit(main())
