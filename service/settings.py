"""Settings of the controller daemon and of the recorder, and a reference from a file.

Light to import, because every command reads them.
"""

from __future__ import annotations

import csv
from contextlib import suppress
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field, ValidationError

from aeroloop.protocol.errors import ConfigError
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


def read_points(path: Path) -> Points:
    """Attitudes over time from a CSV file: columns time [s], roll, pitch, yaw [deg], with or without a heading.

    Raises:
        ConfigError: It cannot be read, or is no such table.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'it is not text'}") from None
    heading = 1
    with suppress(ValueError, IndexError):
        float(rows[0][0])
        heading = 0
    table = rows[heading:]
    try:
        return Points.model_validate({"times": [row[0] for row in table], "attitudes": [row[1:] for row in table]})
    except ValidationError as error:
        columns = "time [s], roll, pitch, yaw [deg]"
        raise ConfigError(f"{path}, a table of {columns}: {'; '.join(problems(error, Points))}") from None
