"""Quanser Aero on its USB board: a plant, by Quanser's HIL interface.

The board paces the loop: `advance` waits for its next sample, which is measured; a failed read measures NaN. Each good
sample reloads the board's watchdog, which on expiry sets 0 V and switches the amplifier off. It is not reloaded after a
failed read or write, so that a plant that cannot be commanded soon has 0 V, and cleared only while 0 V is commanded.

Quanser's interface passes arrays to C as bare memory, so their types are part of the call: channels uint32, analog and
other float64, encoder counts int32, digital lines int8.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from math import pi
from typing import Any, Final

import numpy as np

from aeroloop.plant_emulator.model.emulated import NO_MEASUREMENT, Sensors, SensorSettings
from aeroloop.plant_emulator.plant import Measurement, Plant, PlantError, within_supply
from aeroloop.plant_emulator.settings import QuanserSettings
from aeroloop.protocol.wire.attitude import IDENTITY

MOTORS: Final = np.array([0, 1], dtype=np.uint32)
"""Analog outputs that carry the voltages u2 and u3, and digital outputs that enable their amplifiers."""
ENCODERS: Final = np.array([2, 3], dtype=np.uint32)  # pitch and yaw; 0 and 1 are the rotors'
GYRO: Final = np.array([3000, 3001, 3002], dtype=np.uint32)
COUNTS: Final[Mapping[str, tuple[int, int]]] = {"quanser_aero2_usb": (2880, 4096), "quanser_aero_usb": (2048, 4096)}
"""Encoder counts a turn, pitch and yaw, by type of card; as in Quanser's own classes."""

OFF: Final = (0.0, 0.0)
_SAMPLES_IN_BUFFER: Final = 1  # a read returns the newest sample, and the board counts those it overwrote
_UNLIMITED: Final = 2**32 - 1  # samples; as in Quanser's own class for this board


