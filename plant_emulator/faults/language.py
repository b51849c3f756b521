"""Notation of faults; `signals` and `streams` apply them.

A fault is written `signal:kind[=value][@start[..end]]`, in seconds of the plant's time. Without a start it acts at
once, without an end for ever:

    attitude:off@5    rate.y:bias=0.1@2..4    motor2:stuck@3    command:drop=0.05    measurement:delay=0.02@0..10

            sensors (attitude, rate)             motors                        streams (measurement, command)
off         no valid value                       0 V                           nothing passes
stuck       the last value before the fault      the last voltage before it    the last frame before, for each new one
bias=v      v is added [rad], [rad/s]            v is added [V]
noise=σ     Gaussian noise [rad], [rad/s]        Gaussian noise [V]
delay=s     the values of s seconds ago          the voltage of s seconds ago  frames pass s seconds later, in order
drop=p      no valid value                       0 V for a period              a frame is lost
garble=p    a random value                       a random voltage              one random bit of a frame is flipped
duplicate=p                                                                    a frame passes again a tick later
reorder=p                                                                      a frame passes after the next one

p is the probability per sample, period or frame. `attitude` and `rate` take an axis of the body, `.x .y .z`; bias and
noise of the attitude are rotations about the body's axes. Motors are numbered from 1 in the order of the commanded
voltages; `motors` fails all of them at the same times. README.md has the limits of the values, with their reasons.
"""

from __future__ import annotations

from math import ceil, ulp
from typing import Final, Literal, NamedTuple, TypeAlias, get_args

from pydantic import BaseModel, Field, ValidationError, ValidationInfo, field_validator

from aeroloop.protocol.wire.spec import MAX_ACTUATORS

Kind: TypeAlias = Literal["off", "stuck", "bias", "noise", "delay", "drop", "garble", "duplicate", "reorder"]
Whole: TypeAlias = Literal["attitude", "rate", "motors", "measurement", "command"]

MAX_DELAY_S: Final = 10.0
MAX_TIME_S: Final = 1e8
"""Latest begin and end [s]; three years."""
MAX_ANGLE: Final = 3.1416
"""Largest bias and noise of an attitude [rad]: half a turn, π rounded up."""
MAX_RATE: Final = 35.0
"""Largest bias and noise of an angular velocity [rad/s]: 2000 °/s, the full scale of common gyroscopes."""
MAX_VOLTS: Final = 48.0
"""Largest bias and noise of a voltage [V]: from one end of the Aero's supply of ±24 V to the other."""


class Signal(NamedTuple):
    """A signal that a fault can act on.

    Attributes:
        whole: Sensor, motors or stream that it is, or is a part of.
        part: Axis 0…2, or motor from 0; None for all of it.
        kinds: Kinds of faults that it takes.
    """

    whole: Whole
    part: int | None
    kinds: tuple[Kind, ...]


_ALL_KINDS: tuple[Kind, ...] = get_args(Kind)
_OF_VALUES = _ALL_KINDS[:7]
_OF_FRAMES: tuple[Kind, ...] = ("off", "stuck", "delay", "drop", "garble", "duplicate", "reorder")
# In a unit quaternion no single axis can be old or random while the others are right.
_OF_ROTATIONS: tuple[Kind, ...] = ("off", "bias", "noise", "drop")

SIGNALS: Final[dict[str, Signal]] = {
    "attitude": Signal("attitude", None, _OF_VALUES),
    **{f"attitude.{axis}": Signal("attitude", i, _OF_ROTATIONS) for i, axis in enumerate("xyz")},
    "rate": Signal("rate", None, _OF_VALUES),
    **{f"rate.{axis}": Signal("rate", i, _OF_VALUES) for i, axis in enumerate("xyz")},
    "motors": Signal("motors", None, _OF_VALUES),
    **{f"motor{i + 1}": Signal("motors", i, _OF_VALUES) for i in range(MAX_ACTUATORS)},
    "measurement": Signal("measurement", None, _OF_FRAMES),
    "command": Signal("command", None, _OF_FRAMES),
}
"""Every signal by its name in a fault."""

_PROBABILITY = (ulp(0.0), 1.0, "a probability above 0 and up to 1")
_VALUES: Final[dict[Kind, tuple[float, float, str]]] = {
    "delay": (0.0, MAX_DELAY_S, f"0 to {MAX_DELAY_S:g} s"),
    "drop": _PROBABILITY,
    "garble": _PROBABILITY,
    "duplicate": _PROBABILITY,
    "reorder": _PROBABILITY,
}
"""Range of each kind's value, in numbers and in words; of bias and noise, `_SIZES` has it. Others take no value."""
_SIZES: Final[dict[Whole, tuple[float, str]]] = {
    "attitude": (MAX_ANGLE, "rad"),
    "rate": (MAX_RATE, "rad/s"),
    "motors": (MAX_VOLTS, "V"),
}
"""Largest bias and noise of each signal, and their unit."""

_CHANGES: Final[dict[Kind, str]] = {
    "off": "dropped",
    "stuck": "replaced by the last",
    "bias": "shifted",
    "noise": "made noisy",
    "delay": "delayed",
    "drop": "dropped",
    "garble": "garbled",
    "duplicate": "duplicated",
    "reorder": "reordered",
}
_CHANGED: Final[dict[Whole, str]] = {
    "attitude": "samples",
    "rate": "samples",
    "motors": "voltages",
    "measurement": "measurements",
    "command": "commands",
}


