"""A process that writes a journal and says, after each thing that it was told is kept, which.

It is run by ``test_journal_disk_errors``, which lets the system fail under it.
"""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.unit.test_journal import records_of, result_of

from holdfast.errors import OutputError
from holdfast.journal.journal import Journal


def main(path: Path, says: int) -> None:
    """Write two trials of three steps, and two steps of a third."""

    def kept(what: str) -> None:
        os.write(says, f"{what}\n".encode())

    try:
        with Journal.create(path, {"configuration": "x" * 100}) as journal:
            kept(f"epoch {journal.raise_epoch()}")
            for trial in range(3):
                for step in range(3 if trial < 2 else 2):
                    journal.append(trial, records_of(step))
                    kept(f"step {trial} {step}")
                if trial < 2:
                    journal.add(result_of(trial))
                    kept(f"trial {trial}")
    except OutputError as error:
        kept(f"error {error}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.stdout.fileno())
