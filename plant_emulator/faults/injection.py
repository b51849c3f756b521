"""Faults at work on a plant's sensors, motors and frames, repeatable from a seed.

A FaultyPlant wraps any plant: motor faults change the voltages at the start of a period, sensor faults the sample at
its end, and `passes` takes the frames of either direction. Faults on one signal act one after another, in the order of
injection. Each has its own random numbers, so that another fault leaves its noise unchanged.

Times are the plant's, whole numbers of periods rounded to the nanosecond: a fault starts at exactly the tick of its
start time. So the ticks of its begin and end follow from the fault and the tick of its injection alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import ceil, inf
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from aeroloop.plant_emulator.faults.language import SIGNALS, ActingFault, Fault, FaultError, ValueFault
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.messages.models import FaultStatus

MAX_FAULTS: Final = 64
"""Faults that may act or be to come at the same time; as many that are over are remembered."""

GARBLED_RATE: Final = 10.0
"""Bound of a garbled angular velocity about each axis, ± [rad/s]."""

Source: TypeAlias = Literal["configured", "injected"]


class FaultTransition(NamedTuple):
    """A fault's begin, end or injection: when, in ticks of the plant's time, and one line that says what."""

    tick: int
    text: str


class ScheduledFault:
    """A fault with the ticks at which it begins and ends, in periods since the plant's time began; None for no end."""

    def __init__(self, acting: ActingFault, source: Source, period: float) -> None:
        self.acting, self.source = acting, source
        self.begin = first_tick(acting.start, period)
        self.end = None if acting.end == inf else first_tick(acting.end, period)
        self.begun = False
        self.over = self.begin == self.end  # it lies between two ticks

    def transitions(self, now: int) -> list[FaultTransition]:
        """Its begin and end up to tick `now`, unless returned before."""
        found, fault = [], f"({self.source}): {self.acting.fault}"
        if not (self.begun or self.over) and self.begin <= now:
            self.begun = True
            found.append(FaultTransition(self.begin, f"fault begins {fault}"))
        if self.begun and not self.over and self.end is not None and self.end <= now:
            self.over = True
            text = f"fault ends {fault}, {self.acting.changed} {self.acting.fault.effect}"
            found.append(FaultTransition(self.end, text))
        return found

    def status(self, first: int | None) -> FaultStatus:
        """Its status; `first` is the plant's tick at which its time began, None if it has not."""
        return FaultStatus(
            fault=str(self.acting.fault),
            source=self.source,
            begin_tick=None if first is None else first + self.begin,
            end_tick=None if first is None or self.end is None else first + self.end,
            changed=self.acting.changed,
            effect=self.acting.fault.effect,
        )


def first_tick(time_s: float, period: float) -> int:
    """The first tick at or after a time [s]. Tick n is at n·period, rounded to the nanosecond."""
    tick = max(0, ceil(time_s / period) - 1)
    while round(tick * period, 9) < time_s:
        tick += 1
    return tick


