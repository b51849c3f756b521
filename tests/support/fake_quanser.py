"""Fake of `quanser.hardware`: a board with an emulated Aero, strict about every call.

It follows Quanser's documentation: types and channels, the order of calls, overflows of a reader task's buffer, a
watchdog that takes over the outputs and holds them. Where the documentation is silent it does the worst that a board
might: a watchdog that has not expired refuses to be cleared, and clearing an expired one restores the outputs of before
the expiry. A wrong use raises MisuseError, which no code treats as a failure of the board.

The board's time is a count of samples. With `realtime` samples fall due on an absolute grid, read or not; without,
`task_read` lets the next period pass at once. No time passes before the task is started. Emulated is what the plant
uses: two motors, encoders and gyro, one reader task with a buffer of one sample.

`quanser_sdk/` beside this file is the package `quanser` with this board in it, for processes that tests start.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partialmethod
from math import atan2, ceil, isnan, pi
from typing import Any, Final, Literal

import numpy as np

from aeroloop.plant_emulator.hosts.quanser_board import COUNTS
from aeroloop.plant_emulator.plant import State
from aeroloop.plant_emulator.settings import PlantSettings

_ENCODERS: Final = range(4)
_GYRO: Final = range(3000, 3003)

Kind = Literal["analog", "digital"]

_OUTPUTS: Final[dict[Kind, tuple[range, Any, Any, float, float]]] = {
    "analog": (range(2), np.float64, np.float64, -24.0, 24.0),  # voltages of the motors [V]
    "digital": (range(2), np.int8, np.int32, 0, 1),  # amplifiers of the motors
}  # channels, types of the values written and of those at expiry, least and largest value


class MisuseError(AssertionError):
    """A call that the interface does not allow."""


class HILError(Exception):
    def get_error_message(self) -> str:
        return str(self.args[0])


class Clock:
    """Clocks of a board."""

    HARDWARE_CLOCK_0 = 0


class BufferOverflowMode:
    """What happens to samples that are not read in time: one of the interface's five modes."""

    OVERWRITE_ON_OVERFLOW = 1


@dataclass
class Task:
    """A reader task: its channels and its unread samples, one at the most."""

    encoders: list[int]
    other: list[int]
    samples: deque[tuple[list[int], list[float]]] = field(default_factory=lambda: deque(maxlen=1))
    mode: int = 0
    overflows: int = 0
    running: bool = False
    deleted: bool = False