class QuanserPlant(Plant):
    """The Aero on its board. Its encoders are relative: keep the Aero level and at yaw 0 while this object is made.

    After a late `advance` the newest sample is measured, `passed` is the number of periods that passed, and the next
    `passed` − 1 calls return at once and measure NaN. `failures` counts failed calls, reads without a sample and
    expiries of the watchdog.

    Raises PlantError: the interface is missing, or the board cannot be opened or, at the first call, started.
    """

    actuators = 2
    paces = True

    def __init__(self, settings: QuanserSettings, period: float, watchdog_s: float) -> None:
        self._settings, self._period, self._watchdog_s = settings, period, watchdog_s
        try:
            self._hardware: Any = import_module("quanser.hardware")
            # Not every version exports this one in the module above.
            self._overflow: Any = import_module("quanser.hardware.enumerations").BufferOverflowMode
        except (ImportError, OSError) as error:  # OSError: the libraries that the package loads are missing
            raise PlantError(
                f"Quanser's Python interface is missing ({error}): install the Quanser SDK, then in this environment "
                "`pip install --find-links <SDK's folder>/python quanser_api`"
            ) from error
        self._error: Any = self._hardware.HILError
        self._board: Any = self._hardware.HIL()
        self.failures = 0

        counts = COUNTS[settings.card_type]
        sensing = SensorSettings(counts=counts, rate=settings.rate, bandwidth=settings.bandwidth)
        self._sensors = Sensors(sensing, period, zeros=[0.5, 0.5])  # counts are whole: half a step off any edge
        self._steps = [sign * 2 * pi / turn for sign, turn in zip(settings.encoder_signs, counts, strict=True)]
        self._counts = np.zeros(2, dtype=np.int32)
        self._gyro = np.zeros(3) if settings.rate == "gyro" else None
        self._held: tuple[float, ...] = OFF
        self._driven = self._amplified = False  # wanted, written
        self._task: object = None
        self._running = self._closed = self._expired = False
        self._written = True  # whether every write since the last sample succeeded
        self._read_samples = self._lost_samples = 0
        self._index = self._owed = 0  # index: of the last sample, on the board's clock
        self._advanced_ns = 0

        card = f"{settings.card_type} '{settings.card_identifier}'"
        with self._required(f"cannot open {card}", "; is it plugged in, switched on, and free?"):
            self._board.open(settings.card_type, settings.card_identifier)
        try:
            with self._required(f"cannot make {card} ready"):
                self._prepare()
        except PlantError:
            self.close()
            raise

    # ── Plant ──

    def actuate(self, voltages: Sequence[float]) -> None:
        """NaN is 0 V. An expired board watchdog is cleared by 0 V only; until then nothing is written."""
        self._held = within_supply(voltages, self._settings.voltage_limit)
        self._start()
        if not self._expired or (not any(self._held) and self._clear()):
            self._write_outputs()

    def advance(self) -> None:
        if self._owed:
            self._owed -= 1
            self._measurement = NO_MEASUREMENT
            return
        self._start()
        passed = self._read()
        alive = self._keep_alive(reload=passed > 0 and self._written)
        self._written = True
        if passed and alive:
            self._measurement = self._seen(passed)
        else:
            self._measurement = NO_MEASUREMENT
            self._sensors.restart()
        if not passed:
            ahead = self._advanced_ns + self._period * 1e9 - time.monotonic_ns()
            time.sleep(max(0.0, ahead * 1e-9))  # to the end of the period, so that the loop does not spin
            self._index += 1
        self.passed = max(1, passed)
        self._owed = self.passed - 1
        self._advanced_ns = time.monotonic_ns()

    def measure(self) -> Measurement:
        return self._measurement

    def enable(self, on: bool) -> None:
        if on is not self._driven:
            self._driven = on
            self._start()
            if not self._expired:
                self._write_outputs()

    def close(self) -> None:
        """A failed step does not prevent the next. If neither write succeeds, the watchdog is left to expire."""
        if self._closed:
            return
        self._closed = True
        still, off = self._write_motors(OFF), self._write_amplifier(False)
        if still or off:
            self._try(self._board.watchdog_stop)
        if self._running:
            self._try(self._board.task_stop, self._task)
        if self._task is not None:
            self._try(self._board.task_delete, self._task)
        self._try(self._board.close)

    # ── starting ──

    def _prepare(self) -> None:
        board, n = self._board, len(MOTORS)
        self._unlock()
        board.write_analog(MOTORS, n, np.zeros(n))
        board.write_digital(MOTORS, n, np.zeros(n, dtype=np.int8))
        board.watchdog_set_analog_expiration_state(MOTORS, n, np.zeros(n))
        board.watchdog_set_digital_expiration_state(MOTORS, n, np.zeros(n, dtype=np.int32))
        board.set_encoder_counts(ENCODERS, len(ENCODERS), np.zeros(2, dtype=np.int32))

        gyro = None if self._gyro is None else GYRO
        inputs = None, 0, ENCODERS, len(ENCODERS), None, 0, gyro, 0 if gyro is None else len(gyro)
        board.read(*inputs, None, self._counts, None, self._gyro)
        self._measurement = self._seen(1)
        self._task = board.task_create_reader(_SAMPLES_IN_BUFFER, *inputs)
        board.task_set_buffer_overflow_mode(self._task, self._overflow.OVERWRITE_ON_OVERFLOW)

    def _start(self) -> None:
        """Start the watchdog and the sampling task, once."""
        if self._running or self._closed:
            return
        with self._required(f"cannot start {self._settings.card_type}"):
            self._board.watchdog_start(self._watchdog_s)
            self._board.task_start(self._task, self._hardware.Clock.HARDWARE_CLOCK_0, 1 / self._period, _UNLIMITED)
        self._running = True
        self._advanced_ns = time.monotonic_ns()

    @contextmanager
    def _required(self, what_fails: str, hint: str = "") -> Iterator[None]:
        try:
            yield
        except self._error as error:
            raise PlantError(f"{what_fails}: {error.get_error_message()}{hint}") from error

    # ── samples ──

    def _read(self) -> int:
        """Wait for the newest sample. Returns the periods that passed, or 0 if the read failed."""
        samples = self._try(self._board.task_read, self._task, 1, None, self._counts, None, self._gyro)
        if samples == 0:
            self._failed("the board's task gave no sample")
        if not samples:
            return 0
        with suppress(self._error):  # not every board may count them
            self._lost_samples = self._board.task_get_buffer_overflows(self._task)
        self._read_samples += 1
        before, self._index = self._index, self._read_samples + self._lost_samples
        return max(1, self._index - before)  # a failed read counted as a period, even if its sample followed

    def _seen(self, passed: int) -> Measurement:
        """Measurement of the sample in the buffers, this many periods after the last one."""
        angles = [step * count for step, count in zip(self._steps, self._counts.tolist(), strict=True)]
        x = y = z = 0.0
        if self._gyro is not None:
            axes = self._settings.gyro_channels
            x, y, z = (self._gyro.item(abs(axis) - 1) * (1 if axis > 0 else -1) for axis in axes)
        for _ in range(passed):
            measurement = self._sensors.read(IDENTITY, (x, y, z), angles)
        return measurement

    # ── outputs and watchdog ──

    def _write_outputs(self) -> None:
        if self._amplified is not self._driven:
            self._write_amplifier(self._driven)
        self._write_motors(self._held if self._driven else OFF)

    def _write_motors(self, voltages: Sequence[float]) -> bool:
        return self._write(self._board.write_analog, np.multiply(self._settings.motor_signs, voltages))

    def _write_amplifier(self, on: bool) -> bool:
        done = self._write(self._board.write_digital, np.full(2, on, dtype=np.int8))
        if done:
            self._amplified = on
        return done

    def _write(self, call: Callable[..., object], values: Any) -> bool:
        done = self._try(call, MOTORS, 2, values) is not None
        self._written &= done
        return done

    def _keep_alive(self, *, reload: bool) -> bool:
        """Reload the watchdog or read its state. False if it has expired or cannot be read."""
        if self._expired:
            return False
        answer = self._try(self._board.watchdog_reload if reload else self._board.watchdog_is_expired)
        alive = answer is not None and bool(answer) is reload  # a reload returns whether it had not expired
        if answer is not None and not alive:
            self._failed("the board's watchdog expired")
            self._expired, self._amplified = True, False
        return alive

    def _clear(self) -> bool:
        """Clear the expired watchdog and restart it with outputs at 0 V. False if a step failed."""
        self._unlock()
        # Clearing may restore the outputs of before the expiry, so a failed step must not prevent the next.
        armed = self._try(self._board.watchdog_start, self._watchdog_s) is not None
        still = self._write_motors(OFF)
        off = self._write_amplifier(False)
        self._expired = not (armed and still and off)
        return not self._expired

    def _unlock(self) -> None:
        """Stop and clear the watchdog, so that outputs can be written; failures show at the next write."""
        for call in (self._board.watchdog_stop, self._board.watchdog_clear):
            with suppress(self._error):  # a watchdog that has not expired may refuse to be cleared
                call()

    def _try(self, call: Callable[..., object], *args: object) -> Any:
        """The call's result, True where it has none; None if the call failed."""
        try:
            result = call(*args)
        except self._error as error:
            self._failed(error.get_error_message())
            return None
        return True if result is None else result

    def _failed(self, text: str) -> None:
        self.failures += 1
        self.note = f"the board: {self.failures} failed calls, the last: {text}"
