"""Settings of the controller daemon and of the recorder, and a reference from a file.

Light to import, because every command reads them.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Points
from aeroloop.protocol.wording import problems


class ControllerSettings(BaseModel, extra="forbid"):
    """Settings of the controller daemon."""

    stale_s: float = Field(
        default=0.1, gt=0, le=10, description="stop commanding after this long without a measurement [s]"
    )
    duration_s: float | None = Field(default=None, gt=0, description="end after this much of the law's time [s]")
    auto_arm: bool = Field(
        default=False, description="arm the plant with every claim, instead of waiting for an operator's `op arm`"
    )
    max_reference_rate: float = Field(
        default=1.0, gt=0, le=100, description="largest angular velocity of an operator's reference [rad/s]"
    )
    max_reference_tilt_deg: float = Field(
        default=60.0, gt=0, le=180, description="largest tilt of an operator's reference [deg]"
    )
    after_restart: Literal["hold", "resume", "configured"] = Field(
        default="hold",
        description="what a session begins with. hold: the attitude found, until `op goto` or `op track`; resume: the "
        "gains of the vehicle's last session and, unless an operator stopped it, its reference; configured: those of "
        "the configuration, and after a trip those of the session before",
    )
    require_recorder: bool = Field(default=False, description="do not claim before a recorder is on the network")


class RecorderSettings(BaseModel, extra="forbid"):
    """Settings of the recorder."""

    path: Path = Field(
        default=Path("logs"),
        description="folder of the logs (a name without an ending is one), or the log's first file",
    )
    max_file_mb: float = Field(default=256.0, gt=0, description="begin a new file after this size [MB]")
    keep_gb: float | None = Field(
        default=None,
        gt=0,
        description="remove the recorder's oldest logs when all together are larger than this; none if left out [GB]",
    )


class PointsError(AeroloopError):
    """The file cannot be read, or is no table of points; one line with the path."""


def read_points(path: Path) -> Points:
    """Attitudes over time from a CSV file: columns time [s], roll, pitch, yaw [deg], with or without a heading.

    Raises:
        PointsError: It cannot be read, or is no such table; names the line of a row that is not four numbers.
    """
    table: list[list[float]] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file)
            for i, cells in enumerate(rows):
                if not cells or (i == 0 and _numbers(cells[:1]) is None):  # a heading
                    continue
                numbers = _numbers(cells)
                if numbers is None or len(numbers) != 4:
                    raise PointsError(
                        f"{path}, line {rows.line_num}: expected four numbers (time [s], roll, pitch, yaw [deg]), not "
                        f"{','.join(cells)!r}"
                    )
                table.append(numbers)
    except UnicodeDecodeError:
        raise PointsError(f"cannot read {path}: it is not text") from None
    except (OSError, csv.Error) as error:
        raise PointsError(f"cannot read {path}: {getattr(error, 'strerror', error)}") from None
    try:
        return Points.model_validate({"times": [row[0] for row in table], "attitudes": [row[1:] for row in table]})
    except ValidationError as error:
        raise PointsError(f"{path}: {'; '.join(problems(error, Points))}") from None


def _numbers(cells: list[str]) -> list[float] | None:
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None
