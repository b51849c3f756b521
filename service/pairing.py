"""Which command answered which measurement, and at which tick of the law: what every reader of a log builds on.

The law's tick is not in a frame, only its counter modulo 16. Telemetry says both now and then, and the session's first
tick always; from there the counter is unwrapped, over gaps with the help of the times of publication. Those times also
say which measurement a command answers: the latest before it that had its echo for a counter, as for the plant.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from typing import Final, NamedTuple

from protocol.clock import LoopSettings
from protocol.frames import COUNTERS, TickCounter, WireSpec
from protocol.messages import Telemetry

MAX_WAITING: Final = 4096
"""Measurements kept while no telemetry has yet said which tick they are."""


class Seen(NamedTuple):
    """A frame out of the log."""

    frame: bytes
    published_ns: int


class Pairing(ABC):
    """One session's frames, put together as they are read.

    Args:
        wire: How its frames are read.
        loop: Its grid.

    Attributes:
        malformed: Frames so far that could not be read.
    """

    def __init__(self, wire: WireSpec, loop: LoopSettings) -> None:
        self._wire = wire
        self._loop = loop
        self._waiting: deque[Seen] = deque(maxlen=MAX_WAITING)  # measurements whose tick is not known yet
        self._anchors: deque[tuple[Telemetry, int]] = deque(maxlen=MAX_WAITING)  # and what could tell it
        self._commands: deque[Seen] = deque(maxlen=MAX_WAITING)  # commands whose measurement may still be to come
        self._measured: deque[tuple[int, Seen]] = deque()  # measurements that no command has answered yet
        self._ticks: TickCounter | None = None  # once it is known where it starts
        self.malformed = 0

    @abstractmethod
    def answered(self, k: int, measurement: Seen, command: bytes, codes: tuple[float, ...]) -> None:
        """A measurement that a command answered, at tick k; the command's frame and its codes."""

    @abstractmethod
    def passed_over(self, k: int, measurement: Seen) -> None:
        """A measurement that no command answered, while one answered a later one."""

    def measurement(self, seen: Seen) -> None:
        """A measurement frame; commands that were published before it can now be told which tick they answer."""
        counter = self._counter(seen)
        if counter is None:
            self.malformed += 1
        elif self._ticks is None:
            self._waiting.append(seen)
            self._anchor(seen.published_ns)
        else:
            self._answer(seen.published_ns)
            if (k := self._ticks.advance(counter, seen.published_ns)) is not None:
                self._measured.append((k, seen))

    def command(self, seen: Seen) -> None:
        """A command frame. The recorder has it from another link than the measurements, so it may come before them."""
        self._commands.append(seen)

    def telemetry(self, telemetry: Telemetry, published_ns: int) -> None:
        """Which tick a counter stood for; the first that can be matched tells it for the whole session."""
        if self._ticks is None:
            self._anchors.append((telemetry, published_ns))

    def finish(self) -> None:
        """No more is to come: what still waits is judged by what there is."""
        self._anchor(None)
        self._answer(None)

    def _anchor(self, until_ns: int | None) -> None:
        """Match telemetry from before `until_ns` with the latest measurement before it that had its counter."""
        while self._ticks is None and self._anchors and (until_ns is None or self._anchors[0][1] < until_ns):
            telemetry, published_ns = self._anchors.popleft()
            waiting = list(self._waiting)
            for i in reversed(range(len(waiting))):
                if waiting[i].published_ns < published_ns and self._counter(waiting[i]) == telemetry.counter:
                    self._waiting.clear()
                    loop = self._loop
                    first = self._first_tick(waiting[: i + 1], telemetry.tick)
                    self._ticks = TickCounter(loop.period_ns, lockstep=loop.lockstep, tick=first - 1)
                    for seen in waiting:
                        self.measurement(seen)
                    break
            # else: the measurement that it speaks of came before the log began

    def _answer(self, until_ns: int | None) -> None:
        """Put together the commands published before `until_ns`, each with the latest measurement before of its echo.

        Zenoh's timestamps are hybrid logical clocks: an answer is always stamped later than its question, on any host.
        """
        while self._commands and (until_ns is None or self._commands[0].published_ns < until_ns):
            seen = self._commands.popleft()
            read = self._wire.command.unpack(seen.frame)
            if read is None:
                self.malformed += 1
                continue
            echo, codes = read
            answered = next(
                (
                    k
                    for k, measured in reversed(self._measured)
                    if k % COUNTERS == echo and measured.published_ns < seen.published_ns
                ),
                None,
            )
            if answered is None:
                continue  # answers what the log does not have, or repeats an answer
            while self._measured[0][0] < answered:
                self.passed_over(*self._measured.popleft())
            self.answered(*self._measured.popleft(), seen.frame, codes)

    def _counter(self, seen: Seen) -> int | None:
        read = self._wire.measurement.unpack(seen.frame)
        return None if read is None else read[0]

    def _first_tick(self, frames: list[Seen], tick: int) -> int:
        """The tick of the first of some measurements, the last of which is at `tick`, by counting down."""
        for seen in reversed(frames[:-1]):
            counter = self._counter(seen)
            assert counter is not None  # malformed ones never get here
            tick -= (tick - counter) % COUNTERS or COUNTERS
        return max(0, tick)
