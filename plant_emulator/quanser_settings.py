"""Settings of Quanser's board: card, channels, signs and scales."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, TypeAlias

from pydantic import BaseModel, Field, field_validator

Sign: TypeAlias = Literal[-1, 1]

CardType: TypeAlias = Literal["quanser_aero2_usb", "quanser_aero_usb"]

PITCH_COUNTS: Final[Mapping[str, int]] = {"quanser_aero2_usb": 2880, "quanser_aero_usb": 2048}


class QuanserSettings(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """The board, and how its channels map to the body. Verify the signs and the gyro's axes on the bench."""

    card_type: CardType = Field(default="quanser_aero2_usb", description="Aero 2 or Aero, by its HIL name")
    card_identifier: str = Field(
        default="0", min_length=1, description="which board; a virtual one is '0@tcpip://localhost:18950'"
    )
    rate: Literal["derivative", "gyro"] = Field(
        default="derivative", description="derivative: of the encoders' angles, filtered"
    )
    pitch_counts: int | None = Field(
        default=None, gt=0, description="pitch encoder's counts a turn; if left out, the card type's (2880, 2048)"
    )
    yaw_counts: int = Field(default=4096, gt=0, description="yaw encoder's counts a turn")
    encoder_signs: tuple[Sign, Sign] = Field(default=(1, 1), description="of pitch and yaw; -1 where counts run down")
    bandwidth: float = Field(default=50.0, gt=0, description="ωn of the derivative's filter [rad/s]")
    damping_ratio: float = Field(default=0.8, gt=0, lt=1, description="ζ of the derivative's filter [1]")
    gyro_axes: tuple[int, int, int] = Field(
        default=(0, 1, 2), description="which of the gyro's channels 0, 1, 2 measures the body's x, y, z"
    )
    gyro_signs: tuple[Sign, Sign, Sign] = Field(default=(1, 1, 1), description="of the body's x, y, z")
    gyro_scale: float = Field(default=1.0, gt=0, description="angular velocity at a gyro reading of 1 [rad/s]")
    motor_channels: tuple[int, int] = Field(default=(0, 1), description="analog outputs of u2 and u3")
    motor_signs: tuple[Sign, Sign] = Field(default=(1, 1), description="of u2 and u3")
    voltage_limit: float = Field(
        default=18.0, gt=0, le=24, description="largest voltage of a motor [V]; 18 recommended, 24 maximum"
    )
    board_watchdog_s: float = Field(
        default=0.1, gt=0, le=10, description="the board's watchdog sets 0 V after this long without a good sample [s]"
    )

    @field_validator("gyro_axes", "motor_channels")
    @classmethod
    def _each_channel_once(cls, channels: tuple[int, ...]) -> tuple[int, ...]:
        if sorted(channels) != list(range(len(channels))):
            raise ValueError(f"must name each of 0…{len(channels) - 1} once")
        return channels

    @property
    def counts(self) -> tuple[int, int]:
        """Encoder counts a turn, pitch and yaw."""
        return self.pitch_counts or PITCH_COUNTS[self.card_type], self.yaw_counts
