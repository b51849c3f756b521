"""Faults: their notation, and the table KINDS of what each kind does to sensors, motors and frames.

A fault is written `signal:kind[=value][@start[..end]]`, in seconds of the plant's time. Without a start it acts at
once, without an end for ever:

    attitude:off@5    rate.y:bias=0.1@2..4    motor2:stuck@3    command:drop=0.05    measurement:delay=0.02@0..10

`attitude` and `rate` take an axis of the body, `.x .y .z`; bias and noise of the attitude are rotations about the
body's axes. Motors are numbered from 1 in the order of the commanded voltages; `motors` fails all of them at the same
times. README.md has the limits of the values, with their reasons. `injection` puts faults to work.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import cos, hypot, inf, nan, sin, ulp
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.spec import MAX_ACTUATORS

if TYPE_CHECKING:
    import numpy as np

MAX_DELAY_S: Final = 10.0
MAX_TIME_S: Final = 1e8
"""Latest begin and end [s]; three years."""


class FaultError(AeroloopError, ValueError):
    """A fault that is none, or cannot be injected; one line that says why."""


@dataclass(frozen=True)
class Fault:
    """One kind of failure of one signal for a span of time. Raises ValueError: what is wrong, and what is right."""

    signal: str  # a key of SIGNALS
    kind: str  # a key of KINDS
    value: float | None = None  # size [the signal's unit, s or 1]; None for a kind without one
    start_s: float = 0.0
    end_s: float | None = None  # None for none

    def __post_init__(self) -> None:
        if self.signal not in SIGNALS:
            raise ValueError(f"there is no signal {self.signal!r}; there are {_listed(SIGNALS)}")
        whole, kinds = self.target.whole, self.target.kinds
        if self.kind not in kinds:
            as_a_whole = f"; {whole} as a whole does" if self.kind in SIGNALS[whole].kinds else ""
            raise ValueError(f"{self.signal} takes no {self.kind!r}, but {_listed(kinds)}{as_a_whole}")
        self._check_value()
        start, end = self.start_s, self.end_s
        if not 0 <= start <= MAX_TIME_S:
            raise ValueError(f"it must begin within 0 to {MAX_TIME_S:g} s, not at {_text(start)} s")
        if end is not None and not start < end <= MAX_TIME_S:
            raise ValueError(
                f"it must end after it begins at {_text(start)} s and by {MAX_TIME_S:g} s, not at {_text(end)} s"
            )

    def _check_value(self) -> None:
        kind, value, (*_, largest, unit) = self.kind, self.value, self.target
        match KINDS[kind].takes:
            case "bias":
                low, high, words = -largest, largest, f"{-largest:g} to {largest:g} {unit}"
            case "deviation":
                low, high, words = 0.0, largest, f"0 to {largest:g} {unit}"
            case "delay":
                low, high, words = 0.0, MAX_DELAY_S, f"0 to {MAX_DELAY_S:g} s"
            case "probability":
                low, high, words = ulp(0.0), 1.0, "a probability above 0 and up to 1"
            case "nothing":
                if value is not None:
                    raise ValueError(f"{kind} takes no value, but was given {_text(value)}: write {kind} alone")
                return
        if value is None:
            raise ValueError(f"{kind} takes {words}: write {kind}=0.1, say")
        if not low <= value <= high:
            raise ValueError(f"{kind} takes {words}, not {_text(value)}")

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Parse `signal:kind[=value][@start[..end]]`. Raises FaultError, with the text and the error."""
        what, at, when = text.strip().partition("@")
        signal, colon, failure = what.partition(":")
        kind, equals, value = failure.partition("=")
        start, dots, end = when.partition("..")
        try:
            if not colon:
                raise ValueError("it is written signal:kind[=value][@start[..end]], such as attitude:off@5")
            size = _number(value) if equals else None
            return cls(signal, kind, size, _number(start) if at else 0.0, _number(end) if dots else None)
        except ValueError as error:
            raise FaultError(f"fault {text!r}: {error}") from None

    def __str__(self) -> str:
        value = "" if self.value is None else f"={_text(self.value)}"
        start = f"@{_text(self.start_s)}" if self.start_s or self.end_s is not None else ""
        end = "" if self.end_s is None else f"..{_text(self.end_s)}"
        return f"{self.signal}:{self.kind}{value}{start}{end}"

    @property
    def target(self) -> Signal:
        """Signal that the fault acts on."""
        return SIGNALS[self.signal]

    @property
    def effect(self) -> str:
        """What it does to what, after a number: `commands dropped`."""
        return f"{self.target.counted} {KINDS[self.kind].changes}"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a number") from None


def _text(value: float) -> str:
    """The shortest text that reads back as the same float."""
    return repr(value).removesuffix(".0")


def _listed(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} and {last}"


# ── faults at work ──

Values: TypeAlias = tuple[float, ...]


