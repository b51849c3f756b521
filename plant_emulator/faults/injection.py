"""Faults at work on a plant's sensors, motors and frames, repeatable from a seed.

The endpoint asks `Faults`: motor faults change the voltages at the start of a period, sensor faults the sample at its
end, and `passes` takes the frames of either direction. Faults on one signal act one after another, in the order of
injection. Each has its own random numbers, so that another fault leaves its noise unchanged. Times are the plant's,
whole numbers of periods rounded to the nanosecond: a fault starts at exactly the tick of its start time.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from math import ceil, cos, hypot, inf, nan, sin
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from aeroloop.plant_emulator.faults.language import BY_CHANCE, SIGNALS, Fault, FaultError
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.models import FaultStatus

MAX_FAULTS: Final = 64  # that may act or be to come at the same time; as many that are over are remembered
GARBLED_RATE: Final = 10.0  # bound of a garbled angular velocity about each axis, ± [rad/s]

Random: TypeAlias = np.random.Generator
Source: TypeAlias = Literal["configured", "injected"]
Values: TypeAlias = tuple[float, ...]
Transition: TypeAlias = tuple[int, str]
"""A fault's begin, end or injection: when, in ticks of the plant's time, and one line that says what."""


def first_tick(time_s: float, period: float) -> int:
    """The first tick at or after a time [s]. Tick n is at n·period, rounded to the nanosecond."""
    tick = max(0, ceil(time_s / period) - 1)
    while round(tick * period, 9) < time_s:
        tick += 1
    return tick


class ActingFault:
    """A fault in the plant's time, injected at the time `now` [s].

    `last` is what its signal was just before: its values, or the frame that passed last; None if there were none.
    Garbled values are within ±`bound`. `changed` counts samples, voltages of a period, or frames that it has changed;
    `held` are frames held back, each with a time [s].
    """

    def __init__(
        self, fault: Fault, source: Source, random: Random, period: float, now: float, last: Any, bound: float
    ) -> None:
        self.fault, self.source, self.kind, self.value = fault, source, fault.kind, fault.value or 0.0
        self.begin = first_tick(round(fault.start_s + now, 9), period)
        self.end = inf if fault.end_s is None else first_tick(round(fault.end_s + now, 9), period)
        self.begun, self.over = False, self.begin == self.end  # `transitions` has returned them; none between two ticks
        self.changed = 0
        self.held: deque[tuple[float, bytes]] = deque()
        self._random, self._last, self._bound = random, last, bound
        self._whole, part = fault.target.whole, fault.target.part
        self._size = len(last) if self._whole == "motors" else 3  # components of an error
        self._parts = range(self._size) if part is None else (part,)
        self._earlier: deque[tuple[float, Values]] = deque([] if last is None else [(-inf, last)])  # for a delay

    def _active(self, tick: int) -> bool:
        return self.begin <= tick < self.end

    def _acts(self, tick: int) -> bool:
        """Whether it changes one sample or frame at a tick, which is counted; where by chance, chance decides."""
        acts = self._active(tick) and (self.kind not in BY_CHANCE or bool(self._random.random() < self.value))
        self.changed += acts
        return acts

    def transitions(self, now: int) -> list[Transition]:
        """Begin and end up to tick `now`, unless returned before."""
        found, fault = [], f"({self.source}): {self.fault}"
        if not (self.begun or self.over) and self.begin <= now:
            self.begun = True
            found.append((self.begin, f"fault begins {fault}"))
        if self.begun and not self.over and self.end <= now:
            self.over = True
            found.append((int(self.end), f"fault ends {fault}, {self.changed} {self.fault.effect}"))
        return found

    def status(self, first: int | None) -> FaultStatus:
        """Status; `first` is the plant's tick at which its time began, None if it has not."""
        return FaultStatus(
            fault=str(self.fault),
            source=self.source,
            begin_tick=None if first is None else first + self.begin,
            end_tick=None if first is None or self.end == inf else first + int(self.end),
            changed=self.changed,
            effect=self.fault.effect,
        )

    # ── values ──

    def values(self, given: Values, tick: int, t: float) -> Values:
        """The values of a tick, at the time t [s]. Call it at every sample: before the fault starts, it keeps them."""
        if self.kind == "delay":
            self._earlier.append((t, given))
            while len(self._earlier) > 1 and self._earlier[1][0] <= round(t - self.value, 9):
                self._earlier.popleft()
        if not self._active(tick):
            self._last = given
            return given
        if not self._acts(tick):
            return given
        match self.kind:
            case "off" | "drop":
                # Without one axis a rate is invalid, so a sensor has no value about any.
                return self._replaced(given, (0.0,) * self._size) if self._whole == "motors" else (nan,) * len(given)
            case "stuck":
                self._last = given if self._last is None else self._last
                return self._replaced(given, self._last)
            case "bias":
                return self._shifted(given, [self.value] * self._size)
            case "noise":
                return self._shifted(given, (self.value * self._random.standard_normal(self._size)).tolist())
            case "delay":
                return self._replaced(given, self._earlier[0][1])
        if self._whole != "attitude":
            return self._replaced(given, tuple(self._random.uniform(-self._bound, self._bound, self._size).tolist()))
        q = self._random.standard_normal(4).tolist()  # evenly distributed, once it has unit length
        return tuple(part / hypot(*q) for part in q)

    def _replaced(self, values: Values, by: Values) -> Values:
        """The values with the fault's parts replaced by others; an attitude is replaced as a whole."""
        if self._whole == "attitude":
            return by
        return tuple(by[i] if i in self._parts else value for i, value in enumerate(values))

    def _shifted(self, values: Values, error: Sequence[float]) -> Values:
        """The values with the fault's parts of an error added: of an attitude, a rotation about the body's axes."""
        error = [part if i in self._parts else 0.0 for i, part in enumerate(error)]
        if self._whole == "attitude":
            return _rotated(values, error)
        return tuple(value + part for value, part in zip(values, error, strict=True))

    # ── frames ──

    def frames(self, given: list[bytes], tick: int, t: float) -> list[bytes]:
        """The frames that pass at a tick, at the time t [s], in order, of those given and those held back."""
        passed: list[bytes] = []
        match self.kind:
            case "off" | "drop":
                return [frame for frame in given if not self._acts(tick)]
            case "duplicate":
                again = [frame for _, frame in self.held]
                self.held = deque((t, frame) for frame in given if self._acts(tick))
                return again + given
            case "delay":  # when it ends, all held frames pass at once, ahead of the newer ones
                active = self._active(tick)
                self.changed += active * len(given)
                self.held.extend((round(t + self.value, 9), frame) for frame in given)
                while self.held and (not active or self.held[0][0] <= t):
                    passed.append(self.held.popleft()[1])
                return passed
        for frame in given:
            if self.kind == "garble":
                passed.append(self._garbled(frame) if frame and self._acts(tick) else frame)
            elif self.kind == "stuck":
                if not self._acts(tick) or self._last is None:
                    self._last = frame
                passed.append(self._last)
            elif self.held:  # reorder
                passed += [frame, self.held.popleft()[1]]
            elif self._acts(tick):
                self.held.append((t, frame))
            else:
                passed.append(frame)
        return passed

    def forget_frames(self) -> None:
        """Forget the frames held back and the one that passed last."""
        self.held.clear()
        self._last = None

    def _garbled(self, frame: bytes) -> bytes:
        bit = int(self._random.integers(8 * len(frame)))
        garbled = bytearray(frame)
        garbled[bit // 8] ^= 0x80 >> bit % 8
        return bytes(garbled)


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


class Faults:
    """Faults of one plant's sensors, motors and frames. Before `start` none acts.

    `period` is the time of one `advance` [s], `voltage_limit` the largest voltage of a garbled command [V]. `ticks` are
    the periods since `start`, −1 before.
    """

    def __init__(self, actuators: int, period: float, *, voltage_limit: float = 24.0, seed: int = 0) -> None:
        self.ticks = -1
        self._actuators, self._period, self._limit, self._seed = actuators, period, voltage_limit, seed
        self._commanded: Values = (0.0,) * actuators
        self._applied = self._commanded
        self._seen: Measurement | None = None
        self._last_frame: dict[str, bytes] = {}
        self._injected: Counter[str] = Counter()
        self._known: list[ActingFault] = []  # in the order of injection, those that are over included
        self._acting: dict[str, list[ActingFault]] = {signal.whole: [] for signal in SIGNALS.values()}

    @property
    def time(self) -> float:
        """Time since `start`, rounded to the nanosecond [s]; 0 before."""
        return round(max(0, self.ticks) * self._period, 9)

    def start(self) -> None:
        """Start the time at 0. A second call does nothing."""
        if self.ticks < 0:
            self.ticks = 0
            self._seen = None

    # ── injection ──

    def inject(self, faults: Sequence[Fault], source: Source, *, clear: bool = False) -> list[Transition]:
        """Add faults with start and end counted from now; if `clear`, remove all others first, and return their ends.

        The current sample stays unchanged; frames that a removed fault holds back are lost. Raises FaultError if a
        fault is of a motor that the plant does not have, or there are too many; then nothing has changed.
        """
        for fault in faults:
            if fault.target.whole == "motors" and (fault.target.part or 0) >= self._actuators:
                there = ", ".join(f"motor{i + 1}" for i in range(self._actuators))
                raise FaultError(f"fault '{fault}': the plant has no {fault.signal}, but {there}")
        staying = 0 if clear else sum(not each.over for each in self._known)
        if staying + len(faults) > MAX_FAULTS:
            raise FaultError(f"a plant takes {MAX_FAULTS} faults at a time: `aeroloop op inject --clear` removes them")
        ends = self._clear() if clear else []
        over = [each for each in self._known if each.over]
        forgotten = over[: max(0, len(over) + len(faults) - MAX_FAULTS)]
        self._known = [each for each in self._known if each not in forgotten]
        for fault in faults:
            whole, seen = fault.target.whole, self._seen
            of_frames = whole in ("measurement", "command")
            number = self._injected[whole] if of_frames else self._injected.total()
            self._injected[whole] += 1
            # The signal's name is part of the seed, so that the two streams do not lose the same ticks.
            random = np.random.default_rng([self._seed, number, *fault.signal.encode()])
            last: Any = seen and (seen.attitude if whole == "attitude" else seen.rate)
            if of_frames:
                last = self._last_frame.get(whole)
            elif whole == "motors":
                last = self._applied
            bound = self._limit if whole == "motors" else GARBLED_RATE
            acting = ActingFault(fault, source, random, self._period, self.time, last, bound)
            self._acting[whole].append(acting)
            self._known.append(acting)
        return ends

    def _clear(self) -> list[Transition]:
        self._known = [each for each in self._known if each.begun]
        for each in self._known:
            if not each.over:
                each.end = self.ticks
        for faults in self._acting.values():
            faults.clear()
        self._applied = self._commanded
        return self.transitions()

    def transitions(self) -> list[Transition]:
        """Begins and ends up to now that were not returned before, in order of time."""
        found = [transition for each in self._known for transition in each.transitions(self.ticks)]
        return sorted(found, key=lambda transition: transition[0])

    def statuses(self, first: int | None) -> list[FaultStatus]:
        """Status of every fault in order; `first` is the plant's tick at `start`, None if there was none."""
        return [each.status(first) for each in self._known]

    # ── sensors and motors ──

    def voltages(self, commanded: Values) -> Values:
        """Voltages of the motors [V] in the period that begins, from those commanded. Shape (actuators,)."""
        self._commanded, self._applied = commanded, self._values("motors", commanded)
        return self._applied

    def advance(self, plant: Plant) -> None:
        """A period of the plant has passed."""
        self.ticks += self.ticks >= 0
        self._seen = None
        if self._acting["attitude"] or self._acting["rate"]:
            self.measure(plant)  # faults that hold or delay values need every sample

    def measure(self, plant: Plant) -> Measurement:
        """The plant's sensor values with their faults; the same until the next `advance`."""
        if self._seen is None:
            attitude, rate = plant.measure()
            w, x, y, z = self._values("attitude", attitude)
            a, b, c = self._values("rate", rate)
            self._seen = Measurement((w, x, y, z), (a, b, c))
        return self._seen

    def _values(self, whole: str, given: Values) -> Values:
        """Values after the faults of a signal, one after another."""
        if faults := self._acting[whole]:
            t = self.time if self.ticks >= 0 else -inf
            for fault in faults:
                given = fault.values(given, self.ticks, t)
            faults[:] = [fault for fault in faults if self.ticks < fault.end]
        return given

    # ── frames ──

    def passes(self, stream: Literal["measurement", "command"], frame: bytes | None) -> list[bytes]:
        """Pass the frame of a tick, if any, through the stream's faults. Returns the frames that pass now, in order."""
        frames = [] if frame is None else [frame]
        if faults := self._acting[stream]:
            for fault in faults:
                frames = fault.frames(frames, self.ticks, self.time if self.ticks >= 0 else -inf)
            faults[:] = [fault for fault in faults if self.ticks < fault.end or fault.held]
        if frames:
            self._last_frame[stream] = frames[-1]
        return frames

    def forget_frames(self) -> None:
        """Forget all frames, held back or last: those of another session must not act in this one."""
        self._last_frame.clear()
        for fault in (*self._acting["measurement"], *self._acting["command"]):
            fault.forget_frames()
