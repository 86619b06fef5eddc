"""Trials in a file: small enough to be committed, so that every number can be computed anew.

Parquet keeps each column by itself, and a name that ten thousand rows repeat once. Numbers with a
fraction have seven digits there; so a study rounds them before it computes anything from them, and
what it computes from the file is the same.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.experiments.study import Scale
from holdfast.experiments.tables import Cell, Table

__all__ = [
    "TRIALS_NAME",
    "TrialFile",
    "TrialFileError",
    "cells_of_trials",
    "kept_trials",
    "read_trials",
    "require_cells",
]

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
        with path.open("rb") as file:
            table = pyarrow.parquet.ParquetFile(file).read()
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


_KEPT = (
    "trial",
    "success",
    "steps",
    "reward",
    "sensing_decisions",
    "step_limit",
    "steps_to_goal",
)


def kept_trials(table: Table) -> Table:
    """Return what a file keeps of the trials of one cell.

    Times differ from run to run: their median over the trials stands for all of them.
    """
    columns = {name: list(table.columns[name]) for name in _KEPT}
    columns["reward"] = _rounded(columns["reward"])
    times = table.numbers("mean_sensing_ms")[table.numbers("sensing_decisions") > 0.0]
    median = float(np.median(times)) if times.size else None
    return Table({**columns, "median_sensing_ms": _rounded([median]) * table.num_rows})


def cells_of_trials(trials: Table, names: Sequence[str]) -> dict[tuple[Any, ...], Table]:
    """Return the trials by what they are trials of.

    Parameters
    ----------
    trials : Table
    names : sequence of str
        Columns whose cells tell it.

    Raises
    ------
    InvalidValueError
        If a column is missing.
    """
    missing = [name for name in (*names, *_KEPT) if name not in trials.columns]
    if missing:
        raise InvalidValueError(f"trials without the columns {', '.join(missing)}")
    rows: dict[tuple[Any, ...], list[int]] = {}
    keys = zip(*(trials.columns[name] for name in names), strict=True)
    for number, key in enumerate(keys):
        rows.setdefault(key, []).append(number)
    own = {name: cells for name, cells in trials.columns.items() if name not in names}
    return {
        key: Table({name: [cells[number] for number in numbers] for name, cells in own.items()})
        for key, numbers in rows.items()
    }


def require_cells(
    study: str, cells: Mapping[tuple[Any, ...], Table], expected: Collection[tuple[Any, ...]]
) -> None:
    """Make sure that there are trials of what a study compares, and of nothing else.

    Raises
    ------
    InvalidValueError
        If a cell is missing or unknown.
    """
    for each in expected:
        if each not in cells:
            raise InvalidValueError(f"{study}: there are no trials of {', '.join(map(str, each))}")
    for each in cells:
        if each not in expected:
            raise InvalidValueError(f"{study}: knows nothing of {', '.join(map(str, each))}")


def _rounded(cells: Sequence[Cell]) -> list[Cell]:
    """Return numbers as a file keeps them."""
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
