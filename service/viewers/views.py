"""Views: messages in degrees, volts and microseconds, for display.

Every field has its unit in its name; what has no valid value is null. Values are rounded far below a quantizer's step,
so that a log has no meaningless digits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees, sqrt
from typing import Final, Self

from pydantic import BaseModel, Field

from aeroloop.protocol.messages.models import Status, Telemetry
from aeroloop.protocol.wire.attitude import Quaternion, Vector, angle, to_euler
from aeroloop.protocol.wire.spec import MAX_ACTUATORS

ANGLES: Final = "Z–Y–X, body relative to inertial"
NO_MOTOR: Final = "null: no valid value, or no such motor"


class View(BaseModel, frozen=True):
    """A message for display."""

    @classmethod
    def in_order(cls, *values: float | None) -> Self:
        """A message of these values, one for each field."""
        return cls.model_validate(dict(zip(cls.model_fields, values, strict=True)))

    def encode(self) -> bytes:
        """The message as JSON."""
        return self.model_dump_json().encode()


class Attitude(View, frozen=True):
    """Attitude and rates."""

    roll_deg: float | None = Field(description=f"{ANGLES} [deg]")
    pitch_deg: float | None = Field(description=f"{ANGLES} [deg]")
    yaw_deg: float | None = Field(description=f"{ANGLES}, −180…180 [deg]")
    p_deg_s: float | None = Field(description="rate about the body's x axis [deg/s]")
    q_deg_s: float | None = Field(description="rate about the body's y axis [deg/s]")
    r_deg_s: float | None = Field(description="rate about the body's z axis [deg/s]")

    @classmethod
    def of(cls, attitude: Quaternion | None, rate: Vector) -> Self:
        """Of an attitude, None if it is not known, and rates in the body frame [rad/s], NaN if they are not."""
        angles = _degrees(to_euler(attitude)) if attitude else (None, None, None)
        return cls.in_order(*angles, *(_degree(part) if part == part else None for part in rate))


class SetpointView(View, frozen=True):
    """An operator's set-point."""

    roll_deg: float = Field(description=f"{ANGLES} [deg]")
    pitch_deg: float = Field(description=f"{ANGLES} [deg]")
    yaw_deg: float = Field(description=f"{ANGLES} [deg]")

    @classmethod
    def of(cls, attitude: Vector) -> Self:
        """Of roll, pitch and yaw [deg]."""
        return cls.in_order(*attitude)


class Voltages(View, frozen=True):
    """Voltages as commanded, quantized."""

    voltage_1_v: float | None = Field(description=f"u₁; {NO_MOTOR} [V]")
    voltage_2_v: float | None = Field(description=f"u₂; {NO_MOTOR} [V]")
    voltage_3_v: float | None = Field(description=f"u₃; {NO_MOTOR} [V]")
    voltage_4_v: float | None = Field(description=f"u₄; {NO_MOTOR} [V]")
    voltage_5_v: float | None = Field(description=f"u₅; {NO_MOTOR} [V]")
    voltage_6_v: float | None = Field(description=f"u₆; {NO_MOTOR} [V]")
    voltage_7_v: float | None = Field(description=f"u₇; {NO_MOTOR} [V]")
    voltage_8_v: float | None = Field(description=f"u₈; {NO_MOTOR} [V]")
    saturated_1: bool | None = Field(description=f"u₁ is at the quantizer's outermost level; {NO_MOTOR}")
    saturated_2: bool | None = Field(description=f"u₂ is at the quantizer's outermost level; {NO_MOTOR}")
    saturated_3: bool | None = Field(description=f"u₃ is at the quantizer's outermost level; {NO_MOTOR}")
    saturated_4: bool | None = Field(description=f"u₄ is at the quantizer's outermost level; {NO_MOTOR}")
    saturated_5: bool | None = Field(description=f"u₅ is at the quantizer's outermost level; {NO_MOTOR}")
    saturated_6: bool | None = Field(description=f"u₆ is at the quantizer's outermost level; {NO_MOTOR}")
    saturated_7: bool | None = Field(description=f"u₇ is at the quantizer's outermost level; {NO_MOTOR}")
    saturated_8: bool | None = Field(description=f"u₈ is at the quantizer's outermost level; {NO_MOTOR}")

    @classmethod
    def of(cls, codes: Sequence[float], motors: range, level: Callable[[float], float], outermost: float) -> Self:
        """Of a command's codes, their motors' numbers, and the quantizer's levels [V]."""
        levels = dict(zip(motors, map(level, codes), strict=True))
        every = [levels.get(number, float("nan")) for number in range(1, MAX_ACTUATORS + 1)]
        volts = [round(u, 4) if u == u else None for u in every]
        saturated = [abs(u) >= outermost if u == u else None for u in every]
        return cls.in_order(*volts, *saturated)


