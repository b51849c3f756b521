"""Table files: Parquet, CSV and MATLAB.

All have the same columns by the same names. Parquet has each column's unit and description in its field's metadata,
and the configuration in the file's; a MATLAB file has them in the fields `units`, `descriptions` and `config` of its
struct; CSV has a header row only, and 1 and 0 for booleans. Parquet and CSV are written batch by batch; scipy needs all
of a MATLAB file in memory.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.logs.table import Array, Column, Group, Kind, Rows

MAT_LIMIT: Final = 2**31 - 1
"""Bytes that a variable of a MATLAB v5 file may have."""

MAT_NAME: Final = 63
"""Characters that a field of a MATLAB struct may have."""


class ExportError(AeroloopError):
    """A log cannot be exported; one line with the reason."""


class TableFile(Protocol):
    """Writer of a table's rows, batch by batch."""

    def write(self, rows: Rows) -> None:
        """Append rows. Raises OSError."""

    def close(self) -> None:
        """Write the end. Raises OSError, or ExportError if the format cannot hold that much."""


class ArrowFile:
    """Parquet or CSV by Arrow; a batch is a row group of a Parquet file.

    CSV is as of RFC 4180. A number has enough digits to be read back exactly; a missing one is empty. Its booleans are
    numbers: a reader that guesses types takes `true` beside an empty cell for text.
    """

    def __init__(self, path: Path, groups: Sequence[Group], facts: dict[str, Any], *, csv: bool = False) -> None:
        self._groups = groups
        self._booleans: Kind = "int8" if csv else "bool"
        columns = [column for group in groups for column in group.columns]
        fields = [
            pa.field(c.name, self._type(c), metadata={"unit": c.unit, "description": c.description}) for c in columns
        ]
        self._schema = pa.schema(fields, {f"aeroloop.{name}": json.dumps(fact) for name, fact in facts.items()})
        if csv:
            options = pyarrow.csv.WriteOptions(eol="\r\n", quoting_header="none")
            self._writer: Any = pyarrow.csv.CSVWriter(path, self._schema, write_options=options)
        else:  # a dictionary of doubles makes the file a third larger and its writing slower, quantized or not
            texts = [field.name for field in fields if field.type == pa.string()]
            self._writer = pyarrow.parquet.ParquetWriter(path, self._schema, compression="zstd", use_dictionary=texts)

    def _type(self, column: Column) -> pa.DataType:
        return pa.type_for_alias(self._booleans if column.kind == "bool" else column.kind)

    def write(self, rows: Rows) -> None:
        """See `TableFile.write`."""
        arrays = []
        for group in self._groups:
            # A row per column: Arrow copies values unless they are contiguous.
            matrix = np.ascontiguousarray(group.of(rows).T)
            missing = np.isnan(matrix) if matrix.dtype == np.float64 else None
            for i, column in enumerate(group.columns):
                values, gaps = matrix[i], None if missing is None or not missing[i].any() else missing[i]
                if column.kind in ("bool", "int8"):
                    values = (values if gaps is None else np.where(gaps, 0, values)).astype(column.kind)
                arrays.append(pa.array(values, self._type(column), mask=gaps))
        self._writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        """See `TableFile.close`."""
        self._writer.close()


class MatFile:
    """A struct `aeroloop`; each column is a column vector of doubles in it, with NaN for missing values.

    `published_ns` is int64, as a double does not hold it. `vehicle` and `session` are numbers, from 1, into the lists
    `vehicles` and `sessions`.
    """

    def __init__(self, path: Path, groups: Sequence[Group], facts: dict[str, Any]) -> None:
        self._columns = [column for group in groups for column in group.columns]
        assert all(len(column.name) <= MAT_NAME for column in self._columns)
        self._path = path
        self._groups = groups
        self._facts = facts
        self._batches: dict[str, list[Array]] = {column.name: [] for column in self._columns}
        self._names: dict[str, dict[str, int]] = {c.name: {} for c in self._columns if c.kind == "string"}
        self._bytes = 0

    def write(self, rows: Rows) -> None:
        """See `TableFile.write`."""
        for group in self._groups:
            matrix = group.of(rows)
            for i, column in enumerate(group.columns):
                values = matrix[:, i]
                if column.kind == "string":
                    names = self._names[column.name]
                    values = np.array([names.setdefault(text, len(names) + 1) for text in values])
                values = values.astype(np.int64 if column.name == "published_ns" else np.float64)
                self._batches[column.name].append(values)
                self._bytes += values.nbytes

    def close(self) -> None:
        """See `TableFile.close`."""
        import scipy.io  # slow to import, and needed here only

        if self._bytes > MAT_LIMIT:
            raise ExportError(
                f"a MATLAB file holds 2 GiB, and these rows take {self._bytes / 2**30:.1f} GiB; use --to parquet, "
                "which MATLAB reads by parquetread"
            )
        struct: dict[str, Any] = {name: np.concatenate(batches) for name, batches in self._batches.items()}
        struct |= {f"{name}s": np.array(list(names), dtype=object) for name, names in self._names.items()}
        struct["units"] = {column.name: column.unit for column in self._columns}
        struct["descriptions"] = {column.name: column.description for column in self._columns}
        struct |= {name: json.dumps(fact) for name, fact in self._facts.items() if name not in struct}
        with self._path.open("wb") as file:
            scipy.io.savemat(file, {"aeroloop": struct}, long_field_names=True, oned_as="column")


FILES: Final[dict[str, Callable[[Path, Sequence[Group], dict[str, Any]], TableFile]]] = {
    "parquet": ArrowFile, "csv": partial(ArrowFile, csv=True), "mat": MatFile
}  # fmt: skip
"""Opens a file by its path, columns, and facts to write as JSON; replaces an existing one, and raises OSError."""
