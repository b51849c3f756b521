"""Fake of `quanser.hardware`: a board with an emulated Aero, strict about every call.

It follows Quanser's documentation: types and channels, the order of calls, overflows of a reader task's buffer, a
watchdog that takes over the outputs. Where that is silent it does the worst that a board might: a watchdog that has not
expired refuses to be cleared, and clearing an expired one restores the outputs of before. A wrong use raises
MisuseError, which no code treats as a failure of the board.

The board's time is a count of samples. With `realtime` samples fall due on an absolute grid, read or not; without,
`task_read` lets the next period pass at once. `quanser_sdk/` beside this file is the package `quanser` with this board
in it, for processes that tests start.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial, partialmethod
from math import atan2, ceil, isnan, pi
from types import ModuleType
from typing import Any, Final, Literal

import numpy as np

from aeroloop.plant_emulator.hosts.quanser_board import COUNTS
from aeroloop.plant_emulator.model.emulated import SensorSettings
from aeroloop.plant_emulator.plant import State
from aeroloop.plant_emulator.settings import PlantSettings

_ENCODERS: Final = range(4)
_GYRO: Final = range(3000, 3003)

EXPIRED: Final = "the watchdog has expired"
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
    """A reader task: its channels, encoders and other, and its unread samples, one at the most."""

    channels: tuple[list[int], list[int]]
    samples: deque[tuple[list[int], list[float]]] = field(default_factory=lambda: deque(maxlen=1))
    mode: int = 0
    overflows: int = 0
    running: bool = False


class Handle:
    """What `HIL()` makes: every call is the board's, which checks it."""

    def __init__(self, board: FakeQuanser) -> None:
        self._board = board

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return partial(self._board.call, self, name)


