"""Settings of the controller daemon and of the recorder. Light to import, because every command reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field


class ControllerSettings(BaseModel, extra="forbid"):
    """Settings of the controller daemon."""

    stale_s: float = Field(
        default=0.1, gt=0, le=10, description="stop commanding after this long without a measurement [s]"
    )
    duration_s: float | None = Field(default=None, gt=0, description="end after this much of the law's time [s]")
    auto_arm: bool = Field(
        default=False, description="arm the plant with every claim, instead of waiting for an operator's `op arm`"
    )
    telemetry_rate_hz: float = Field(default=10.0, gt=0, le=10_000, description="publish telemetry this often [Hz]")
    max_reference_rate: float = Field(
        default=1.0, gt=0, le=100, description="largest angular velocity of an operator's reference [rad/s]"
    )
    max_reference_braking: float = Field(
        default=1.0,  # the Aero's motors turn it by 2.4 rad/s² in pitch at 24 V
        ge=0.01,
        le=100,
        description="largest acceleration with which roll, pitch and yaw each brake before an operator's motion and "
        "run up to a reference that moves; from the rate v an axis stops within 0.75 v² / this [rad/s²]",
    )
    max_reference_tilt_deg: float = Field(
        default=60.0, gt=0, le=180, description="largest tilt of an operator's reference [deg]"
    )
    start_within_deg: float = Field(
        default=20.0,
        ge=0,
        le=360,
        description="a session that begins further than this from its reference first approaches it smoothly [deg]",
    )
    after_restart: Literal["hold", "resume", "configured"] = Field(
        default="hold",
        description="what a session begins with. hold: the attitude found, until `op goto` or `op track`; resume: the "
        "gains of the vehicle's last session and, unless an operator stopped it, its reference; configured: those of "
        "the configuration, and after a trip those of the session before",
    )
    law_timeout_s: float = Field(
        default=0.1,
        gt=0,
        le=10,
        description="stop commanding, as faulted, after a tick of the law that takes longer; not in lockstep [s]",
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
