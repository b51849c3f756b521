"""The Quanser Aero on its USB board, by way of Quanser's HIL interface, as a plant.

The board samples by a clock of its own and `advance` waits for the next sample, so the board paces the loop. A sample
is this period's or it is NaN: one that could not be read is never replaced by the last. Each good sample reloads the
board's watchdog, which otherwise goes to 0 V and switches the amplifier off by itself; it is not reloaded after a read
or a write that failed, so that a plant which does not do as it is told has 0 V before long. An expired watchdog
is cleared when 0 V are commanded, never under a voltage.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from math import isnan, pi
from typing import Any, Final

import numpy as np

from aeroloop.plant_emulator.hosts.quanser.interface import (
    Board,
    Channels,
    Counts,
    Doubles,
    Hardware,
    Lines,
    QuanserError,
    quanser,
)
from aeroloop.plant_emulator.model.sensors import NO_MEASUREMENT, FilteredDerivative, attitude_of, rate_of
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.plant_emulator.quanser_settings import QuanserSettings
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.attitude import Vector

MOTORS: Final[Channels] = np.array([0, 1], dtype=np.uint32)
"""Analog outputs that carry the motors' voltages, and digital outputs that enable their amplifiers."""
ENCODERS: Final[Channels] = np.array([2, 3], dtype=np.uint32)
"""Pitch and yaw; 0 and 1 are the rotors'."""
GYRO: Final[Channels] = np.array([3000, 3001, 3002], dtype=np.uint32)
LEDS: Final[Channels] = np.array([11000, 11001, 11002], dtype=np.uint32)
"""Red, green, blue; 0…1."""

COLOURS: Final[Mapping[PlantState, tuple[float, float, float]]] = {
    PlantState.IDLE: (0.0, 0.2, 1.0),
    PlantState.GRANTED: (1.0, 0.7, 0.0),
    PlantState.DRIVEN: (0.0, 1.0, 0.0),
    PlantState.TRIPPED: (1.0, 0.0, 0.0),
}
"""Blue, yellow, green, red."""

REST_S: Final = 0.5
"""The amplifier is switched off after 0 V for longer than this [s], if nobody says when it is driven."""

_SAMPLES_IN_BUFFER: Final = 1  # so that what is read is the newest, and the board counts those it overwrote
_FOR_EVER: Final = 2**32 - 1  # samples; what Quanser's own class passes