class FakeQuanser:
    """A board with an emulated Aero on it. `time` counts samples since the task was started."""

    def __init__(
        self, settings: PlantSettings, period: float, *, card_type: str = "quanser_aero2_usb", realtime: bool = False
    ) -> None:
        self.HIL: Callable[[], Handle] = lambda: Handle(self)
        self.card_type, self.period, self.realtime = card_type, period, realtime
        self.calls: deque[str] = deque(maxlen=10_000)  # names of the last calls
        self._turns = COUNTS[card_type]
        sensors = SensorSettings(counts=self._turns, rate="gyro")
        self._plant = settings.model_copy(update={"sensors": sensors}).build(period)

        self.holder: Handle | None = None
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
        assert hasattr(self, f"on_{call}"), call
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
        task.samples.append(self.sample(*task.channels))

    def wait(self) -> None:
        while self.task is None or not self.task.samples:
            ahead = self._due_ns() - time.monotonic_ns() if self.realtime else 0
            if ahead > 0:
                time.sleep(ahead * 1e-9)
            self.step()

    def sample(self, encoders: Sequence[int], other: Sequence[int]) -> tuple[list[int], list[float]]:
        counts = [self._raw[channel] - self._zeros[channel] for channel in encoders]
        gyro = self._plant.measure().rate
        return counts, [gyro[channel - _GYRO.start] for channel in other]

    def call(self, handle: Handle, name: str, *arguments: Any) -> Any:
        """A call through a handle. Samples due by now are taken first; a failed `task_read` loses its sample."""
        method = getattr(self, f"on_{name}")
        self.calls.append(name)
        if self.realtime and self.task is not None and self.task.running:
            while time.monotonic_ns() >= self._due_ns():
                self.step()
        self._check_watchdog()
        if name == "close":  # whatever happens; nothing if it is not open
            if self.holder is not handle:
                return None
            self.holder = self.task = None
        failing = self._failing[name] > 0
        self._failing[name] -= failing
        if name == "task_read" and not self.realtime and (failing or self._unplugged):
            self.wait()
            arguments[0].samples.clear()
        _refuse(self._unplugged, "the board is not connected")
        _refuse(failing, f"{name} was made to fail")
        _require(name in ("open", "close") or self.holder is handle, f"{name} on a board that is not open")
        return method(handle, *arguments) if name == "open" else method(*arguments)

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

    # ── the interface ──

    def on_open(self, handle: Handle, card_type: str, card_identifier: str) -> None:
        there = card_type == self.card_type and card_identifier == "0"
        _refuse(not there, f"there is no {card_type} '{card_identifier}'")
        _require(self.holder is not handle, "open is called twice")
        _refuse(self.holder is not None, "the board is in use")
        self.holder = handle
        self.at_expiry.clear()

    def on_close(self) -> None:
        """Outputs stay as they are."""

    def _write(self, kind: Kind, channels: Any, n: int, values: Any) -> None:
        there, dtype, _, low, high = _OUTPUTS[kind]
        numbers = _numbers(channels, n, there)
        _array(values, dtype, n)
        within = all(low <= value <= high for value in values.tolist())  # false for NaN
        _require(within, f"{kind} outputs take {low:g} to {high:g}, not {values.tolist()}")
        _refuse(self.expired, EXPIRED)
        unguarded = kind == "digital" and values.any() and self.watchdog is None
        _require(not unguarded, "an amplifier is switched on while no watchdog runs")
        for number, value in zip(numbers, values.tolist(), strict=True):
            self.outputs[kind][number - there[0]] = value

    on_write_analog = partialmethod(_write, "analog")
    on_write_digital = partialmethod(_write, "digital")

    def on_set_encoder_counts(self, channels: Any, n: int, counts: Any) -> None:
        numbers = _numbers(channels, n, _ENCODERS)
        _array(counts, np.int32, n)
        _refuse(self.expired, EXPIRED)
        for channel, count in zip(numbers, counts.tolist(), strict=True):
            self.set_counts(channel, count)

    def on_read(self, *inputs_and_buffers: Any) -> None:
        numbers, buffers = _inputs(*inputs_and_buffers[:8]), inputs_and_buffers[8:]
        _check_buffers(*numbers, *buffers)
        _refuse(self.expired, EXPIRED)
        _fill(self.sample(*numbers), *buffers)

    def on_task_create_reader(self, samples_in_buffer: int, *inputs: Any) -> object:
        numbers = _inputs(*inputs)
        _require(samples_in_buffer == 1, f"the fake's buffer holds one sample, not {samples_in_buffer!r}")
        _refuse(self.task is not None, "this board has one task")
        self.task = Task(numbers)
        return self.task

    def on_task_set_buffer_overflow_mode(self, task: Any, mode: int) -> None:
        self._check_task(task, running=False)
        task.mode = mode

    def on_task_get_buffer_overflows(self, task: Any) -> int:
        self._check_task(task)
        return int(task.overflows)

    def on_task_start(self, task: Any, clock: int, frequency: float, samples: int) -> None:
        self._check_task(task, running=False)
        _require(clock == Clock.HARDWARE_CLOCK_0, "a hardware clock must pace the loop")
        other = abs(frequency * self.period - 1) > 1e-9
        _require(not other, f"the emulated Aero steps at {1 / self.period:g} Hz, not at {frequency:g} Hz")
        _require(samples == 2**32 - 1, "the task would end by itself")
        task.running = True
        self.started_ns = time.monotonic_ns() - round(self.time * self.period * 1e9)

    def on_task_read(self, task: Any, samples: int, *buffers: Any) -> int:
        self._check_task(task, running=True)
        _require(samples == 1, f"one sample makes a period, not {samples}")
        _check_buffers(*task.channels, *buffers)
        self.wait()
        _fill(task.samples.popleft(), *buffers)
        return 1

    def on_task_stop(self, task: Any) -> None:
        self._check_task(task, running=True)
        task.running = False

    def on_task_delete(self, task: Any) -> None:
        self._check_task(task)
        _refuse(task.running, "the task still runs")
        self.task = None

    def _check_task(self, task: Any, running: bool | None = None) -> None:
        _require(task is not None and task is self.task, "there is no such task")
        if running is not None:
            _require(task.running == running, f"the task runs: {task.running}")

    def _set_expiration(self, kind: Kind, channels: Any, n: int, values: Any) -> None:
        there, _, dtype, *_ = _OUTPUTS[kind]
        numbers = _numbers(channels, n, there)
        _array(values, dtype, n)
        _require(self.watchdog is None, "an expiration state is set while the watchdog runs")
        _require(numbers == list(there), f"an expiration state omits {kind} outputs")
        self.at_expiry[kind] = values.tolist()

    on_watchdog_set_analog_expiration_state = partialmethod(_set_expiration, "analog")
    on_watchdog_set_digital_expiration_state = partialmethod(_set_expiration, "digital")

    def on_watchdog_start(self, timeout: float) -> None:
        _require(timeout > 0, f"a watchdog's timeout is positive, not {timeout}")
        _require(len(self.at_expiry) == 2, "the watchdog is started before its expiration states are set")
        _require(self.watchdog is None, "the watchdog is started twice")
        _refuse(self.expired, EXPIRED)
        self.watchdog = ceil(timeout / self.period - 1e-9)
        self.reloaded = self.time

    def on_watchdog_reload(self) -> bool:
        _require(self.watchdog is not None, "a watchdog is reloaded that does not run")
        self.reloaded = self.time
        return not self.expired

    def on_watchdog_is_expired(self) -> bool:
        return self.expired

    def on_watchdog_clear(self) -> None:
        """Allow writes again, and restore the outputs of before the expiry."""
        _refuse(not self.expired, "the watchdog has not expired")
        self.restore(self.before_expiry)
        self.expired = False
        self.reloaded = self.time

    def on_watchdog_stop(self) -> None:
        self.watchdog = None


def modules(board: FakeQuanser) -> dict[str, ModuleType]:
    """The package `quanser` with this board in it, by names for `sys.modules`."""
    contents: dict[str, dict[str, Any]] = {
        "quanser": {},
        "quanser.hardware": {"HIL": board.HIL, "HILError": HILError, "Clock": Clock},
        "quanser.hardware.enumerations": {"BufferOverflowMode": BufferOverflowMode},
    }
    made = {name: ModuleType(name) for name in contents}
    for name, module in made.items():
        module.__dict__.update(contents[name])
    return made


# ── checks of arguments ──


def _require(allowed: bool, message: str) -> None:
    if not allowed:
        raise MisuseError(message)


def _refuse(refused: bool, message: str) -> None:
    if refused:
        raise HILError(message)


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
    fits = isinstance(array, np.ndarray) and array.dtype == dtype and array.shape == (n,) and array.flags.c_contiguous
    _require(fits, f"a contiguous array of {n} {dtype.__name__} is required, not {array!r}")


def _inputs(*inputs: Any) -> tuple[list[int], list[int]]:
    """Numbers of the encoder and the other channels to read."""
    analog, n_analog, encoders, n_encoders, digital, n_digital, other, n_other = inputs
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
