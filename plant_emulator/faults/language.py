"""Faults: their notation, and the tables of signals and kinds.

A fault is written `signal:kind[=value][@start[..end]]`, in seconds of the plant's time. Without a start it acts at
once, without an end for ever:

    attitude:off@5    rate.y:bias=0.1@2..4    motor2:stuck@3    command:drop=0.05    measurement:delay=0.02@0..10

`attitude` and `rate` take an axis of the body, `.x .y .z`; bias and noise of the attitude are rotations about the
body's axes. Motors are numbered from 1; `motors` fails all of them at the same times. README.md has the limits of the
values, with their reasons.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ulp
from typing import Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.spec import MAX_ACTUATORS

MAX_DELAY_S: Final = 10.0
MAX_TIME_S: Final = 1e8  # latest begin and end; three years

KINDS: Final = {  # what each changes things into
    "off": "dropped",  # a sensor without a valid value, a motor at 0 V; no frame passes
    "stuck": "replaced by the last",  # the values, voltage or frame before the fault; a frame for each new one
    "bias": "shifted",  # the value is added [rad, rad/s, V]
    "noise": "made noisy",  # Gaussian noise of this deviation is added [rad, rad/s, V]
    "delay": "delayed",  # the values of some time ago [s]; frames pass so much later, in order
    "drop": "dropped",  # as off, by chance: of a sample, of a motor's period, of a frame
    "garble": "garbled",  # by chance random values, or one random bit of a frame flipped
    "duplicate": "duplicated",  # by chance a frame passes again a tick later
    "reorder": "reordered",  # by chance a frame passes after the next one
}
BY_CHANCE: Final = ("drop", "garble", "duplicate", "reorder")  # their value is a probability


class Signal(NamedTuple):
    """What a fault can act on."""

    whole: str  # sensor, motors or stream that it is, or is a part of
    part: int | None  # axis 0…2, or motor from 0; None for all of it
    kinds: tuple[str, ...]
    counted: str  # what a fault changes of it
    largest: float = 0.0  # bias and noise, in `unit`
    unit: str = ""


_OF_VALUES = ("off", "stuck", "bias", "noise", "delay", "drop", "garble")
_OF_FRAMES = ("off", "stuck", "delay", "drop", "garble", "duplicate", "reorder")
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


class FaultError(AeroloopError, ValueError):
    """A fault that is none, or cannot be injected; one line that says why."""


@dataclass(frozen=True)
class Fault:
    """One kind of failure of one signal for a span of time. Raises ValueError with what is right."""

    signal: str  # a key of SIGNALS
    kind: str  # a key of KINDS
    value: float | None = None  # size [the signal's unit, s or 1]; None for a kind without one
    start_s: float = 0.0
    end_s: float | None = None  # None for none

    def __post_init__(self) -> None:
        if self.signal not in SIGNALS:
            raise ValueError(f"there is no signal {self.signal!r}; there are {', '.join(SIGNALS)}")
        whole, kinds = self.target.whole, self.target.kinds
        if self.kind not in kinds:
            as_a_whole = f"; {whole} as a whole does" if self.kind in SIGNALS[whole].kinds else ""
            raise ValueError(f"{self.signal} takes no {self.kind!r}, but {', '.join(kinds)}{as_a_whole}")
        self._check_value()
        start, end = self.start_s, self.end_s
        if not 0 <= start <= MAX_TIME_S:
            raise ValueError(f"it must begin within 0 to {MAX_TIME_S:g} s, not at {_text(start)} s")
        if end is not None and not start < end <= MAX_TIME_S:
            after = f"after it begins at {_text(start)} s and by {MAX_TIME_S:g} s"
            raise ValueError(f"it must end {after}, not at {_text(end)} s")

    def _check_value(self) -> None:
        kind, value, (*_, largest, unit) = self.kind, self.value, self.target
        if kind in ("off", "stuck"):
            if value is not None:
                raise ValueError(f"{kind} takes no value, but was given {_text(value)}: write {kind} alone")
            return
        if kind in BY_CHANCE:
            low, high, words = ulp(0.0), 1.0, "a probability above 0 and up to 1"
        elif kind == "delay":
            low, high, words = 0.0, MAX_DELAY_S, f"0 to {MAX_DELAY_S:g} s"
        else:
            low, high = -largest if kind == "bias" else 0.0, largest
            words = f"{low:g} to {largest:g} {unit}"
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
            size = float(value) if equals else None
            return cls(signal, kind, size, float(start) if at else 0.0, float(end) if dots else None)
        except ValueError as error:
            raise FaultError(f"fault {text!r}: {error}") from None

    def __str__(self) -> str:
        value = "" if self.value is None else f"={_text(self.value)}"
        start = f"@{_text(self.start_s)}" if self.start_s or self.end_s is not None else ""
        end = "" if self.end_s is None else f"..{_text(self.end_s)}"
        return f"{self.signal}:{self.kind}{value}{start}{end}"

    @property
    def target(self) -> Signal:
        """What it acts on."""
        return SIGNALS[self.signal]

    @property
    def effect(self) -> str:
        """What it does to what, after a number: `commands dropped`."""
        return f"{self.target.counted} {KINDS[self.kind]}"


def _text(value: float) -> str:
    return repr(value).removesuffix(".0")  # reads back as the same float
