"""Trials in a file: small enough to be committed, so that every number can be computed again.

Parquet keeps each column by itself, and a name that ten thousand rows repeat only once. Floating
point numbers have seven digits there. A study rounds them before it computes anything, so that the
file gives the same results.
"""

from __future__ import annotations

import io
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd

from studies.errors import TrialFileError
from studies.study import Scale

TRIALS_NAME = "trials.parquet"

_ABOUT = b"holdfast"
"""Key of the metadata that name the study."""

_COMPRESSION_LEVEL = 19


class _About(msgspec.Struct, kw_only=True):
    study: str
    scale: Scale
    machine: dict[str, str]


class TrialFile(_About, kw_only=True):
    """The trials of a study and the machine on which they were run."""

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
        raise TrialFileError(f"{path}: is no file of trials of a study: {error}") from error
    trials = table.to_pandas()
    wide = {"category": str, "float32": np.float64, "int32": np.int64}
    kinds = {name: wide.get(str(kind), kind) for name, kind in trials.dtypes.items()}
    return TrialFile(**msgspec.structs.asdict(about), trials=trials.astype(kinds))


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
