"""Points file: attitudes over time from a CSV file, for a reference."""

from __future__ import annotations

import csv
from math import isfinite
from pathlib import Path

from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import MAX_POINTS, Points
from aeroloop.protocol.wording import problems


class PointsError(AeroloopError):
    """The file cannot be read, or is no table of points; one line with the path and the file's line."""


def read_points(path: Path) -> Points:
    """Attitudes over time from a CSV file: columns time [s], roll, pitch, yaw [deg], with or without a heading.

    Raises:
        PointsError: It cannot be read, or is no such table; names the line.
    """
    times: list[float] = []
    attitudes: list[tuple[float, float, float]] = []
    number = 1  # of the line
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows, first = csv.reader(file), True
            while True:
                number = rows.line_num + 1  # of the next row, should it be unreadable
                if (row := next(rows, None)) is None:
                    break
                number, heading = rows.line_num, first and bool(row) and not _is_number(row[0])
                first = False
                if not row or heading:
                    continue
                if (problem := _problem(row, times)) is not None:
                    raise PointsError(f"{path}, line {number}: {problem}")
                time_s, roll, pitch, yaw = (float(cell) for cell in row)
                times.append(time_s)
                attitudes.append((roll, pitch, yaw))
        if not 2 <= len(times) <= MAX_POINTS:
            raise PointsError(f"{path} has {len(times)} points, and a reference 2 to {MAX_POINTS}")
        return Points(times=times, attitudes=attitudes)
    except csv.Error as error:
        raise PointsError(f"{path}, line {number}: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise PointsError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'it is not text'}") from None
    except ValidationError as error:
        raise PointsError(f"{path}: {next(problems(error, Points))}") from None


def _problem(row: list[str], times: list[float]) -> str | None:
    """The error in a row of a table of points, if there is one."""
    if len(row) != 4 or not all(_is_number(cell) for cell in row):
        return f"expected four numbers (time [s], roll, pitch, yaw [deg]), not {','.join(row)!r}"
    values = [float(cell) for cell in row]
    if not all(isfinite(value) for value in values):
        return f"every number must be finite, not {','.join(row)!r}"
    if not times and values[0] != 0:
        return f"the first time must be 0, not {row[0]}"
    if times and values[0] <= times[-1]:
        return f"times must rise, and {row[0]} does not after {times[-1]:g}"
    return None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