class QuanserPlant(Plant):
    """The Aero on its board.

    Its encoders are relative: hold it level where yaw shall be 0 while it is made. The board's time begins with the
    first `actuate` or `advance`.

    Each `advance` is one period. If its owner was late, the newest sample is measured and `passed` is the number of
    periods that went by; as many calls less one return at once, for periods that are over, and measure nothing. Who
    raises his tick by `passed` stays in the board's time.

    Args:
        settings: The board and its channels.
        period: Time between samples [s].
        hardware: What stands in for the module `quanser.hardware`; the module itself if None.

    Raises:
        QuanserError: The interface is missing, or the board cannot be opened and made ready.

    Attributes:
        overrun: Samples lost so far because they were not read in time.
        failures: Calls of the interface that failed so far, reads without a sample among them.
        failure: What the last of them said, or None.
        expiries: How often the board's watchdog has expired.
    """

    actuators = 2
    paces = True

    def __init__(self, settings: QuanserSettings, period: float, *, hardware: Hardware | None = None) -> None:
        self._settings, self._period = settings, period
        self._hardware = quanser() if hardware is None else hardware
        self._error = self._hardware.HILError
        self._board: Board = self._hardware.HIL()
        self.overrun = self.failures = self.expiries = 0
        self.failure: str | None = None

        self._steps = [
            sign * 2 * pi / counts for sign, counts in zip(settings.encoder_signs, settings.counts, strict=True)
        ]
        self._filters: list[FilteredDerivative] | None = None
        self._counts: Counts = np.zeros(2, dtype=np.int32)
        self._gyro: Doubles | None = np.zeros(3) if settings.rate == "gyro" else None
        self._measurement = NO_MEASUREMENT

        self._volts: Doubles = np.zeros(2)
        self._no_volts: Doubles = np.zeros(2)
        self._colours = {state: np.array(colour) for state, colour in COLOURS.items()}
        self._state: PlantState | None = None
        self._lit: PlantState | None = None
        self._held: tuple[float, ...] = (0.0, 0.0)
        self._driven: bool | None = None  # None: nobody says
        self._amplified = False
        self._rested = 0  # periods under 0 V
        self._rest = round(REST_S / period)

        self._task: object = None
        self._running = self._closed = self._expired = False
        self._obeyed = True  # since the last sample: every output was written
        self._tells_overflows = True
        self._samples_read = self._index = self._owed = 0  # index: of the last sample, on the board's clock
        self._advanced_ns = 0
        self._open()

    # ── the four methods of a plant ──

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V], clipped to the limit; NaN is 0 V. Shape (2,).

        If nobody calls `enable`, the amplifier is switched on by the first that is not 0, and off after half a second
        of 0 V. After the board's watchdog has expired, only 0 V clear it; until then nothing is written.

        Raises:
            QuanserError: The board cannot be started.
        """
        limit = self._settings.voltage_limit
        self._held = tuple(0.0 if isnan(v) else max(-limit, min(limit, v)) for v in voltages)
        self._start()
        if self._expired and (any(self._held) or not self._clear()):
            return
        self._write_outputs()

    def advance(self) -> None:
        """Wait for the board's next sample; a failed one takes a period, too.

        Raises:
            QuanserError: The board cannot be started.
        """
        if self._owed:
            self._owed -= 1
            self._measurement = NO_MEASUREMENT
            return
        self._start()
        passed = self._read()
        alive = self._keep_alive(reload=passed > 0 and self._obeyed)
        self._obeyed = True
        if passed and alive:
            self._measurement = self._seen(passed)
        else:
            self._measurement, self._filters = NO_MEASUREMENT, None
        if not passed:
            self._wait_out_the_period()
            self._index += 1
        self.passed = max(1, passed)
        self._owed = self.passed - 1
        self.overrun += self._owed
        self._rested = 0 if any(self._held) else self._rested + self.passed
        if self._driven is None and self._amplified and self._rested > self._rest:
            self._amplify(False)
        self._advanced_ns = time.monotonic_ns()

    def measure(self) -> Measurement:
        """What the sensors said at the last sample; NaN if it could not be had."""
        return self._measurement

    def close(self) -> None:
        """0 V, amplifier off, lights off, and the board given back. Every step is tried, whatever fails before it.

        If neither 0 V nor the amplifier's switch could be written, the watchdog is left to do it.
        """
        if self._closed:
            return
        self._closed = True
        board = self._board
        still = self._try(board.write_analog, MOTORS, len(MOTORS), self._no_volts)
        off = self._amplify(False)
        self._try(board.write_other, LEDS, len(LEDS), np.zeros(3))
        if still or off:
            self._try(board.watchdog_stop)
        if self._running:
            self._try(board.task_stop, self._task)
        if self._task is not None:
            self._try(board.task_delete, self._task)
        self._try(board.close)

    # ── what a board has besides ──

    def enable(self, driven: bool) -> None:
        """Say whether the plant is driven: from now on the amplifier is on if it is, and motors have 0 V if not."""
        self._driven = driven
        self._start()
        if not self._expired:
            self._write_outputs()
            if not driven:
                self._amplify(False)

    def show(self, state: PlantState) -> None:
        """Show a state in the colour of the lights. While its watchdog is expired, the board shows red by itself."""
        self._state = state
        if state is not self._lit and not self._expired:
            lit = self._try(self._board.write_other, LEDS, len(LEDS), self._colours[state])
            self._lit = state if lit else None

    # ── starting ──

    def _open(self) -> None:
        card, which = self._settings.card_type, self._settings.card_identifier
        try:
            self._board.open(card, which)
        except self._error as error:
            raise QuanserError(
                f"cannot open {card} '{which}': {_text(error)}; is it plugged in, switched on, and free?"
            ) from error
        try:
            self._prepare()
        except self._error as error:
            self.close()
            raise QuanserError(f"cannot make {card} '{which}' ready: {_text(error)}") from error

    def _prepare(self) -> None:
        board, hardware, n = self._board, self._hardware, len(MOTORS)
        self._unlock()
        board.write_analog(MOTORS, n, self._no_volts)
        board.write_digital(MOTORS, n, np.zeros(n, dtype=np.int8))
        board.watchdog_set_analog_expiration_state(MOTORS, n, self._no_volts)
        board.watchdog_set_digital_expiration_state(MOTORS, n, np.zeros(n, dtype=np.int32))
        with suppress(self._error):  # a light may be wrong, the motors may not
            board.watchdog_set_other_expiration_state(LEDS, len(LEDS), self._colours[PlantState.TRIPPED])
        board.set_encoder_counts(ENCODERS, len(ENCODERS), np.zeros(2, dtype=np.int32))

        gyro = None if self._gyro is None else GYRO
        inputs = None, 0, ENCODERS, len(ENCODERS), None, 0, gyro, 0 if gyro is None else len(gyro)
        board.read(*inputs, None, self._counts, None, self._gyro)
        self._measurement = self._seen(1)
        self._task = board.task_create_reader(_SAMPLES_IN_BUFFER, *inputs)
        modes = hardware.BufferOverflowMode  # a virtual board waits for its reader, as in Quanser's own class
        virtual = "@" in self._settings.card_identifier
        mode = modes.WAIT_ON_OVERFLOW if virtual else modes.OVERWRITE_ON_OVERFLOW
        board.task_set_buffer_overflow_mode(self._task, mode)

    def _start(self) -> None:
        """Arm the watchdog and let the board sample, once."""
        if self._running or self._closed:
            return
        board = self._board
        try:
            board.watchdog_start(self._settings.board_watchdog_s)
            board.task_start(self._task, self._hardware.Clock.HARDWARE_CLOCK_0, 1 / self._period, _FOR_EVER)
        except self._error as error:
            raise QuanserError(f"cannot start {self._settings.card_type}: {_text(error)}") from error
        self._running = True
        self._advanced_ns = time.monotonic_ns()
        try:
            board.task_get_buffer_overflows(self._task)
        except self._error:  # some boards may not count them
            self._tells_overflows = False

    # ── samples ──

    def _read(self) -> int:
        """Wait for the newest sample. Returns the periods that passed, or 0 if there is none."""
        board = self._board
        try:
            read = board.task_read(self._task, 1, None, self._counts, None, self._gyro)
            lost = board.task_get_buffer_overflows(self._task) if self._tells_overflows else 0
        except self._error as error:
            self._failed(_text(error))
            return 0
        if read != 1:
            self._failed("the board's task gave no sample")
            return 0
        self._samples_read += 1
        before, self._index = self._index, self._samples_read + lost
        return max(1, self._index - before)  # a failed read counted as a period, even if its sample came later

    def _seen(self, passed: int) -> Measurement:
        """The measurement of the sample in the buffers, after so many periods."""
        settings = self._settings
        pitch, yaw = (step * count for step, count in zip(self._steps, self._counts.tolist(), strict=True))
        attitude = attitude_of(pitch, yaw)
        if self._gyro is not None:
            x, y, z = (
                sign * settings.gyro_scale * self._gyro.item(axis)
                for axis, sign in zip(settings.gyro_axes, settings.gyro_signs, strict=True)
            )
            return Measurement(attitude, (x, y, z))
        if self._filters is None:
            self._filters = [
                FilteredDerivative(settings.bandwidth, settings.damping_ratio, self._period) for _ in self._steps
            ]
        of_pitch, of_yaw = self._filters
        for _ in range(passed):
            pitch_rate, yaw_rate = of_pitch.update(pitch), of_yaw.update(yaw)
        rate: Vector = rate_of(pitch, pitch_rate, yaw_rate)
        return Measurement(attitude, rate)

    def _wait_out_the_period(self) -> None:
        """Nothing came to pace the loop: it must not spin."""
        ahead = self._advanced_ns + self._period * 1e9 - time.monotonic_ns()
        if ahead > 0:
            time.sleep(ahead * 1e-9)

    # ── outputs and watchdog ──

    def _write_outputs(self) -> None:
        driven = any(self._held) if self._driven is None else self._driven
        if driven and not self._amplified:
            self._amplify(True)
        volts = self._held if self._driven is not False else (0.0, 0.0)
        settings = self._settings
        for channel, sign, voltage in zip(settings.motor_channels, settings.motor_signs, volts, strict=True):
            self._volts[channel] = sign * voltage
        self._obeyed &= self._try(self._board.write_analog, MOTORS, len(MOTORS), self._volts)

    def _amplify(self, on: bool) -> bool:
        lines: Lines = np.full(len(MOTORS), on, dtype=np.int8)
        done = self._try(self._board.write_digital, MOTORS, len(MOTORS), lines)
        if done:
            self._amplified = on
        self._obeyed &= done
        return done

    def _keep_alive(self, *, reload: bool) -> bool:
        """Reload the watchdog, or see how it is. False if it has expired or cannot be asked."""
        if self._expired:
            return False
        try:
            alive = self._board.watchdog_reload() if reload else not self._board.watchdog_is_expired()
        except self._error as error:
            self._failed(_text(error))
            return False
        if not alive:
            self._expired = True
            self._amplified = False
            self._lit = None
            self.expiries += 1
        return alive

    def _clear(self) -> bool:
        """Get the outputs back after the watchdog has expired, at 0 V and armed. False if they cannot be had."""
        board, n = self._board, len(MOTORS)
        self._unlock()
        # Clearing may put outputs back as they were: each step is tried, whatever fails before it.
        armed = self._try(board.watchdog_start, self._settings.board_watchdog_s)
        still = self._try(board.write_analog, MOTORS, n, self._no_volts)
        done = self._amplify(False) and still and armed
        self._expired = not done
        if done and self._state is not None:
            self.show(self._state)
        return done

    def _unlock(self) -> None:
        """Let outputs be written, whatever the watchdog was doing; whether they can, the next write tells."""
        with suppress(self._error):
            self._board.watchdog_stop()
        with suppress(self._error):  # one that has not expired may refuse
            self._board.watchdog_clear()

    def _try(self, call: Callable[..., object], *args: object) -> bool:
        try:
            call(*args)
        except self._error as error:
            self._failed(_text(error))
            return False
        return True

    def _failed(self, text: str) -> None:
        self.failures += 1
        self.failure = text


def _text(error: Any) -> str:
    return str(error.get_error_message())
