"""``python -m studies``, in a clone of the repository."""

from __future__ import annotations

from holdfast.cli import main
from studies.command import main as run_studies

if __name__ == "__main__":
    main(run_studies)