class ActingFault:
    """A fault of frames in the plant's time; its subclass is one of values.

    `now` is the time of its injection [s], `last` what its signal was just before: the frame that passed last.

    Attributes:
        start: Start [s].
        end: End [s]; infinity for none.
        last: The values or the frame just before it acts; None if there were none.
        held: Frames held back, each with a time [s].
        changed: Samples, voltages of a period, or frames that it has changed.
    """

    def __init__(self, fault: Fault, random: np.random.Generator, now: float, last: Any) -> None:
        self.fault, self.random, self.last = fault, random, last
        self.kind = KINDS[fault.kind]
        self.value = fault.value or 0.0
        self.start = round(fault.start_s + now, 9)
        self.end = inf if fault.end_s is None else round(fault.end_s + now, 9)
        self.held: deque[tuple[float, bytes]] = deque()
        self.changed = 0

    def apply(self, given: Any, t: float) -> Any:
        """The frames that pass at time t [s], in order, of those given and those held back."""
        assert self.kind.of_frames is not None
        return self.kind.of_frames(self, given, t)

    def active(self, t: float) -> bool:
        """Whether it is at work at time t [s]: start ≤ t < end."""
        return self.start <= t < self.end

    def acts(self, t: float) -> bool:
        """Whether it changes one sample or frame at time t [s], which is counted; where by chance, chance decides."""
        acts = self.active(t) and (self.kind.takes != "probability" or bool(self.random.random() < self.value))
        self.changed += acts
        return acts


class ValueFault(ActingFault):
    """A fault of attitude, rate or voltages, sampled once a period; garbled values are within ±`bound`."""

    def __init__(
        self, fault: Fault, random: np.random.Generator, now: float, last: Values | None, bound: float
    ) -> None:
        super().__init__(fault, random, now, last)
        self.whole, part = fault.target.whole, fault.target.part
        self.size = len(last) if self.whole == "motors" and last is not None else 3  # components of an error
        self.bound = bound
        self._parts = range(self.size) if part is None else (part,)
        self.earlier: deque[tuple[float, Values]] = deque() if last is None else deque([(-inf, last)])

    def apply(self, given: Values, t: float) -> Values:
        """The values of time t [s]. Call it at every sample: before the fault starts, it keeps history."""
        if self.kind.takes == "delay":
            self.earlier.append((t, given))
            while len(self.earlier) > 1 and self.earlier[1][0] <= round(t - self.value, 9):
                self.earlier.popleft()
        if not self.active(t):
            self.last = given
        elif self.acts(t):
            assert self.kind.of_values is not None
            return self.kind.of_values(self, given)
        return given

    def replaced(self, values: Values, by: Values) -> Values:
        """The values with the fault's parts replaced by others; an attitude is replaced as a whole."""
        if self.whole == "attitude":
            return by
        return tuple(by[i] if i in self._parts else value for i, value in enumerate(values))

    def shifted(self, values: Values, error: Sequence[float]) -> Values:
        """The values with the fault's parts of an error added: of an attitude, a rotation about the body's axes."""
        error = [part if i in self._parts else 0.0 for i, part in enumerate(error)]
        if self.whole == "attitude":
            return _rotated(values, error)
        return tuple(value + part for value, part in zip(values, error, strict=True))


# ── what each kind does ──


def _missing(fault: ValueFault, values: Values) -> Values:
    if fault.whole == "motors":
        return fault.replaced(values, (0.0,) * fault.size)
    return (nan,) * len(values)  # on all axes: a rate with one axis missing is invalid


def _stuck(fault: ValueFault, values: Values) -> Values:
    fault.last = values if fault.last is None else fault.last
    return fault.replaced(values, fault.last)


def _biased(fault: ValueFault, values: Values) -> Values:
    return fault.shifted(values, [fault.value] * fault.size)


def _noisy(fault: ValueFault, values: Values) -> Values:
    return fault.shifted(values, (fault.value * fault.random.standard_normal(fault.size)).tolist())


def _late(fault: ValueFault, values: Values) -> Values:
    return fault.replaced(values, fault.earlier[0][1])  # those of `value` seconds ago


def _garbled(fault: ValueFault, values: Values) -> Values:
    if fault.whole != "attitude":
        return fault.replaced(values, tuple(fault.random.uniform(-fault.bound, fault.bound, fault.size).tolist()))
    w, x, y, z = fault.random.standard_normal(4).tolist()  # evenly distributed, once it has unit length
    length = hypot(w, x, y, z)
    return w / length, x / length, y / length, z / length


def _rotated(q: Values, error: Sequence[float]) -> Values:
    """`q ⊗ exp(error / 2)`; the error is a rotation vector in the body frame [rad]."""
    angle = hypot(*error)
    if angle == 0.0:
        return q
    scale = sin(angle / 2) / angle
    (w, x, y, z), (a, b, c), d = q, (scale * part for part in error), cos(angle / 2)
    return (
        w * d - x * a - y * b - z * c,
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
    )


def _drop_frames(fault: ActingFault, frames: list[bytes], t: float) -> list[bytes]:
    return [frame for frame in frames if not fault.acts(t)]


