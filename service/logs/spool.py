"""Rows put aside on disk while a log is read: packed as they come, read again in blocks of numpy.

Which session of a log is the longest is known only at its end, and what belongs to a row is logged before or after it.
So each kind of row is first laid on a pile of its own. All piles of a spool share one unnamed temporary file, which is
gone however the process ends; in memory there is never more than a block of each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt

BLOCK_ROWS: Final = 65_536

Records = npt.NDArray[np.void]
"""Rows with named fields."""


class Spool:
    """The file of some piles.

    Args:
        folder: Where the file is; it takes as much room as what is put aside.

    Raises:
        OSError: No file can be made there.
    """

    def __init__(self, folder: Path) -> None:
        self._file: IO[bytes] = TemporaryFile(dir=folder)  # noqa: SIM115  # closed by __exit__

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    def pile(self, fields: Sequence[tuple[str, int]]) -> Pile:
        """An empty pile.

        Args:
            fields: Name and number of doubles of each field; 0 stands for one integer of 64 bits.
        """
        return Pile(self._file, fields)


class Pile:
    """Rows of one kind, in the order in which they came.

    Attributes:
        rows: How many.
    """

    def __init__(self, file: IO[bytes], fields: Sequence[tuple[str, int]]) -> None:
        self._file = file
        self.dtype = np.dtype([(name, "<f8", (n,)) if n else (name, "<i8") for name, n in fields])
        self._pack = struct.Struct("<" + "".join(f"{n}d" if n else "q" for _, n in fields)).pack
        self._open = bytearray()
        self._full = BLOCK_ROWS * self.dtype.itemsize
        self._blocks: list[tuple[int, int]] = []  # offset and size in the file
        self.rows = 0

    def add(self, *values: Any) -> None:
        """Put one row on top: all its numbers, one after another. Raises OSError if the disk is full."""
        self._open += self._pack(*values)
        self.rows += 1
        if len(self._open) >= self._full:
            self._blocks.append((self._file.seek(0, 2), len(self._open)))
            self._file.write(self._open)
            self._open.clear()

    def blocks(self) -> Iterator[Records]:
        """All rows, from the first, a block at a time."""
        for offset, size in self._blocks:
            self._file.seek(offset)
            yield np.frombuffer(self._file.read(size), self.dtype)
        if self._open:
            yield np.frombuffer(bytes(self._open), self.dtype)


class Window:
    """The part of a pile that is looked into now; it only ever moves on.

    Args:
        pile: Its rows ascend in `field`.
        field: What is looked for, an integer.
    """

    def __init__(self, pile: Pile, field: str) -> None:
        self._field = field
        self._blocks = pile.blocks()
        self._rows: Records = np.empty(0, pile.dtype)

    def not_after(self, values: npt.NDArray[np.int64]) -> tuple[Records, npt.NDArray[np.bool_]]:
        """For each value, the last row whose field is not greater, and whether there is one.

        Args:
            values: They ascend, from one call to the next as well. Shape (n,), n > 0.

        Returns:
            Rows, of which those that are not there mean nothing, and a mask. Shape (n,) each.
        """
        self._rows = self._rows[max(0, self._places(values[:1])[0]) :]
        while not len(self._rows) or self._rows[self._field][-1] <= values[-1]:
            block = next(self._blocks, None)
            if block is None:
                break
            self._rows = np.concatenate((self._rows, block))
            self._rows = self._rows[max(0, self._places(values[:1])[0]) :]
        places = self._places(values)
        found = places >= 0
        if not len(self._rows):
            return np.zeros(len(values), self._rows.dtype), found
        return self._rows[np.maximum(places, 0)], found

    def _places(self, values: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
        return np.searchsorted(self._rows[self._field], values, side="right") - 1
