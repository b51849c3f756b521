"""A stand-in for `quanser.hardware`, with an emulated Aero on the board.

What Quanser's documentation says of the interface holds here: types and channels, what must come before what, a reader
task with a buffer that overflows, a watchdog that takes the outputs and keeps them. Where the documentation is silent
it is as unhelpful as a board might be: a watchdog that has not expired refuses to be cleared, and clearing one that has
puts the outputs back to what they were. A wrong use raises MisuseError, which nothing takes for a board's failure.

The board's time is a count of samples. With `realtime` they come due on an absolute grid, whether anybody reads them or
not; without, `task_read` lets the next period pass at once, so that a run repeats bit for bit. Before the task is
started no time passes. Not emulated: rotor encoders, accelerometer, tachometers and currents, which read 0; more than
one task; writer tasks, PWM and digital inputs; a clear that fails for good.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from math import atan2, ceil, isnan, pi
from typing import Any, Final

import numpy as np

from aeroloop.plant_emulator.hosts.quanser.interface import Board, Channels, Counts, Doubles, Lines
from aeroloop.plant_emulator.plant import State
from aeroloop.plant_emulator.settings import PlantSettings

BOARDS: Final = {"quanser_aero2_usb": (2048, 2048, 2880, 4096), "quanser_aero_usb": (2048, 2048, 2048, 4096)}
"""Encoder counts a turn: rotors, pitch, yaw."""
LARGEST_VOLTAGE: Final = 24.0
"""Of a motor [V]."""

_ANALOG: Final = frozenset({0, 1})
_DIGITAL: Final = frozenset({0, 1})
_ENCODERS: Final = frozenset(range(4))
_OTHER_INPUTS: Final = frozenset({*range(3000, 3003), *range(4000, 4003), *range(14000, 14004)})
_LEDS: Final = frozenset(range(11000, 11003))
_CALLS_KEPT: Final = 10_000


class MisuseError(AssertionError):
    """The interface was used as it must not be."""


class HILError(Exception):
    """The board refuses or fails."""

    def get_error_message(self) -> str:
        """What went wrong."""
        return str(self.args[0])


class Clock:
    """Clocks of a board."""

    HARDWARE_CLOCK_0 = 0


class BufferOverflowMode:
    """What happens to samples that nobody reads in time."""

    ERROR_ON_OVERFLOW = 0
    OVERWRITE_ON_OVERFLOW = 1
    DISCARD_ON_OVERFLOW = 2
    WAIT_ON_OVERFLOW = 3
    SYNCHRONIZED = 4


class Task:
    """A reader task: what it samples, and the samples that nobody has read.

    Args:
        size: Samples that its buffer holds.
        encoders: Encoder channels.
        other: Other channels.
    """

    def __init__(self, size: int, encoders: list[int], other: list[int]) -> None:
        self.encoders, self.other = encoders, other
        self.samples: deque[tuple[list[int], list[float]]] = deque(maxlen=size)
        self.mode = BufferOverflowMode.ERROR_ON_OVERFLOW
        self.overflows = 0
        self.running = self.deleted = False

    @property
    def full(self) -> bool:
        """Whether a further sample would overflow."""
        return len(self.samples) == self.samples.maxlen

    def offer(self, encoders: list[int], other: list[float]) -> None:
        """Take in a sample, as the overflow mode says."""
        if self.full:
            self.overflows += 1
        if not self.full or self.mode == BufferOverflowMode.OVERWRITE_ON_OVERFLOW:
            self.samples.append((encoders, other))


class FakeQuanser:
    """A board with an emulated Aero on it, and the names of the module `quanser.hardware`.

    Args:
        settings: The Aero. Its joints have the card's encoders, and its IMU the gyro of `settings.sensors`.
        period: Time between samples [s].
        card_type: SessionKey board is plugged in, a key of BOARDS.
        realtime: Whether samples come due by the clock, or when they are read.

    Raises:
        ValueError: Not an Aero.

    Attributes:
        HIL: Makes a board's handle, as the class in the module does.
        calls: Names of the calls, the last 10 000.
        time: Samples since the task was started.
        analog: Voltages on the analog outputs [V].
        enabled: Whether each motor's amplifier is.
        leds: Red, green, blue.
        expired: Whether the watchdog has.
        reads_while_expired: Whether a reader task goes on while the outputs are held; the documentation is silent.
        counts_overflows: Whether it can tell how many samples were lost.
    """

    HILError: type[Exception] = HILError
    Clock: Any = Clock
    BufferOverflowMode: Any = BufferOverflowMode

    def __init__(
        self,
        settings: PlantSettings,
        period: float,
        *,
        card_type: str = "quanser_aero2_usb",
        realtime: bool = False,
    ) -> None:
        if settings.kind != "aero":
            raise ValueError("behind Quanser's board there is an Aero: set plant.kind to 'aero'")
        self.HIL = self._handle
        self.card_type, self.period, self.realtime = card_type, period, realtime
        self.calls: deque[str] = deque(maxlen=_CALLS_KEPT)
        self.reads_while_expired = self.counts_overflows = True
        self._turns = BOARDS[card_type]
        sensors = {"attitude": "encoders", "counts": self._turns[2:], "rate": "gyro"}
        sensing = settings.sensors.model_copy(update=sensors)
        self._plant = settings.model_copy(update={"sensors": sensing}).build(period)

        self.holder: FakeHIL | None = None
        self.task: Task | None = None
        self.time = 0
        self.analog, self.enabled, self.leds = [0.0, 0.0], [False, False], [0.0, 0.0, 0.0]
        self.at_expiry: dict[str, list[Any]] = {}
        self.expired = False
        self.watchdog: int | None = None  # samples that it lets pass; None: it does not run
        self._before_expiry: list[list[Any]] = [[], [], []]
        self._reloaded = 0
        self._raw = [0, 0, 0, 0]
        self._zeros = [0, 0, 0, 0]
        self._unplugged = False
        self._failing: dict[str, int] = {}
        self._short = 0
        self._started_ns = 0
        self._count()

    # ── for whoever tests ──

    @property
    def motor_voltages(self) -> tuple[float, ...]:
        """Voltages that reach the motors [V]: 0 where the amplifier is off."""
        return tuple(volts if on else 0.0 for volts, on in zip(self.analog, self.enabled, strict=True))

    def truth(self) -> State:
        """The Aero's true state."""
        return self._plant.truth()

    def fail_next(self, call: str, n: int = 1) -> None:
        """Let the next n calls of a method fail; a failed `task_read` loses its sample."""
        if not hasattr(FakeHIL, call):
            raise ValueError(f"the interface has no call {call!r}")
        self._failing[call] = n

    def short_next(self, n: int = 1) -> None:
        """Let the next n `task_read` return without a sample, as those of a task that was stopped do."""
        self._short = n

    def unplug(self) -> None:
        """Take the board off the computer: every call fails from now on. The board itself goes on."""
        self._unplugged = True

    def let_pass(self, periods: int) -> None:
        """Let periods pass while nobody reads."""
        for _ in range(periods):
            self.step()

    # ── the board ──

    def _handle(self) -> Board:
        return FakeHIL(self)

    def step(self) -> None:
        """Let one period pass."""
        task = self.task
        if task is None or not task.running:
            raise MisuseError("no task runs, so there is no sample to wait for")
        if task.full and task.mode == BufferOverflowMode.WAIT_ON_OVERFLOW:
            return
        self.look_at_watchdog()
        self._plant.actuate(self.motor_voltages)
        self._plant.advance()
        self.time += 1
        self._count()
        task.offer(*self.sample(task.encoders, task.other))

    def wait(self) -> None:
        """Let periods pass until there is a sample to read."""
        while self.task is None or not self.task.samples:
            ahead = self._due_ns() - time.monotonic_ns() if self.realtime else 0
            if ahead > 0:
                time.sleep(ahead * 1e-9)
            self.step()

    def start(self) -> None:
        """Begin to sample."""
        self._started_ns = time.monotonic_ns() - round(self.time * self.period * 1e9)

    def sample(self, encoders: Sequence[int], other: Sequence[int]) -> tuple[list[int], list[float]]:
        """What these channels read now."""
        counts = [self._raw[channel] - self._zeros[channel] for channel in encoders]
        gyro = self._plant.measure().rate
        return counts, [gyro[channel - 3000] if channel in range(3000, 3003) else 0.0 for channel in other]

    def set_counts(self, channel: int, count: int) -> None:
        """Let an encoder read this count now."""
        self._zeros[channel] = self._raw[channel] - count

    def look_at_watchdog(self) -> None:
        """Let the watchdog expire if its time is over."""
        if self.watchdog is None or self.expired or self.time - self._reloaded < self.watchdog:
            return
        self.expired = True
        self._before_expiry = [self.analog, self.enabled, self.leds]
        self.analog, self.enabled = list(self.at_expiry["analog"]), list(self.at_expiry["digital"])
        self.leds = list(self.at_expiry.get("other", self.leds))

    def reload(self) -> None:
        """The watchdog counts from 0 again."""
        self._reloaded = self.time

    def clear(self) -> None:
        """Give the outputs back, as they were."""
        self.analog, self.enabled, self.leds = self._before_expiry
        self.expired = False
        self._reloaded = self.time

    def called(self, name: str) -> None:
        """Note a call, and let it fail if it shall. Samples that are due by now have come."""
        self.calls.append(name)
        if self.realtime and self.task is not None and self.task.running:
            full = self.task.mode == BufferOverflowMode.WAIT_ON_OVERFLOW
            while time.monotonic_ns() >= self._due_ns() and not (full and self.task.full):
                self.step()
        self.look_at_watchdog()
        if self._unplugged:
            raise HILError("the board is not connected")
        if self._failing.get(name, 0):
            self._failing[name] -= 1
            raise HILError(f"{name} was told to fail")

    def falls_short(self) -> bool:
        """Whether this `task_read` is to return without a sample."""
        if self._short:
            self._short -= 1
            return True
        return False

    def _due_ns(self) -> int:
        """When the next sample comes, on `time.monotonic_ns()`."""
        return self._started_ns + round((self.time + 1) * self.period * 1e9)

    def _count(self) -> None:
        """Turn encoders 2 and 3 to where the emulated ones, counts themselves, say that the joints are."""
        w, x, y, z = self._plant.measure().attitude
        if isnan(w):
            self._unplugged = True  # an Aero that has left the numbers has no encoders
            return
        pitch = atan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))  # R = R_z(yaw) R_y(pitch)
        yaw = atan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z))
        for channel, angle in ((2, pitch), (3, yaw)):
            turn = self._turns[channel]
            moved = round(angle / (2 * pi) * turn) - self._raw[channel]
            self._raw[channel] += (moved + turn // 2) % turn - turn // 2  # the joint may turn more than once


class FakeHIL:
    """A handle of the board: checks every call, then lets the board do it.

    Args:
        device: The board.
    """

    def __init__(self, device: FakeQuanser) -> None:
        self._device = device
        self._set: set[str] = set()  # expiration states

    def open(self, card_type: str, card_identifier: str, /) -> None:
        """Take hold of the board."""
        device = self._device
        device.called("open")
        if not isinstance(card_type, str) or not isinstance(card_identifier, str):
            raise MisuseError("a board is named by two strings")
        if card_type != device.card_type or card_identifier.split("@")[0] != "0":
            raise HILError(f"there is no {card_type} '{card_identifier}'")
        if device.holder is self:
            raise MisuseError("open is called twice")
        if device.holder is not None:
            raise HILError("the board is in use")
        device.holder = self
        self._virtual = "@" in card_identifier

    def close(self) -> None:
        """Let go of it. The outputs stay as they are; what is left of a task goes. No harm if it is not open."""
        device = self._device
        if device.holder is not self:
            device.calls.append("close")
            return
        device.holder = device.task = None
        device.called("close")

    def is_valid(self) -> bool:
        """Whether it is held."""
        return self._device.holder is self

    # ── immediate input and output ──

    def write_analog(self, channels: Channels, n: int, volts: Doubles, /) -> None:
        """Set motors' voltages [V]."""
        names = self._output("write_analog", channels, n, _ANALOG, volts, np.float64)
        if not all(abs(value) <= LARGEST_VOLTAGE for value in volts.tolist()):  # NaN is none, either
            raise MisuseError(f"motors take ±{LARGEST_VOLTAGE:g} V, not {volts.tolist()}")
        self._refuse_if_expired()
        for channel, value in zip(names, volts.tolist(), strict=True):
            self._device.analog[channel] = value

    def write_digital(self, channels: Channels, n: int, lines: Lines, /) -> None:
        """Enable motors' amplifiers, under a watchdog."""
        names = self._output("write_digital", channels, n, _DIGITAL, lines, np.int8)
        if not set(lines.tolist()) <= {0, 1}:
            raise MisuseError(f"a digital line is 0 or 1, not {lines.tolist()}")
        self._refuse_if_expired()
        if lines.any() and self._device.watchdog is None:
            raise MisuseError("an amplifier is enabled while no watchdog runs")
        for channel, value in zip(names, lines.tolist(), strict=True):
            self._device.enabled[channel] = bool(value)

    def write_other(self, channels: Channels, n: int, values: Doubles, /) -> None:
        """Set lights."""
        names = self._output("write_other", channels, n, _LEDS, values, np.float64)
        if not all(0 <= value <= 1 for value in values.tolist()):
            raise MisuseError(f"a light is 0…1, not {values.tolist()}")
        self._refuse_if_expired()
        for channel, value in zip(names, values.tolist(), strict=True):
            self._device.leds[channel - 11000] = value

    def set_encoder_counts(self, channels: Channels, n: int, counts: Counts, /) -> None:
        """Say what encoders read now."""
        names = self._output("set_encoder_counts", channels, n, _ENCODERS, counts, np.int32)
        self._refuse_if_expired()
        for channel, count in zip(names, counts.tolist(), strict=True):
            self._device.set_counts(channel, count)

    def read(
        self,
        analog: Channels | None,
        n_analog: int,
        encoders: Channels | None,
        n_encoders: int,
        digital: Channels | None,
        n_digital: int,
        other: Channels | None,
        n_other: int,
        analog_buffer: Doubles | None,
        encoder_buffer: Counts | None,
        digital_buffer: Lines | None,
        other_buffer: Doubles | None,
        /,
    ) -> None:
        """Read inputs at once."""
        self._begin("read")
        _none("read", analog, n_analog, digital, n_digital)
        _no_buffer("read", analog_buffer, digital_buffer)
        names = _names(encoders, n_encoders, _ENCODERS), _names(other, n_other, _OTHER_INPUTS)
        _array(encoder_buffer, np.int32, len(names[0]), writeable=True)
        _array(other_buffer, np.float64, len(names[1]), writeable=True)
        self._refuse_if_expired()
        _fill(self._device.sample(*names), encoder_buffer, other_buffer)

    # ── the reader task ──

    def task_create_reader(
        self,
        samples_in_buffer: int,
        analog: Channels | None,
        n_analog: int,
        encoders: Channels | None,
        n_encoders: int,
        digital: Channels | None,
        n_digital: int,
        other: Channels | None,
        n_other: int,
        /,
    ) -> object:
        """A task, which does not run yet."""
        self._begin("task_create_reader")
        _none("task_create_reader", analog, n_analog, digital, n_digital)
        if type(samples_in_buffer) is not int or samples_in_buffer < 1:
            raise MisuseError(f"a buffer holds one sample or more, not {samples_in_buffer!r}")
        if self._device.task is not None:
            raise HILError("this board has one task")
        names = _names(encoders, n_encoders, _ENCODERS), _names(other, n_other, _OTHER_INPUTS)
        self._device.task = Task(samples_in_buffer, *names)
        return self._device.task

    def task_set_buffer_overflow_mode(self, task: Any, mode: int, /) -> None:
        """What happens to samples that nobody reads in time."""
        self._begin("task_set_buffer_overflow_mode")
        self._known(task)
        if task.running:
            raise MisuseError("the overflow mode is set while the task runs")
        if mode >= BufferOverflowMode.WAIT_ON_OVERFLOW and not self._virtual:
            raise HILError("only virtual boards can wait for their reader")
        task.mode = mode

    def task_get_buffer_overflows(self, task: Any, /) -> int:
        """Samples lost since the task was started."""
        self._begin("task_get_buffer_overflows")
        overflows = self._known(task).overflows
        if not self._device.counts_overflows:
            raise HILError("this board does not count overflows")
        return overflows

    def task_start(self, task: Any, clock: int, frequency: float, samples: int, /) -> None:
        """Begin to sample, for ever and at the Aero's own period."""
        device = self._device
        self._begin("task_start")
        if self._known(task).running:
            raise MisuseError("the task is started twice")
        if clock != Clock.HARDWARE_CLOCK_0:
            raise MisuseError("a hardware clock paces the loop")
        if abs(frequency * device.period - 1) > 1e-9:
            raise MisuseError(f"the emulated Aero steps at {1 / device.period:g} Hz, not at {frequency:g} Hz")
        if samples != 2**32 - 1:
            raise MisuseError("the task would end by itself")
        task.running = True
        task.samples.clear()
        task.overflows = 0
        device.start()

    def task_read(
        self,
        task: Any,
        samples: int,
        analog_buffer: Doubles | None,
        encoder_buffer: Counts | None,
        digital_buffer: Lines | None,
        other_buffer: Doubles | None,
        /,
    ) -> int:
        """Wait for the oldest sample of the buffer. A failed read leaves the buffers as they were."""
        device = self._device
        failure: HILError | None = None
        try:
            self._begin("task_read")
        except HILError as error:
            failure = error
        known = self._known(task)
        if not known.running:
            raise MisuseError("a task is read that was not started")
        if samples != 1:
            raise MisuseError(f"one sample makes a period, not {samples}")
        _no_buffer("task_read", analog_buffer, digital_buffer)
        _array(encoder_buffer, np.int32, len(known.encoders), writeable=True)
        _array(other_buffer, np.float64, len(known.other), writeable=True)
        if failure is None and device.expired and not device.reads_while_expired:
            failure = HILError("the watchdog has expired")
        if failure is None and known.overflows and known.mode == BufferOverflowMode.ERROR_ON_OVERFLOW:
            failure = HILError("the task's buffer has overflowed")
        if failure is None or not device.realtime:  # by the clock, the sample comes whether the read fails or not
            device.wait()
            sample = known.samples.popleft()
        if failure is not None:
            raise failure
        if device.falls_short():
            return 0
        _fill(sample, encoder_buffer, other_buffer)
        return 1

    def task_stop(self, task: Any, /) -> None:
        """Sample no more."""
        self._begin("task_stop")
        if not self._known(task).running:
            raise MisuseError("a task is stopped that does not run")
        task.running = False

    def task_delete(self, task: Any, /) -> None:
        """Give the task back."""
        self._begin("task_delete")
        if self._known(task).running:
            raise HILError("the task still runs")
        task.deleted = True
        self._device.task = None

    # ── the watchdog ──

    def watchdog_set_analog_expiration_state(self, channels: Channels, n: int, volts: Doubles, /) -> None:
        """What voltages go to when it expires [V]."""
        self._expiration("analog", channels, n, _ANALOG, volts, np.float64)

    def watchdog_set_digital_expiration_state(self, channels: Channels, n: int, states: Counts, /) -> None:
        """What amplifiers go to then: 0 for low, in an enumeration of 4 bytes."""
        self._expiration("digital", channels, n, _DIGITAL, states, np.int32)

    def watchdog_set_other_expiration_state(self, channels: Channels, n: int, values: Doubles, /) -> None:
        """What lights go to then."""
        self._expiration("other", channels, n, _LEDS, values, np.float64)

    def watchdog_start(self, timeout: float, /) -> None:
        """Begin to count [s]."""
        device = self._device
        self._begin("watchdog_start")
        if not timeout > 0:
            raise MisuseError(f"a watchdog's time is positive, not {timeout}")
        if not {"analog", "digital"} <= self._set:
            raise MisuseError("the watchdog is started before it knows what to do")
        if device.watchdog is not None:
            raise MisuseError("the watchdog is started twice")
        self._refuse_if_expired()
        device.watchdog = ceil(timeout / device.period - 1e-9)
        device.reload()

    def watchdog_reload(self) -> bool:
        """Count from 0 again. False if it has expired."""
        self._begin("watchdog_reload")
        if self._device.watchdog is None:
            raise MisuseError("a watchdog is reloaded that does not run")
        self._device.reload()
        return not self._device.expired

    def watchdog_is_expired(self) -> bool:
        """Whether it has."""
        self._begin("watchdog_is_expired")
        return self._device.expired

    def watchdog_clear(self) -> None:
        """Let outputs be written again, and put them back to what they were."""
        self._begin("watchdog_clear")
        if not self._device.expired:
            raise HILError("the watchdog has not expired")
        self._device.clear()

    def watchdog_stop(self) -> None:
        """Count no more. An expired one stays so."""
        self._begin("watchdog_stop")
        self._device.watchdog = None

    # ── checks ──

    def _begin(self, call: str) -> None:
        self._device.called(call)
        if self._device.holder is not self:
            raise MisuseError(f"{call} on a board that is not open")

    def _refuse_if_expired(self) -> None:
        if self._device.expired:
            raise HILError("the watchdog has expired")

    def _known(self, task: object) -> Task:
        if not isinstance(task, Task) or task.deleted:
            raise MisuseError("there is no such task")
        return task

    def _output(
        self, call: str, channels: Channels, n: int, there: frozenset[int], values: object, dtype: type[np.generic]
    ) -> list[int]:
        self._begin(call)
        names = _names(channels, n, there)
        _array(values, dtype, n)
        return names

    def _expiration(
        self, kind: str, channels: Channels, n: int, there: frozenset[int], values: Any, dtype: type[np.generic]
    ) -> None:
        names = self._output(f"watchdog_set_{kind}_expiration_state", channels, n, there, values, dtype)
        if self._device.watchdog is not None:
            raise MisuseError("an expiration state is set while the watchdog runs")
        if names != sorted(there):
            raise MisuseError(f"an expiration state leaves {kind} outputs out")
        self._device.at_expiry[kind] = [bool(value) if kind == "digital" else value for value in values.tolist()]
        self._set.add(kind)


def _names(channels: object, n: int, there: frozenset[int]) -> list[int]:
    """Channel numbers, of an array that C can read."""
    if channels is None and n == 0:
        return []
    if type(n) is not int or n < 1:
        raise MisuseError(f"a number of channels is an int of 1 or more, not {n!r}")
    _array(channels, np.uint32, n)
    names: list[int] = channels.tolist()  # type: ignore[attr-defined]  # it is an array
    if len(set(names)) != n or not set(names) <= there:
        raise MisuseError(f"there are channels {sorted(there)}, each once, not {names}")
    return names


def _array(array: object, dtype: type[np.generic], n: int, *, writeable: bool = False) -> None:
    """C sees bare memory: of another type or too short, it would be read wrongly, or past its end."""
    if array is None and n == 0:
        return
    if not isinstance(array, np.ndarray) or array.dtype != dtype or array.shape != (n,):
        said = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else repr(array)
        raise MisuseError(f"an array of {n} {dtype.__name__} is wanted, not {said}")
    if not array.flags.c_contiguous or (writeable and not array.flags.writeable):
        raise MisuseError("the array is not C's to use: contiguous, and writeable where it is read into")


def _none(call: str, analog: object, n_analog: int, digital: object, n_digital: int) -> None:
    if analog is not None or n_analog or digital is not None or n_digital:
        raise MisuseError(f"{call}: this stand-in reads encoders and other channels only")


def _no_buffer(call: str, analog: object, digital: object) -> None:
    if analog is not None or digital is not None:
        raise MisuseError(f"{call}: a buffer without channels")


def _fill(sample: tuple[list[int], list[float]], encoders: Counts | None, other: Doubles | None) -> None:
    if encoders is not None:
        encoders[:] = sample[0]
    if other is not None:
        other[:] = sample[1]