def _repeat_last_frame(fault: ActingFault, frames: list[bytes], t: float) -> list[bytes]:
    passed = []
    for frame in frames:
        if not fault.acts(t) or fault.last is None:
            fault.last = frame
        passed.append(fault.last)
    return passed


def _delay_frames(fault: ActingFault, frames: list[bytes], t: float) -> list[bytes]:
    """When the fault ends, all held frames pass at once, ahead of the newer ones."""
    active = fault.active(t)
    fault.changed += active * len(frames)
    fault.held.extend((round(t + fault.value, 9), frame) for frame in frames)
    passed = []
    while fault.held and (not active or fault.held[0][0] <= t):
        passed.append(fault.held.popleft()[1])
    return passed


def _garble_frames(fault: ActingFault, frames: list[bytes], t: float) -> list[bytes]:
    passed = []
    for frame in frames:
        garbled = bytearray(frame)
        if frame and fault.acts(t):
            bit = int(fault.random.integers(8 * len(frame)))
            garbled[bit // 8] ^= 0x80 >> bit % 8
        passed.append(bytes(garbled))
    return passed


def _duplicate_frames(fault: ActingFault, frames: list[bytes], t: float) -> list[bytes]:
    again = [frame for _, frame in fault.held]
    fault.held = deque((t, frame) for frame in frames if fault.acts(t))
    return again + frames


def _reorder_frames(fault: ActingFault, frames: list[bytes], t: float) -> list[bytes]:
    passed = []
    for frame in frames:
        if fault.held:
            passed += [frame, fault.held.popleft()[1]]
        elif fault.acts(t):
            fault.held.append((t, frame))
        else:
            passed.append(frame)
    return passed


# ── tables ──


class Kind(NamedTuple):
    """What a kind takes, what it changes things into, and what it does while it acts; None where it does not apply."""

    takes: Literal["nothing", "bias", "deviation", "delay", "probability"]
    changes: str
    of_values: Callable[[ValueFault, Values], Values] | None
    of_frames: Callable[[ActingFault, list[bytes], float], list[bytes]] | None


KINDS: Final = {
    # a sensor without a valid value, a motor at 0 V; nothing passes
    "off": Kind("nothing", "dropped", _missing, _drop_frames),
    # the last values, voltage or frame before the fault; a frame for each new one
    "stuck": Kind("nothing", "replaced by the last", _stuck, _repeat_last_frame),
    # the value is added [rad, rad/s, V]
    "bias": Kind("bias", "shifted", _biased, None),
    # Gaussian noise of this deviation is added [rad, rad/s, V]
    "noise": Kind("deviation", "made noisy", _noisy, None),
    # the values of some time ago [s]; frames pass so much later, in order
    "delay": Kind("delay", "delayed", _late, _delay_frames),
    # as off, by chance: of a sample, of a motor's period, of a frame
    "drop": Kind("probability", "dropped", _missing, _drop_frames),
    # by chance random values, or one random bit of a frame flipped
    "garble": Kind("probability", "garbled", _garbled, _garble_frames),
    # by chance a frame passes again a tick later
    "duplicate": Kind("probability", "duplicated", None, _duplicate_frames),
    # by chance a frame passes after the next one
    "reorder": Kind("probability", "reordered", None, _reorder_frames),
}
"""Every kind by its name in a fault."""


class Signal(NamedTuple):
    """A signal that a fault can act on."""

    whole: str  # sensor, motors or stream that it is, or is a part of
    part: int | None  # axis 0…2, or motor from 0; None for all of it
    kinds: tuple[str, ...]
    counted: str  # what a fault changes of it
    largest: float = 0.0  # bias and noise, in `unit`
    unit: str = ""


_OF_VALUES = tuple(name for name, kind in KINDS.items() if kind.of_values is not None)
_OF_FRAMES = tuple(name for name, kind in KINDS.items() if kind.of_frames is not None)
# In a unit quaternion no single axis can be old or random while the others are right.
_OF_ROTATIONS = ("off", "bias", "noise", "drop")
_ATTITUDE = ("samples", 3.1416, "rad")
_RATE = ("samples", 35.0, "rad/s")
_MOTOR = ("voltages", 48.0, "V")

SIGNALS: Final[dict[str, Signal]] = {
    "attitude": Signal("attitude", None, _OF_VALUES, *_ATTITUDE),
    **{f"attitude.{axis}": Signal("attitude", i, _OF_ROTATIONS, *_ATTITUDE) for i, axis in enumerate("xyz")},
    "rate": Signal("rate", None, _OF_VALUES, *_RATE),
    **{f"rate.{axis}": Signal("rate", i, _OF_VALUES, *_RATE) for i, axis in enumerate("xyz")},
    "motors": Signal("motors", None, _OF_VALUES, *_MOTOR),
    **{f"motor{i + 1}": Signal("motors", i, _OF_VALUES, *_MOTOR) for i in range(MAX_ACTUATORS)},
    "measurement": Signal("measurement", None, _OF_FRAMES, "measurements"),
    "command": Signal("command", None, _OF_FRAMES, "commands"),
}
"""Every signal by its name in a fault."""
