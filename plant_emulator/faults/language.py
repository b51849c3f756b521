"""Notation of faults; `injection` applies them.

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

from dataclasses import dataclass
from math import ulp
from typing import Final, Literal, NamedTuple, TypeAlias, get_args

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


@dataclass(frozen=True)
class Fault:
    """One kind of failure of one signal for a span of time.

    Raises:
        ValueError: What is wrong and what would be right, in one line.

    Attributes:
        signal: Sensor, motor or stream that fails, a key of SIGNALS.
        kind: Kind of failure.
        value: Size [the signal's unit, s or 1]; None for a kind without one.
        start_s: Start, in the plant's time [s].
        end_s: End [s]; None for none.
    """

    signal: str
    kind: Kind
    value: float | None = None
    start_s: float = 0.0
    end_s: float | None = None

    def __post_init__(self) -> None:
        if self.signal not in SIGNALS:
            raise ValueError(f"there is no signal {self.signal!r}; there are {_listed(SIGNALS)}")
        whole, _, kinds = SIGNALS[self.signal]
        if self.kind not in kinds:
            as_a_whole = f"; {whole} as a whole does" if self.kind in SIGNALS[whole].kinds else ""
            raise ValueError(f"{self.signal} takes no {self.kind!r}, but {_listed(kinds)}{as_a_whole}")
        self._check_value(whole)
        start, end = self.start_s, self.end_s
        if not 0 <= start <= MAX_TIME_S:
            raise ValueError(f"it must begin within 0 to {MAX_TIME_S:g} s, not at {_text(start)} s")
        if end is not None and not start < end <= MAX_TIME_S:
            raise ValueError(
                f"it must end after it begins at {_text(start)} s and by {MAX_TIME_S:g} s, not at {_text(end)} s"
            )

    def _check_value(self, whole: Whole) -> None:
        kind, value = self.kind, self.value
        if kind in ("bias", "noise"):
            high, unit = _SIZES[whole]
            low = 0.0 if kind == "noise" else -high
            words = f"{low:g} to {high:g} {unit}"
        elif kind in _VALUES:
            low, high, words = _VALUES[kind]
        elif value is None:
            return
        else:
            raise ValueError(f"{kind} takes no value, but was given {_text(value)}: write {kind} alone")
        if value is None:
            raise ValueError(f"{kind} takes {words}: write {kind}=0.1, say")
        if not low <= value <= high:
            raise ValueError(f"{kind} takes {words}, not {_text(value)}")

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Parse `signal:kind[=value][@start[..end]]`.

        Raises:
            ValueError: One line with the text and the error in it.
        """
        what, at, when = text.strip().partition("@")
        signal, colon, failure = what.partition(":")
        kind, equals, value = failure.partition("=")
        start, dots, end = when.partition("..")
        try:
            if not colon:
                raise ValueError("it is written signal:kind[=value][@start[..end]], such as attitude:off@5")
            return cls(
                signal,
                kind,  # type: ignore[arg-type]  # a text until it is checked
                _number(value) if equals else None,
                _number(start) if at else 0.0,
                _number(end) if dots else None,
            )
        except ValueError as error:
            raise ValueError(f"fault {text!r}: {error}") from None

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
