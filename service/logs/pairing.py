"""Which command answered which measurement, and at which tick of the law: what every reader of a log builds on.

The law's tick is not in a frame, only its counter modulo 16. Telemetry says both now and then, and the session's first
tick always; from there the counter is unwrapped, over gaps with the help of the times of publication. Those times also
say which measurement a command answers: the latest before it that had its echo for a counter, as for the plant. Where
an end sends only what is new, filling.py gives a frame for every tick first.
"""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Final, NamedTuple, TypeVar

from protocol.clock import LoopSettings
from protocol.frames import TickCounter
from protocol.messages import Lapse, Telemetry
from protocol.topics import Address
from protocol.wire import WireSpec
from service.logs.files import Which
from service.logs.filling import Filler, Lapses, Read

MAX_WAITING: Final = 4096
"""Measurements kept while no telemetry has yet said which tick they are."""

_NEVER_NS: Final = 1 << 64
"""Later than any time of publication."""


class Pair(NamedTuple):
    """A measurement, the command that answered it, and the measurements before it that none did."""

    measurement: Read
    command: Read
    before: list[Read]


class Pairing(ABC):
    """One session's frames, put together as they are read.

    Args:
        wire: How its frames are read.
        loop: Its grid.
        lapses: Where its controller did not compute with the plant's levels.

    Attributes:
        malformed: Frames so far that could not be read.
    """

    def __init__(self, wire: WireSpec, loop: LoopSettings, lapses: Sequence[Lapse] = ()) -> None:
        self._wire = wire
        self._counters = wire.measurement.counters
        self._measurement_counter, self._command_counter = wire.measurement.counter, wire.command.counter
        transmit = wire.transmit
        self._fill_measurements = (
            Filler(wire.measurement, loop, on_grid=True) if transmit.measurement == "on_change" else None
        )
        self._fill_commands = Filler(wire.command, loop, on_grid=False) if transmit.command == "on_change" else None
        self._lapses = Lapses(lapses, wire.measurement) if lapses else None
        self._loop = loop
        self._measured: deque[Read] = deque(maxlen=MAX_WAITING)  # not answered yet
        self._commands: deque[Read] = deque(maxlen=MAX_WAITING)  # commands whose measurement may still be to come
        self._pairs: deque[Pair] = deque(maxlen=MAX_WAITING)  # whose tick is not known yet
        self._anchors: deque[tuple[Telemetry, int]] = deque(maxlen=MAX_WAITING)  # and what could tell it
        self._ticks: TickCounter | None = None  # once it is known where it starts
        self._last_counter = -1  # of the measurement that was answered last
        self.malformed = 0

    @property
    def wants_telemetry(self) -> bool:
        """Whether telemetry can still tell it anything."""
        return self._ticks is None

    @abstractmethod
    def answered(self, k: int, measurement: Read, command: Read) -> None:
        """A measurement that a command answered, at tick k."""

    @abstractmethod
    def passed_over(self, k: int, measurement: Read) -> None:
        """A measurement that no command answered, while one answered a later one."""

    @abstractmethod
    def measured(self, frame: bytes, published_ns: int) -> None:
        """A measurement that can be read, whatever becomes of it."""

    @abstractmethod
    def commanded(self, frame: bytes) -> None:
        """A command that can be read, whatever it answers."""

    def measurement(self, frame: bytes, published_ns: int) -> None:
        """A measurement frame; commands that were published before it can now be told which tick they answer."""
        if self._fill_measurements is not None:
            self._filled(self._fill_measurements.reads(frame, published_ns), self._take_measurement)
            return
        counter = self._measurement_counter(frame)
        if counter is None:
            self.malformed += 1
            return
        self._take_measurement(Read(counter, frame, published_ns, published_ns))

    def command(self, frame: bytes, published_ns: int) -> None:
        """A command frame. The recorder has it from another link than the measurements, so it may come before them."""
        if self._fill_commands is not None:
            self._filled(self._fill_commands.reads(frame, published_ns), self._take_command)
            return
        counter = self._command_counter(frame)
        if counter is None:
            self.malformed += 1
            return
        self._take_command(Read(counter, frame, published_ns, published_ns))

    def telemetry(self, telemetry: Telemetry, published_ns: int) -> None:
        """Which tick a counter stood for; the first that can be matched tells it for the whole session."""
        if self._ticks is None:
            self._anchors.append((telemetry, published_ns))

    def _filled(self, reads: list[Read] | None, take: Callable[[Read], None]) -> None:
        if reads is None:
            self.malformed += 1
            return
        for read in reads:
            take(read)

    def _take_measurement(self, read: Read) -> None:
        if read.sent:
            self.measured(read.frame, read.published_ns)
        if self._commands:
            self._answer(read.since_ns)
        self._measured.append(read)

    def _take_command(self, read: Read) -> None:
        if read.sent:
            self.commanded(read.frame)
        self._commands.append(read)

    def finish(self) -> None:
        """No more is to come: what still waits is judged by what there is."""
        self._answer(_NEVER_NS)
        self._anchor(_NEVER_NS)

    def _answer(self, until_ns: int) -> None:
        """Put together the commands published before `until_ns`, each with the latest measurement before of its echo.

        Zenoh's timestamps are hybrid logical clocks: an answer is always stamped later than its question, on any host.
        """
        commands, measured = self._commands, self._measured
        while commands and commands[0].published_ns < until_ns:
            command = commands.popleft()
            echo, published_ns = command.counter, command.published_ns
            if command.sent:
                found = len(measured) - 1
                while found >= 0 and (measured[found].counter != echo or measured[found].since_ns >= published_ns):
                    found -= 1
            else:
                found = self._next_with(echo)
            if found < 0:
                continue  # answers what the log does not have, or repeats an answer
            before = [measured.popleft() for _ in range(found)] if found else []
            measurement = measured.popleft()
            self._last_counter = measurement.counter
            if self._ticks is not None:
                self._place(self._ticks, measurement, command, before)
            else:
                self._pairs.append(Pair(measurement, command, before))
                self._anchor(measurement.since_ns)

    def _next_with(self, echo: int) -> int:
        """Where the measurement is that a command would answer that was not sent; −1 if the plant skipped its tick.

        Such a command has no time of its own, but it is of the first tick with its echo after the one answered last.
        """
        wanted, passed, before = (echo - self._last_counter - 1) % self._counters + 1, 0, self._last_counter
        for found, read in enumerate(self._measured):
            passed += (read.counter - before - 1) % self._counters + 1
            if passed >= wanted:
                return found if passed == wanted else -1
            before = read.counter
        return -1

    def _anchor(self, until_ns: int) -> None:
        """Match telemetry from before `until_ns` with the latest answered measurement before it with its counter."""
        while self._ticks is None and self._anchors and self._anchors[0][1] < until_ns:
            telemetry, published_ns = self._anchors.popleft()
            pairs = list(self._pairs)
            for i in reversed(range(len(pairs))):
                if pairs[i].measurement.since_ns < published_ns and pairs[i].measurement.counter == telemetry.counter:
                    first = telemetry.tick
                    for pair in reversed(pairs[:i]):
                        first = _before(first, pair.measurement.counter, self._counters)
                    loop = self._loop
                    self._ticks = TickCounter(loop.period_ns, self._counters, lockstep=loop.lockstep, tick=max(0, first) - 1)
                    self._pairs.clear()
                    for pair in pairs:
                        self._place(self._ticks, *pair)
                    break
            # else: the measurement that it speaks of came before the log began

    def _place(self, ticks: TickCounter, measurement: Read, command: Read, before: list[Read]) -> None:
        """Find the tick as the controller did: it, too, saw the measurements that it answered, and no others."""
        last = ticks.tick
        k = ticks.advance(measurement.counter, measurement.published_ns)
        if k is None:
            return
        if before:
            tick, over = k, []
            for read in reversed(before):
                tick = _before(tick, read.counter, self._counters)
                if tick <= last:
                    break
                over.append((tick, read))
            for missed, read in reversed(over):
                if self._lapses is not None:
                    self._lapses.at(missed, read)
                self.passed_over(missed, read)
        used = measurement if self._lapses is None else self._lapses.at(k, measurement)
        if used is None:
            self.passed_over(k, measurement)
        else:
            self.answered(k, used, command)