class FakeQuanser:
    """A board with an emulated Aero on it, and the names of the module `quanser.hardware`.

    Its joints have the card's encoders, and its IMU a gyro. `time` counts samples since the task was started.
    """

    HILError = HILError
    Clock = Clock
    BufferOverflowMode = BufferOverflowMode

    def __init__(
        self, settings: PlantSettings, period: float, *, card_type: str = "quanser_aero2_usb", realtime: bool = False
    ) -> None:
        self.HIL: Callable[[], FakeHIL] = lambda: FakeHIL(self)
        self.card_type, self.period, self.realtime = card_type, period, realtime
        self.calls: deque[str] = deque(maxlen=10_000)  # names of the last calls
        self._turns = COUNTS[card_type]
        sensors = {"attitude": "encoders", "counts": self._turns, "rate": "gyro"}
        sensing = settings.sensors.model_copy(update=sensors)
        self._plant = settings.model_copy(update={"sensors": sensing}).build(period)

        self.holder: FakeHIL | None = None
        self.task: Task | None = None
        self.time = 0
        self.analog, self.enabled = [0.0, 0.0], [0, 0]
        self.outputs: dict[Kind, list[Any]] = {"analog": self.analog, "digital": self.enabled}
        self.at_expiry: dict[Kind, list[Any]] = {}
        self.before_expiry: dict[Kind, list[Any]] = {}
        self.expired = False
        self.watchdog: int | None = None  # its timeout in samples; None: it does not run
        self.reloaded = 0  # time of the watchdog's last reload
        self.started_ns = 0
        self._raw, self._zeros = [0, 0, 0, 0], [0, 0, 0, 0]
        self._unplugged = False
        self._failing: Counter[str] = Counter()
        self._count()

    # ── for tests ──

    @property
    def motor_voltages(self) -> tuple[float, ...]:
        """Voltages at the motors [V]: 0 where the amplifier is off."""
        return tuple(volts if on else 0.0 for volts, on in zip(self.analog, self.enabled, strict=True))

    def truth(self) -> State:
        return self._plant.truth()

    def fail_next(self, call: str, n: int = 1) -> None:
        """Let the next n calls of a method fail; a failed `task_read` loses its sample."""
        assert hasattr(FakeHIL, call), call
        self._failing[call] = n

    def unplug(self) -> None:
        """Disconnect the board from the computer: every call fails from now on, the board runs on."""
        self._unplugged = True

    def let_pass(self, periods: int) -> None:
        for _ in range(periods):
            self.step()

    def set_counts(self, channel: int, count: int) -> None:
        self._zeros[channel] = self._raw[channel] - count

    # ── the board ──

    def step(self) -> None:
        task = self.task
        if task is None or not task.running:
            raise MisuseError("no task runs, so there is no sample to wait for")
        self._check_watchdog()
        self._plant.actuate(self.motor_voltages)
        self._plant.advance()
        self.time += 1
        self._count()
        task.overflows += len(task.samples)
        task.samples.append(self.sample(task.encoders, task.other))

    def wait(self) -> None:
        """Let periods pass until there is a sample to read."""
        while self.task is None or not self.task.samples:
            ahead = self._due_ns() - time.monotonic_ns() if self.realtime else 0
            if ahead > 0:
                time.sleep(ahead * 1e-9)
            self.step()

    def sample(self, encoders: Sequence[int], other: Sequence[int]) -> tuple[list[int], list[float]]:
        counts = [self._raw[channel] - self._zeros[channel] for channel in encoders]
        gyro = self._plant.measure().rate
        return counts, [gyro[channel - _GYRO.start] for channel in other]

    def called(self, name: str) -> None:
        """Record a call and fail it if a test requested that. Samples due by now are taken first."""
        self.calls.append(name)
        if self.realtime and self.task is not None and self.task.running:
            while time.monotonic_ns() >= self._due_ns():
                self.step()
        self._check_watchdog()
        _refuse(self._unplugged, "the board is not connected")
        if self._failing[name]:
            self._failing[name] -= 1
            raise HILError(f"{name} was made to fail")

    def restore(self, outputs: dict[Kind, list[Any]]) -> None:
        for kind, values in outputs.items():
            self.outputs[kind][:] = values

    def _check_watchdog(self) -> None:
        if self.watchdog is not None and not self.expired and self.time - self.reloaded >= self.watchdog:
            self.expired = True
            self.before_expiry = {kind: list(values) for kind, values in self.outputs.items()}
            self.restore(self.at_expiry)

    def _due_ns(self) -> int:
        return self.started_ns + round((self.time + 1) * self.period * 1e9)

    def _count(self) -> None:
        """Set encoders 2 and 3 to the joint angles, which the emulated encoders have already quantized to counts."""
        w, x, y, z = self._plant.measure().attitude
        if isnan(w):
            self._unplugged = True  # the emulated state is not finite
            return
        pitch = atan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))  # R = R_z(yaw) R_y(pitch)
        yaw = atan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z))
        for channel, angle in ((2, pitch), (3, yaw)):
            turn = self._turns[channel - 2]
            moved = round(angle / (2 * pi) * turn) - self._raw[channel]
            self._raw[channel] += (moved + turn // 2) % turn - turn // 2  # the joint may turn more than once


class FakeHIL:
    """Handle of the board: checks every call and passes it to the board."""

    def __init__(self, device: FakeQuanser) -> None:
        self._device = device
        self._set: set[Kind] = set()  # kinds of expiration states set by this handle

    def open(self, card_type: str, card_identifier: str, /) -> None:
        device = self._device
        device.called("open")
        there = card_type == device.card_type and card_identifier == "0"
        _refuse(not there, f"there is no {card_type} '{card_identifier}'")
        _require(device.holder is not self, "open is called twice")
        _refuse(device.holder is not None, "the board is in use")
        device.holder = self

    def close(self) -> None:
        """Close the board and drop its task. Outputs stay as they are. Nothing happens if it is not open."""
        device = self._device
        if device.holder is not self:
            device.calls.append("close")
            return
        device.holder = device.task = None
        device.called("close")

    # ── immediate input and output ──

    def _write(self, kind: Kind, channels: Any, n: int, values: Any) -> None:
        self._begin(f"write_{kind}")
        there, dtype, _, low, high = _OUTPUTS[kind]
        numbers = _numbers(channels, n, there)
        _array(values, dtype, n)
        within = all(low <= value <= high for value in values.tolist())  # false for NaN
        _require(within, f"{kind} outputs take {low:g} to {high:g}, not {values.tolist()}")
        self._refuse_if_expired()
        unguarded = kind == "digital" and values.any() and self._device.watchdog is None
        _require(not unguarded, "an amplifier is switched on while no watchdog runs")
        for number, value in zip(numbers, values.tolist(), strict=True):
            self._device.outputs[kind][number - there[0]] = value

    write_analog = partialmethod(_write, "analog")
    write_digital = partialmethod(_write, "digital")

    def set_encoder_counts(self, channels: Any, n: int, counts: Any, /) -> None:
        self._begin("set_encoder_counts")
        numbers = _numbers(channels, n, _ENCODERS)
        _array(counts, np.int32, n)
        self._refuse_if_expired()
        for channel, count in zip(numbers, counts.tolist(), strict=True):
            self._device.set_counts(channel, count)

    def read(self, *inputs_and_buffers: Any) -> None:
        self._begin("read")
        inputs, buffers = inputs_and_buffers[:8], inputs_and_buffers[8:]
        numbers = _inputs(*inputs)
        _check_buffers(*numbers, *buffers)
        self._refuse_if_expired()
        _fill(self._device.sample(*numbers), *buffers)

    # ── the reader task ──

    def task_create_reader(self, samples_in_buffer: int, /, *inputs: Any) -> object:
        self._begin("task_create_reader")
        numbers = _inputs(*inputs)
        _require(samples_in_buffer == 1, f"the fake's buffer holds one sample, not {samples_in_buffer!r}")
        _refuse(self._device.task is not None, "this board has one task")
        self._device.task = Task(*numbers)
        return self._device.task

    def task_set_buffer_overflow_mode(self, task: Any, mode: int, /) -> None:
        self._begin("task_set_buffer_overflow_mode", task)
        _require(not task.running, "the overflow mode is set while the task runs")
        task.mode = mode

    def task_get_buffer_overflows(self, task: Any, /) -> int:
        self._begin("task_get_buffer_overflows", task)
        return int(task.overflows)

    def task_start(self, task: Any, clock: int, frequency: float, samples: int, /) -> None:
        device = self._device
        self._begin("task_start", task)
        _require(not task.running, "the task is started twice")
        _require(clock == Clock.HARDWARE_CLOCK_0, "a hardware clock must pace the loop")
        other = abs(frequency * device.period - 1) > 1e-9
        _require(not other, f"the emulated Aero steps at {1 / device.period:g} Hz, not at {frequency:g} Hz")
        _require(samples == 2**32 - 1, "the task would end by itself")
        task.running = True
        task.samples.clear()
        task.overflows = 0
        device.started_ns = time.monotonic_ns() - round(device.time * device.period * 1e9)

    def task_read(self, task: Any, samples: int, /, *buffers: Any) -> int:
        device = self._device
        failure: HILError | None = None
        try:
            self._begin("task_read")
        except HILError as error:
            failure = error
        _check_task(task)
        _require(task.running, "a task is read that was not started")
        _require(samples == 1, f"one sample makes a period, not {samples}")
        _check_buffers(task.encoders, task.other, *buffers)
        if failure is None or not device.realtime:  # by the clock, the sample falls due whether the read fails or not
            device.wait()
            sample = task.samples.popleft()
        if failure is not None:
            raise failure
        _fill(sample, *buffers)
        return 1

    def task_stop(self, task: Any, /) -> None:
        self._begin("task_stop", task)
        _require(task.running, "a task is stopped that does not run")
        task.running = False

    def task_delete(self, task: Any, /) -> None:
        self._begin("task_delete", task)
        _refuse(task.running, "the task still runs")
        task.deleted = True
        self._device.task = None

    # ── the watchdog ──

    def _set_expiration(self, kind: Kind, channels: Any, n: int, values: Any) -> None:
        self._begin(f"watchdog_set_{kind}_expiration_state")
        there, _, dtype, *_ = _OUTPUTS[kind]
        numbers = _numbers(channels, n, there)
        _array(values, dtype, n)
        _require(self._device.watchdog is None, "an expiration state is set while the watchdog runs")
        _require(numbers == list(there), f"an expiration state omits {kind} outputs")
        self._device.at_expiry[kind] = values.tolist()
        self._set.add(kind)

    watchdog_set_analog_expiration_state = partialmethod(_set_expiration, "analog")
    watchdog_set_digital_expiration_state = partialmethod(_set_expiration, "digital")

    def watchdog_start(self, timeout: float, /) -> None:
        device = self._device
        self._begin("watchdog_start")
        _require(timeout > 0, f"a watchdog's timeout is positive, not {timeout}")
        _require({"analog", "digital"} <= self._set, "the watchdog is started before its expiration states are set")
        _require(device.watchdog is None, "the watchdog is started twice")
        self._refuse_if_expired()
        device.watchdog = ceil(timeout / device.period - 1e-9)
        device.reloaded = device.time

    def watchdog_reload(self) -> bool:
        self._begin("watchdog_reload")
        _require(self._device.watchdog is not None, "a watchdog is reloaded that does not run")
        self._device.reloaded = self._device.time
        return not self._device.expired

    def watchdog_is_expired(self) -> bool:
        self._begin("watchdog_is_expired")
        return self._device.expired

    def watchdog_clear(self) -> None:
        """Allow writes again, and restore the outputs of before the expiry."""
        device = self._device
        self._begin("watchdog_clear")
        _refuse(not device.expired, "the watchdog has not expired")
        device.restore(device.before_expiry)
        device.expired = False
        device.reloaded = device.time

    def watchdog_stop(self) -> None:
        self._begin("watchdog_stop")
        self._device.watchdog = None

    # ── checks ──

    def _begin(self, call: str, *tasks: object) -> None:
        self._device.called(call)
        _require(self._device.holder is self, f"{call} on a board that is not open")
        for task in tasks:
            _check_task(task)

    def _refuse_if_expired(self) -> None:
        _refuse(self._device.expired, "the watchdog has expired")


def _require(allowed: bool, message: str) -> None:
    if not allowed:
        raise MisuseError(message)


def _refuse(refused: bool, message: str) -> None:
    if refused:
        raise HILError(message)


def _check_task(task: object) -> None:
    _require(isinstance(task, Task) and not task.deleted, "there is no such task")


def _numbers(channels: Any, n: int, there: Sequence[int]) -> list[int]:
    if channels is None and n == 0:
        return []
    _require(type(n) is int and n >= 1, f"a number of channels is an int of 1 or more, not {n!r}")
    _array(channels, np.uint32, n)
    numbers: list[int] = channels.tolist()
    once = len(set(numbers)) == n and set(numbers) <= set(there)
    _require(once, f"the channels are {list(there)}, each once, not {numbers}")
    return numbers


def _array(array: Any, dtype: type[np.generic], n: int) -> None:
    """Check an array for C, which would misread another type and read past the end of a shorter one."""
    if array is None and n == 0:
        return
    fits = isinstance(array, np.ndarray) and array.dtype == dtype and array.shape == (n,)
    _require(fits, f"an array of {n} {dtype.__name__} is required, not {array!r}")
    _require(array.flags.c_contiguous, "C needs an array that is contiguous")


def _inputs(
    analog: Any, n_analog: int, encoders: Any, n_encoders: int, digital: Any, n_digital: int, other: Any, n_other: int
) -> tuple[list[int], list[int]]:
    unread = analog is None and not n_analog and digital is None and not n_digital
    _require(unread, "the fake reads encoders and other channels only")
    return _numbers(encoders, n_encoders, _ENCODERS), _numbers(other, n_other, _GYRO)


def _check_buffers(encoders: list[int], others: list[int], analog: Any, counts: Any, digital: Any, other: Any) -> None:
    _require(analog is None and digital is None, "a buffer without channels")
    _array(counts, np.int32, len(encoders))
    _array(other, np.float64, len(others))


def _fill(sample: tuple[list[int], list[float]], _: None, counts: Any, __: None, other: Any) -> None:
    for buffer, values in zip((counts, other), sample, strict=True):
        if buffer is not None:
            buffer[:] = values
