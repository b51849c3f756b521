"""Review of one session: scores its ticks, observes them, and checks them against the theorem."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

import numpy as np
from pydantic import TypeAdapter, ValidationError

from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.messages.operator import Change, in_force
from aeroloop.protocol.messages.trace import Outcome, Received
from aeroloop.service.config import Settings
from aeroloop.service.figures import Score
from aeroloop.service.logs.runs import Block
from aeroloop.service.logs.table import is_of_tick
from aeroloop.service.logs.tick_reader import TickReader
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Missing
from aeroloop.service.review.observe import WHOLE, DrawnPart, Observer
from aeroloop.service.review.theorem_check import WAITING, TheoremCheck

_TRUTHS: Final = TypeAdapter(list[Truth])
"""Parsing them as one array takes a third of the time."""

_OUTCOMES: Final = {
    "stale": [Outcome.STALE],
    "repeated": [Outcome.REPEATED],
    "refused": [Outcome.MALFORMED, Outcome.INVALID],
    "withheld": [Outcome.WITHHELD],
}


class Session:
    """Reviews one session.

    Args:
        settings: Its configuration.
        check: Creates its check against the theorem, from the changes that it began with.
        missing: Its rows that the log lacks.
        watch: Called with every block of ticks, in order.
        part: What of it is drawn.

    Attributes:
        score: Its figures of merit.
        lapses: How many ticks were late, missed and so on; see `Findings`.
        reader: Reads its ticks.
        unreadable: Malformed messages with a true state.
    """

    def __init__(
        self,
        settings: Settings,
        check: Callable[[Sequence[Change]], TheoremCheck],
        missing: Sequence[Missing] = (),
        watch: Callable[[Ticks], None] | None = None,
        part: DrawnPart = WHOLE,
    ) -> None:
        self.settings = settings
        self.part = part
        self.score = Score(settings.wire, settings.loop.period, settings.plant.watchdog_s)
        self.lapses: Counter[str] = Counter()
        self.reader = TickReader(settings)
        self._check = check
        self._gaps = [(gap.first_tick, gap.last_tick) for gap in missing if gap.end == "controller" and gap.rows]
        self._watch = watch
        self._observer: Observer | None = None
        self._truths: deque[bytes] = deque(maxlen=WAITING)
        self._session: str | None = None
        self.unreadable = 0

    @property
    def observer(self) -> Observer:
        """The observations beside the figures."""
        if self._observer is None:
            self._observer = Observer(self.settings, self._check(()), self.part)
        return self._observer

    def truth(self, payload: bytes, _at_ns: int) -> None:
        """Add a message with the true state at a measurement."""
        self._truths.append(payload)

    def take(self, block: Block) -> None:
        """Review the next block."""
        changes = block.changes
        if self._observer is None:
            at = int(block.k[0]) if len(block.k) else 0
            begun, changes = [one for one in changes if one.tick <= at], [one for one in changes if one.tick > at]
            self._observer = Observer(self.settings, self._check(begun), self.part)
            changes = [*in_force(begun), *changes]
        observer = self._observer
        observer.check.changed(changes)
        self._session = block.which[1]
        self._add_truths(observer.check)
        self._count(block)
        found = self.reader.take(block)
        for tick in found.missed.tolist():
            self.lapses["missed"] += not any(a <= tick and (b is None or tick <= b) for a, b in self._gaps)
        observer.frames(found.measurements, found.commands)
        self.score.errors(found.judged.k, found.judged.attitude_error)
        self.score.commands(found.answered, found.voltages)
        self.score.unsent(*found.unsent)
        observer.answered(found.answered)
        observer.ticks(found.judged)
        if self._watch is not None and len(found.judged.k):
            self._watch(found.judged)

    def finish(self) -> None:
        """Check the truths after the last block."""
        if self._observer is not None:
            self._add_truths(self._observer.check)
            self._observer.check.finish()

    def _add_truths(self, check: TheoremCheck) -> None:
        try:
            truths = _TRUTHS.validate_json(b"[" + b",".join(self._truths) + b"]")
        except ValidationError:  # a stranger may publish anything
            truths = [truth for text in self._truths if (truth := _truth(text)) is not None]
            self.unreadable += len(self._truths) - len(truths)
        for truth in truths:
            if truth.session != self._session:
                continue
            if is_of_tick(truth, self.settings.wire.actuators):
                check.truth(truth.session_tick, truth.attitude, truth.rate)
            else:
                self.unreadable += 1
        self._truths.clear()

    def _count(self, block: Block) -> None:
        """Count late, malformed, stale, repeated, refused and withheld frames."""
        if rows := block.controller:
            for name, kind in (("late", Received.LATE), ("malformed", Received.MALFORMED)):
                self.lapses[name] += int((rows["received_as"] == kind).sum())
        if block.plant:
            outcomes = block.plant["outcome"][: int((block.at_plant >= 0).sum())]
            for name, kinds in _OUTCOMES.items():
                self.lapses[name] += int(np.isin(outcomes, kinds).sum())


def _truth(text: bytes) -> Truth | None:
    with suppress(ValidationError):
        return Truth.model_validate_json(text)
    return None
