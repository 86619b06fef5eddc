"""Trials in a file: small enough to be committed, so that every number can be computed again.

Parquet keeps each column by itself, and a name that ten thousand rows repeat only once. Floating
point numbers have seven digits there. A study rounds them before it computes anything, so that the
file gives the same results.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from holdfast.arrays import IntArray
from holdfast.errors import InvalidValueError
from holdfast.lab.errors import TrialFileError
from holdfast.lab.studies.study import Scale

__all__ = [
    "TRIALS_NAME",
    "TrialFile",
    "cells_of_trials",
    "kept_trials",
    "read_trials",
    "require_cells",
    "rounded",
]

TRIALS_NAME = "trials.parquet"

_ABOUT = b"holdfast"
"""Key of the metadata that name the study."""

_COMPRESSION_LEVEL = 19


class _About(msgspec.Struct, kw_only=True):
    study: str
    scale: Scale
    machine: dict[str, str]


class TrialFile(msgspec.Struct, kw_only=True):
    """The trials of a study and the machine on which they were run."""

    study: str
    scale: Scale
    machine: dict[str, str]
    trials: pd.DataFrame

    def encoded(self) -> bytes:
        """Return the content of the file."""
        import pyarrow as pa
        from pyarrow import parquet

        about = _About(study=self.study, scale=self.scale, machine=self.machine)
        kinds = {name: _kind_of(self.trials[name]) for name in self.trials.columns}
        table = pa.Table.from_pandas(self.trials.astype(kinds), preserve_index=False)
        table = table.replace_schema_metadata({_ABOUT: msgspec.json.encode(about)})
        content = io.BytesIO()
        parquet.write_table(
            table, content, compression="zstd", compression_level=_COMPRESSION_LEVEL
        )
        return content.getvalue()


def read_trials(path: Path) -> TrialFile:
    """Return the content of a file of trials; TrialFileError if it holds something else."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with path.open("rb") as file:
            table = parquet.ParquetFile(file).read()
        about = msgspec.json.decode(dict(table.schema.metadata or {})[_ABOUT], type=_About)
    except OSError as error:
        raise TrialFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (pa.ArrowException, KeyError, msgspec.DecodeError) as error:
        raise TrialFileError(f"{path}: is no file of trials of an experiment: {error}") from error
    trials = table.to_pandas()
    wide = {"category": str, "float32": np.float64, "int32": np.int64}
    kinds = {name: wide.get(str(kind), kind) for name, kind in trials.dtypes.items()}
    return TrialFile(
        study=about.study,
        scale=about.scale,
        machine=about.machine,
        trials=trials.astype(kinds),
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


def kept_trials(table: pd.DataFrame, cells: IntArray) -> pd.DataFrame:
    """Return the columns of trials that are kept in a file.

    Times differ from run to run: the median over a cell's trials stands for all of them.

    Parameters
    ----------
    cells : array of shape (rows,)
        The number of each trial's cell.
    """
    times = table["mean_sensing_ms"].where(table["sensing_decisions"] > 0)
    return table[list(_KEPT)].assign(
        reward=rounded(table["reward"]),
        steps_to_goal=table["steps_to_goal"].astype(np.float64),
        median_sensing_ms=rounded(times.groupby(cells).transform("median")),
    )


def cells_of_trials(trials: pd.DataFrame, names: Sequence[str]) -> dict[Any, pd.DataFrame]:
    """Return the trials of each cell, by the cell's values in the columns ``names``."""
    missing = [name for name in (*names, *_KEPT) if name not in trials.columns]
    if missing:
        raise InvalidValueError(f"trials without the columns {', '.join(missing)}")
    cells = trials.groupby(list(names), sort=False)
    return {key: table.drop(columns=list(names)).reset_index(drop=True) for key, table in cells}


def require_cells(
    study: str, cells: Mapping[Any, pd.DataFrame], expected: Collection[tuple[Any, ...]]
) -> None:
    """Make sure that there are trials of all cells that a study compares, and of no others."""
    for each in expected:
        if each not in cells:
            raise InvalidValueError(f"{study}: there are no trials of {', '.join(map(str, each))}")
    for each in cells:
        if each not in expected:
            raise InvalidValueError(f"{study}: knows nothing of {', '.join(map(str, each))}")


def rounded(numbers: pd.Series) -> pd.Series:
    """Return numbers as a file keeps them."""
    return numbers.astype(np.float32).astype(np.float64)


def _kind_of(column: pd.Series) -> str:
    """Return the smallest type that keeps a column."""
    if pd.api.types.is_bool_dtype(column):
        return "bool"
    if pd.api.types.is_integer_dtype(column):
        return "int64" if len(column) and column.abs().max() >= 2**31 else "int32"
    return "float32" if pd.api.types.is_float_dtype(column) else "category"
