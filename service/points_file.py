"""Points file: attitudes over time from a CSV file, for a reference."""

from __future__ import annotations

import csv
from math import isfinite
from pathlib import Path

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import MAX_POINTS, Points


class PointsError(AeroloopError):
    """The file cannot be read, or is no table of points; one line with the path and the file's line."""


def read_points(path: Path) -> Points:
    """Attitudes over time from a CSV file: columns time [s], roll, pitch, yaw [deg], with or without a heading.

    Raises:
        PointsError: It cannot be read, or is no such table; names the line.
    """
    table: list[tuple[float, float, float, float]] = []
    line = 0
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file)
            try:
                for i, row in enumerate(rows):
                    line = rows.line_num
                    if row and (i > 0 or _is_number(row[0])):  # the first row may be a heading
                        table.append(_point(row, table[-1][0] if table else None))
            except csv.Error as error:
                raise PointsError(f"{path}, line {line + 1}: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise PointsError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'it is not text'}") from None
    except ValueError as error:
        raise PointsError(f"{path}, line {line}: {error}") from None
    if not 2 <= len(table) <= MAX_POINTS:
        raise PointsError(f"{path} has {len(table)} points, and a reference 2 to {MAX_POINTS}")
    return Points(times=[time for time, *_ in table], attitudes=[each[1:] for each in table])


def _point(row: list[str], before: float | None) -> tuple[float, float, float, float]:
    """Time [s], roll, pitch and yaw [deg] of a row; `before` is the time of the row before. Raises ValueError."""
    if len(row) != 4 or not all(map(_is_number, row)):
        raise ValueError(f"expected four numbers (time [s], roll, pitch, yaw [deg]), not {','.join(row)!r}")
    time_s, roll, pitch, yaw = map(float, row)
    if not all(map(isfinite, (time_s, roll, pitch, yaw))):
        raise ValueError(f"every number must be finite, not {','.join(row)!r}")
    if before is None and time_s != 0:
        raise ValueError(f"the first time must be 0, not {row[0]}")
    if before is not None and time_s <= before:
        raise ValueError(f"times must rise, and {row[0]} does not after {before:g}")
    return time_s, roll, pitch, yaw


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