class Tracking(View, frozen=True):
    """How well the body follows its reference, as the controller saw it at one tick."""

    time_s: float | None = Field(description="on the law's clock; null if its period is not known [s]")
    error_deg: float = Field(description="angle from the desired to the measured attitude, 0…180 [deg]")
    roll_deg: float = Field(description=f"measured; {ANGLES} [deg]")
    pitch_deg: float = Field(description=f"measured; {ANGLES} [deg]")
    yaw_deg: float = Field(description=f"measured; {ANGLES}, −180…180 [deg]")
    desired_roll_deg: float = Field(description=f"{ANGLES} [deg]")
    desired_pitch_deg: float = Field(description=f"{ANGLES} [deg]")
    desired_yaw_deg: float = Field(description=f"{ANGLES}, −180…180 [deg]")
    error_p_deg_s: float = Field(description="ω_e about the body's x axis [deg/s]")
    error_q_deg_s: float = Field(description="ω_e about the body's y axis [deg/s]")
    error_r_deg_s: float = Field(description="ω_e about the body's z axis [deg/s]")
    damping_1: float = Field(description="θ̂₁ [N·m·s/rad]")
    damping_2: float = Field(description="θ̂₂ [N·m·s/rad]")
    damping_3: float = Field(description="θ̂₃ [N·m·s/rad]")
    sign: int = Field(description="the equilibrium approached, z₁₊ or z₁₋")

    @classmethod
    def of(cls, telemetry: Telemetry, period: float | None) -> Self:
        """Of the controller's telemetry, and the law's period [s]. The measured attitude is q = q_d ⊗ e of (C.16)."""
        x, y, z = telemetry.attitude_error
        scalar = sqrt(max(0.0, 1.0 - x * x - y * y - z * z))
        measured = _product(telemetry.desired, (scalar if telemetry.sign >= 0 else -scalar, x, y, z))
        return cls.in_order(
            None if period is None else round(telemetry.tick * period, 6),
            _degree(angle(x, y, z)),
            *_degrees(to_euler(measured)),
            *_degrees(to_euler(telemetry.desired)),
            *_degrees(telemetry.rate_error),
            *(round(theta, 6) for theta in telemetry.damping_estimate),
            telemetry.sign,
        )


class RoleStatus(View, frozen=True):
    """Status of a role. Percentiles are of the last ten seconds."""

    state: str
    cause: str | None = Field(description="plant: why it may not be driven, where that is so")
    session: str | None
    rate_hz: float = Field(description="ticks (recorder: messages) a second since the last status [Hz]")
    skipped: int = Field(description="grid ticks of the session that were missed")
    refused: int = Field(description="malformed frames since start")
    stale: int = Field(description="frames since start that were received too late to be acted upon")
    saturated: int = Field(description="values beyond a quantizer's range since start")
    latency_p50_us: float | None = Field(description="plant: from a measurement to the command that answers it [µs]")
    latency_p99_us: float | None = Field(description="the same, 99th percentile [µs]")
    age_p50_us: float | None = Field(
        description="controller: how much later than the fastest a measurement was received [µs]"
    )
    age_p99_us: float | None = Field(description="the same, 99th percentile [µs]")
    wake_p50_us: float | None = Field(description="from when a tick was due to when it began [µs]")
    wake_p99_us: float | None = Field(description="the same, 99th percentile [µs]")
    uptime_s: float = Field(description="since it joined the network [s]")

    @classmethod
    def of(cls, status: Status) -> Self:
        """Of what a role published."""
        wake = status.timing.recent_wake if status.timing else None
        shown = status.model_dump(include=set(cls.model_fields))
        for name, durations in {"latency": status.recent_latency_us, "age": status.age_us, "wake": wake}.items():
            shown[f"{name}_p50_us"] = durations.p50 if durations else None
            shown[f"{name}_p99_us"] = durations.p99 if durations else None
        return cls(**{**shown, "rate_hz": round(status.rate_hz, 3), "uptime_s": round(status.uptime_s, 1)})


def _degree(radians: float) -> float:
    return round(degrees(radians), 4) + 0.0  # never −0


def _degrees(radians: Vector) -> Vector:
    return _degree(radians[0]), _degree(radians[1]), _degree(radians[2])


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product p ⊗ q."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