class Fault(BaseModel, frozen=True, extra="forbid"):
    """One kind of failure of one signal for a span of time.

    Raises:
        ValidationError: A ValueError; each of its messages is one line. `parse` raises a ValueError of one line.
    """

    signal: str = Field(description="sensor, motor or stream that fails")
    kind: Kind = Field(description="kind of failure")
    value: float | None = Field(default=None, validate_default=True, description="size [signal's unit, s or 1]")
    start_s: float = Field(default=0.0, description="start, in the plant's time [s]")
    end_s: float | None = Field(default=None, description="end [s]; none if left out")

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Parse `signal:kind[=value][@start[..end]]`.

        Raises:
            ValueError: One line with the text and the error in it.
        """
        try:
            return cls._parse(text.strip())
        except ValidationError as error:
            reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        except ValueError as error:
            reason = str(error)
        raise ValueError(f"fault {text!r}: {reason}")

    @classmethod
    def _parse(cls, text: str) -> Fault:
        what, at, when = text.partition("@")
        signal, colon, failure = what.partition(":")
        if not colon:
            raise ValueError("it is written signal:kind[=value][@start[..end]], such as attitude:off@5")
        kind, equals, value = failure.partition("=")
        start, dots, end = when.partition("..")
        return cls(
            signal=signal,
            kind=kind,  # type: ignore[arg-type]  # a text until it is validated
            value=_number(value) if equals else None,
            start_s=_number(start) if at else 0.0,
            end_s=_number(end) if dots else None,
        )

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
        return f"{_CHANGED[self.target.whole]} {_CHANGES[self.kind]}"

    def active(self, t: float) -> bool:
        """Whether it acts at time t [s]: start ≤ t < end."""
        return self.start_s <= t and not self.over(t)

    def over(self, t: float) -> bool:
        """Whether it has ended by time t [s]."""
        return self.end_s is not None and t >= self.end_s

    def later(self, by: float) -> Fault:
        """The same fault, `by` [s] later, rounded to the nanosecond as ticks are."""
        end = None if self.end_s is None else round(self.end_s + by, 9)
        return self.model_copy(update={"start_s": round(self.start_s + by, 9), "end_s": end})

    @field_validator("signal")
    @classmethod
    def _is_a_signal(cls, signal: str) -> str:
        if signal not in SIGNALS:
            raise ValueError(f"there is no signal {signal!r}; there are {_listed(SIGNALS)}")
        return signal

    @field_validator("kind", mode="before")
    @classmethod
    def _happens_to_the_signal(cls, kind: object, info: ValidationInfo) -> object:
        if (name := info.data.get("signal")) is None:
            return kind
        signal = SIGNALS[name]
        if kind not in signal.kinds:
            as_a_whole = f"; {signal.whole} as a whole does" if kind in SIGNALS[signal.whole].kinds else ""
            raise ValueError(f"{name} takes no {kind!r}, but {_listed(signal.kinds)}{as_a_whole}")
        return kind

    @field_validator("value")
    @classmethod
    def _is_what_the_kind_takes(cls, value: float | None, info: ValidationInfo) -> float | None:
        if (kind := info.data.get("kind")) is None:
            return value
        if kind in ("bias", "noise"):
            high, unit = _SIZES[SIGNALS[info.data["signal"]].whole]
            low = 0.0 if kind == "noise" else -high
            words = f"{low:g} to {high:g} {unit}"
        elif kind in _VALUES:
            low, high, words = _VALUES[kind]
        elif value is None:
            return value
        else:
            raise ValueError(f"{kind} takes no value, but was given {_text(value)}: write {kind} alone")
        if value is None:
            raise ValueError(f"{kind} takes {words}: write {kind}=0.1, say")
        if not low <= value <= high:
            raise ValueError(f"{kind} takes {words}, not {_text(value)}")
        return value

    @field_validator("start_s")
    @classmethod
    def _starts_in_time(cls, start: float) -> float:
        if not 0 <= start <= MAX_TIME_S:
            raise ValueError(f"it must begin within 0 to {MAX_TIME_S:g} s, not at {_text(start)} s")
        return start

    @field_validator("end_s")
    @classmethod
    def _ends_after_its_start(cls, end: float | None, info: ValidationInfo) -> float | None:
        start = info.data.get("start_s")
        if end is not None and start is not None and not start < end <= MAX_TIME_S:
            raise ValueError(
                f"it must end after it begins at {_text(start)} s and by {MAX_TIME_S:g} s, not at {_text(end)} s"
            )
        return end


def first_tick(time_s: float, period: float) -> int:
    """The first tick at or after a time [s]. Tick n is at n·period, rounded to the nanosecond."""
    tick = max(0, ceil(time_s / period) - 1)
    while round(tick * period, 9) < time_s:
        tick += 1
    return tick


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a number") from None


def _text(value: float) -> str:
    """The shortest text that reads back as the same float."""
    return repr(value).removesuffix(".0")


def _listed(words: dict[str, Signal] | tuple[Kind, ...]) -> str:
    *most, last = words
    return f"{', '.join(most)} and {last}"
