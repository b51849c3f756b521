"""Plant endpoint, sans-I/O: measures into frames, actuates from frames, watchdog and limits.

It uses no socket and no clock; time is the tick index. Once a tick its owner passes in the newest command frame and
sends the measurement frame that it returns. A command acts from the start of the period in which it was received until
another replaces it. Without a fresh command the watchdog trips: the session ends, and the motors stay at 0 V until the
plant is armed and claimed.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import acos, cos, degrees, hypot, isfinite, radians

from pydantic import BaseModel, Field

from aeroloop.plant_emulator.endpoint.vehicle_claim import VehicleClaim
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.wire.attitude import sent_vector
from aeroloop.protocol.wire.spec import WATCHDOG_S, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Sender


class Endpoint(VehicleClaim):
    """One plant, one controller at a time. At its `limits`, if there are any, it trips, too.

    Raises:
        ValueError: The wire commands another number of actuators than the plant has.

    Attributes:
        accepted: Commands applied so far.
    """

    def __init__(
        self,
        plant: Plant,
        wire: WireSpec,
        period_ns: int,
        *,
        lockstep: bool = False,
        watchdog_s: float = WATCHDOG_S,
        limits: LimitMonitor | None = None,
        armed: bool = False,
    ) -> None:
        if plant.actuators != wire.actuators:
            raise ValueError(f"wire.actuators is {wire.actuators}, but the plant has {plant.actuators} actuators")
        super().__init__(wire, period_ns, lockstep=lockstep, watchdog_s=watchdog_s, armed=armed)
        self.plant = plant
        self.accepted = 0
        self._limits = limits
        self._quantizers = [signal.quantizer() for signal in (wire.attitude, wire.rate) for _ in range(3)]
        self._no_measurement = [quantizer.invalid for quantizer in self._quantizers]
        heartbeat = wire.transmit.heartbeat_ticks(period_ns, self._counters)
        self._sender = Sender(wire.transmit.measurement, heartbeat, self._counters)
        # On change and without lockstep, a controller learns that values are valid again only from the next frame that
        # it receives in time, a heartbeat later at most: until then its commands may still have no valid value.
        clocked = wire.transmit.measurement == "on_change" and not lockstep
        self._forgiven = heartbeat if clocked else 0
        self._measured = False  # whether the session has a measurement
        self._invalid = [False] * self._counters  # whether the last measurement of each counter had no valid value

    @property
    def saturated(self) -> int:
        """Measured values beyond their quantizer's range so far."""
        return sum(quantizer.saturated for quantizer in self._quantizers)

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Apply the newest command, advance the plant to tick k, and measure.

        Args:
            frame: The newest command frame received since the last tick, or None; in lockstep UNCHANGED if the command
                has not changed.
            k: Tick index, from 0, rising. If it skips, the plant advances by all skipped periods. The first call
                ignores the frame: nothing was measured before it.

        Returns:
            The measurement frame; UNCHANGED if it would repeat the last one; None without a session.
        """
        self.outcome = Outcome.NONE
        if self.ticked < 0:
            self.ticked = 0
        elif frame is not None and self.session is not None:
            self.outcome = self._command(frame, self._now_ns)
            self.accepted += self.outcome is Outcome.ACTED
        while self.ticked < k:
            if (reason := self._freshness.overdue(self._now_ns)) is not None:
                self._trip(TripCause.COMMAND_TIMEOUT, reason)
            self.plant.actuate(self.voltages)
            self.plant.advance()
            self.ticked += 1
        if self.session is None:
            return None
        if not self._measured:  # the first measurement has counter 0, whichever tick it is
            self._measured = True
            self._start = self.ticked
            self._freshness.measured(self._now_ns)
        seen = self.plant.measure()
        if self._limits is not None and (trip := self._limits.check(seen, self.voltages)) is not None:
            self._trip(*trip)
            self.plant.actuate(self.voltages)
            return None
        codes = self._encoded(seen)
        self._invalid[self.counter] = codes is self._no_measurement
        return self.wire.measurement.pack(self.counter, codes) if self._sender.due(k, codes) else UNCHANGED

    @property
    def _now_ns(self) -> int:
        return self.ticked * self.period_ns

    def _encoded(self, seen: Measurement) -> list[float]:
        values = (*sent_vector(seen.attitude), *seen.rate)
        if not isfinite(sum(seen.attitude) + sum(seen.rate)):
            return self._no_measurement
        return [quantizer.encode(value) for quantizer, value in zip(self._quantizers, values, strict=True)]

    def _may_be_invalid(self, echo: int) -> bool:
        """An invalid command is the right answer to an invalid measurement; the limits bound how long that lasts."""
        return any(self._invalid[(echo - ago) % self._counters] for ago in range(self._forgiven + 1))

    def _begin(self) -> None:
        super()._begin()
        if self._limits is not None:
            self._limits.reset()
        for quantizer in self._quantizers:
            quantizer.reset()
        self._invalid = [False] * self._counters
        self._measured = False
        self._sender.forget()


# ── limits ──


class LimitSettings(BaseModel, extra="forbid"):
    """Limits; beyond any of them the plant trips."""

    max_tilt_deg: float = Field(
        default=75.0, gt=0, le=180, description="largest angle between the body's z axis and the vertical [deg]"
    )
    max_rate: float = Field(default=20.0, gt=0, description="largest angular velocity [rad/s]")
    max_saturated_s: float = Field(
        default=3.0, gt=0, le=600, description="longest time a motor may stay at its voltage limit [s]"
    )
    max_invalid_s: float = Field(
        default=0.1, gt=0, le=60, description="longest time the sensors may have no valid value [s]"
    )


class LimitMonitor:
    """Checks one plant against its limits once a tick, by its own sensors; durations are counted in ticks.

    At `voltage_limit` [V] a motor counts as saturated.
    """

    def __init__(self, settings: LimitSettings, period_ns: int, voltage_limit: float) -> None:
        self._settings = settings
        self._period_ns = period_ns
        self._full = voltage_limit
        self._least_upright = cos(radians(settings.max_tilt_deg))
        self.reset()

    def reset(self) -> None:
        """Reset the counts for a new session."""
        self._saturated = self._invalid = 0

    def check(self, seen: Measurement, voltages: Sequence[float]) -> tuple[TripCause, str] | None:
        """Cause and reason to trip at a measurement and commanded voltages [V], (actuators,); None for neither."""
        limits = self._settings
        (w, x, y, z), (wx, wy, wz) = seen
        if not isfinite(w + x + y + z + wx + wy + wz):
            self._invalid += 1
            if (invalid_s := self._invalid * self._period_ns * 1e-9) > limits.max_invalid_s:
                return TripCause.SENSORS, f"the sensors have had no valid value for {invalid_s * 1e3:.0f} ms"
            return None
        self._invalid = 0
        upright = 1 - 2 * (x * x + y * y)  # cosine of the tilt
        if upright < self._least_upright:
            tilt = degrees(acos(max(-1.0, upright)))
            reason = f"tilted by {tilt:.1f}°, more than limits.max_tilt_deg = {limits.max_tilt_deg:g}°"
            return TripCause.ENVELOPE, reason
        if (speed := hypot(wx, wy, wz)) > limits.max_rate:
            reason = f"turns at {speed:.2f} rad/s, more than limits.max_rate = {limits.max_rate:g} rad/s"
            return TripCause.ENVELOPE, reason
        self._saturated = self._saturated + 1 if max(map(abs, voltages)) >= self._full else 0
        if (saturated_s := self._saturated * self._period_ns * 1e-9) > limits.max_saturated_s:
            return TripCause.SATURATION, f"a motor has been at its voltage limit for {saturated_s:.1f} s"
        return None