def _before(tick: int, counter: int, counters: int) -> int:
    """The last tick before this one that has a counter."""
    return tick - ((tick - counter) % counters or counters)


@contextmanager
def without_collections() -> Iterator[None]:
    """No garbage is collected meanwhile: reading makes no cycles, and ticks in their thousands wait to be looked at."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


P = TypeVar("P", bound=Pairing)

Taker = Callable[[bytes, int], None]
"""Takes a message of the log: its content, and when it was published [ns]."""


class Sessions(dict[Which, P]):
    """The sessions of a run, each made when its first frame comes.

    Args:
        make: Makes a session.
    """

    def __init__(self, make: Callable[[Which], P]) -> None:
        self._make = make

    def __missing__(self, which: Which) -> P:
        self[which] = self._make(which)
        return self[which]

    def route(self, address: Address) -> Taker | None:
        """Who takes the messages of a key; None if they are no business of a session."""
        name = address.topic.name
        if name == "telemetry":
            return partial(self._telemetry, address.vehicle)
        if name not in ("measurement", "command") or address.session is None:
            return None
        session = self[address.vehicle, address.session]
        return session.measurement if name == "measurement" else session.command

    def _telemetry(self, vehicle: str, payload: bytes, published_ns: int) -> None:
        if any(whose == vehicle and session.wants_telemetry for (whose, _), session in self.items()):
            telemetry = Telemetry.model_validate_json(payload)
            if session := self.get((vehicle, telemetry.session)):
                session.telemetry(telemetry, published_ns)