class FaultyPlant(Plant):
    """A plant with faults of its sensors, motors and frames. Before `start` no fault acts.

    `period` is the time of one `advance` [s], `voltage_limit` the largest voltage of a garbled command [V]; `seed` is 0
    or more.

    Attributes:
        plant: The plant without its faults.
        ticks: Periods since `start`; −1 before.
    """

    def __init__(self, plant: Plant, period: float, *, voltage_limit: float, seed: int = 0) -> None:
        self.plant = plant
        self.actuators, self.paces = plant.actuators, plant.paces
        self.ticks = -1
        self._period, self._limit, self._seed = period, voltage_limit, seed
        self._commanded: tuple[float, ...] = (0.0,) * plant.actuators
        self._applied = self._commanded
        self._actuated = False  # since the last period
        self._seen: Measurement | None = None
        self._last_frame: dict[str, bytes] = {}
        self._injected: Counter[str] = Counter()
        self._scheduled: list[ScheduledFault] = []
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

    def inject(self, faults: Sequence[Fault], source: Source, *, clear: bool = False) -> list[FaultTransition]:
        """Add faults with start and end counted from now; if `clear`, remove all others first.

        The current sample stays unchanged; frames that a removed fault holds back are lost.

        Returns:
            The ends of the faults removed.

        Raises:
            FaultError: A fault of a motor that the plant does not have, or too many faults. Then nothing has changed.
        """
        for fault in faults:
            if fault.target.whole == "motors" and (fault.target.part or 0) >= self.actuators:
                there = ", ".join(f"motor{i + 1}" for i in range(self.actuators))
                raise FaultError(f"fault '{fault}': the plant has no {fault.signal}, but {there}")
        staying = 0 if clear else sum(not each.over for each in self._scheduled)
        if staying + len(faults) > MAX_FAULTS:
            raise FaultError(f"a plant takes {MAX_FAULTS} faults at a time: `aeroloop op inject --clear` removes them")
        ends = self._clear() if clear else []
        over = [each for each in self._scheduled if each.over]
        forgotten = over[: max(0, len(over) + len(faults) - MAX_FAULTS)]
        self._scheduled = [each for each in self._scheduled if each not in forgotten]
        for fault in faults:
            acting = self._at_work(fault)
            self._acting[fault.target.whole].append(acting)
            self._scheduled.append(ScheduledFault(acting, source, self._period))
        return ends

    def _at_work(self, fault: Fault) -> ActingFault:
        whole, seen = fault.target.whole, self._seen
        of_frames = whole in ("measurement", "command")
        number = self._injected[whole] if of_frames else self._injected.total()
        self._injected[whole] += 1
        # The signal's name is part of the seed, so that the two streams do not lose the same ticks.
        random = np.random.default_rng([self._seed, number, *fault.signal.encode()])
        if of_frames:
            return ActingFault(fault, random, self.time, self._last_frame.get(whole))
        if whole == "motors":
            return ValueFault(fault, random, self.time, self._applied, self._limit)
        last = seen and (seen.attitude if whole == "attitude" else seen.rate)
        return ValueFault(fault, random, self.time, last, GARBLED_RATE)

    def _clear(self) -> list[FaultTransition]:
        self._scheduled = [each for each in self._scheduled if each.begun]
        for each in self._scheduled:
            if not each.over:
                each.end = self.ticks
        self._stop_acting()
        if self._applied != self._commanded:
            self.plant.actuate(self._commanded)
            self._applied = self._commanded
        return self.transitions()

    def _stop_acting(self) -> None:
        for faults in self._acting.values():
            faults.clear()

    def transitions(self) -> list[FaultTransition]:
        """Begins and ends up to now that were not returned before, in order of time."""
        found = [transition for each in self._scheduled for transition in each.transitions(self.ticks)]
        return sorted(found, key=lambda transition: transition.tick)

    def statuses(self, first: int | None) -> list[FaultStatus]:
        """Status of every fault in order; `first` is the plant's tick at `start`, None if there was none."""
        return [each.status(first) for each in self._scheduled]

    # ── sensors and motors ──

    def actuate(self, voltages: Sequence[float]) -> None:
        """Put voltages [V] through the motor faults on the motors. Shape (actuators,)."""
        self._commanded = tuple(voltages)
        self._actuated = True
        self._applied = self._through("motors", self._commanded)
        self.plant.actuate(self._applied)

    def advance(self) -> None:
        """Let one period pass."""
        if self._acting["motors"] and not self._actuated:
            self.actuate(self._commanded)  # a motor also fails and recovers while a voltage is held
        self._actuated = False
        self.plant.advance()
        self.passed = self.plant.passed
        if self.ticks >= 0:
            self.ticks += 1
        self._seen = None
        if self._acting["attitude"] or self._acting["rate"]:
            self.measure()  # faults that hold or delay values need every sample

    def measure(self) -> Measurement:
        """Sensor values with their faults; the same until the next `advance`."""
        if self._seen is None:
            attitude, rate = self.plant.measure()
            w, x, y, z = self._through("attitude", attitude)
            a, b, c = self._through("rate", rate)
            self._seen = Measurement((w, x, y, z), (a, b, c))
        return self._seen

    def close(self) -> None:
        """Remove all faults and set 0 V."""
        self._stop_acting()
        self._commanded = self._applied = (0.0,) * self.actuators
        self.plant.close()

    # ── frames ──

    def passes(self, stream: Literal["measurement", "command"], frame: bytes | None) -> list[bytes]:
        """Pass the frame of a tick, if any, through the stream's faults. Returns the frames that pass now, in order."""
        frames: list[bytes] = self._through(stream, [] if frame is None else [frame])
        if frames:
            self._last_frame[stream] = frames[-1]
        return frames

    def forget_frames(self) -> None:
        """Drop the frames held back: they belong to the last session's keys."""
        for fault in (*self._acting["measurement"], *self._acting["command"]):
            fault.held.clear()

    def _through(self, whole: str, given: Any) -> Any:
        """Values or frames after the faults of a signal, one after another."""
        if faults := self._acting[whole]:
            t = self.time if self.ticks >= 0 else -inf
            for fault in faults:
                given = fault.apply(given, t)
            faults[:] = [fault for fault in faults if t < fault.end or fault.held]
        return given
