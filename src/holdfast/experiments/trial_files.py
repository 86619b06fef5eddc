"""Trials in a file: small enough to be committed, so that every number can be computed anew.

Parquet keeps each column by itself, and a name that ten thousand rows repeat once. Numbers with a
fraction have seven digits there; so a study rounds them (:func:`rounded`) before it computes
anything from them, and what it computes from the file is the same.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from holdfast.errors import HoldfastError
from holdfast.experiments.study import Scale
from holdfast.experiments.tables import Cell, Table

__all__ = ["TRIALS_NAME", "TrialFile", "TrialFileError", "read_trials", "rounded"]

TRIALS_NAME = "trials.parquet"

_ABOUT = b"holdfast"
"""Key of the metadata that say of which run a file is."""

_COMPRESSION_LEVEL = 19


class TrialFileError(HoldfastError):
    """A file of trials cannot be read, or is of something else."""


class _About(msgspec.Struct, kw_only=True):
    study: str
    scale: Scale
    machine: dict[str, str]


class TrialFile(msgspec.Struct, kw_only=True):
    """The trials of a study, and where they come from.

    Attributes
    ----------
    study : str
        Its name.
    scale : Scale
    machine : dict of str to str
        On which they were run.
    trials : Table
    """

    study: str
    scale: Scale
    machine: dict[str, str]
    trials: Table

    def encoded(self) -> bytes:
        """Return the content of the file.

        Raises
        ------
        TrialFileError
            If pyarrow is missing.
        """
        pyarrow = _pyarrow()
        arrays = {name: _array(cells) for name, cells in self.trials.columns.items()}
        about = _About(study=self.study, scale=self.scale, machine=self.machine)
        table = pyarrow.table(arrays).replace_schema_metadata({_ABOUT: msgspec.json.encode(about)})
        content = io.BytesIO()
        pyarrow.parquet.write_table(
            table, content, compression="zstd", compression_level=_COMPRESSION_LEVEL
        )
        return content.getvalue()


def read_trials(path: Path) -> TrialFile:
    """Return the content of a file of trials.

    Raises
    ------
    TrialFileError
        If it cannot be read or is none, or pyarrow is missing.
    """
    pyarrow = _pyarrow()
    try:
        table = pyarrow.parquet.ParquetFile(path).read()
        about = msgspec.json.decode(dict(table.schema.metadata or {})[_ABOUT], type=_About)
    except OSError as error:
        raise TrialFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (pyarrow.ArrowException, KeyError, msgspec.DecodeError) as error:
        raise TrialFileError(f"{path}: is no file of trials of an experiment: {error}") from error
    return TrialFile(
        study=about.study,
        scale=about.scale,
        machine=about.machine,
        trials=Table({name: table[name].to_pylist() for name in table.column_names}),
    )


def rounded(cells: Sequence[Cell]) -> list[Cell]:
    """Return numbers as a file keeps them: with seven digits."""
    return [None if cell is None else float(np.float32(cell)) for cell in cells]


def _array(cells: Sequence[Cell]) -> object:
    import pyarrow as pa

    kinds = {type(cell) for cell in cells if cell is not None}
    if kinds == {str}:
        return pa.array(cells, pa.string()).dictionary_encode()
    if kinds == {bool}:
        return pa.array(cells, pa.bool_())
    if kinds <= {int}:
        most = max((abs(int(cell)) for cell in cells if cell is not None), default=0)
        return pa.array(cells, pa.int64() if most >= 2**31 else pa.int32())
    return pa.array(cells, pa.float32())


def _pyarrow() -> Any:
    try:
        import pyarrow as pa
        import pyarrow.parquet
    except ImportError as error:
        raise TrialFileError(
            "files of trials need pyarrow, not installed here: pip install pyarrow"
        ) from error
    return pa
