"""Comparison of recorded frames with the ends' traces.

Recorded frames are evidence that does not depend on the ends; no figure is computed from them. A frame carries a
counter and no tick, so ticks are counted in the order of recording, from the tick that the traces had reached when the
first frame was recorded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.messages.trace import Sent
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.logs.runs import Block, Rows, Taker
from aeroloop.service.logs.traces import Integers, SessionKey


class WireCheck:
    """Compares the frames of one session; `reached` has the last tick that the traces have reached, by session."""

    def __init__(self, which: SessionKey, wire: WireSpec, reached: Mapping[SessionKey, int]) -> None:
        self._which = which
        self._reached = reached
        self._formats = {"measurement": wire.measurement, "command": wire.command}
        self._last: dict[str, int] = {}
        self._waiting: dict[str, deque[tuple[int, bytes]]] = {name: deque() for name in self._formats}
        self._counts = {name: {"recorded": 0, "differ": 0} for name in self._formats}

    def route(self, address: Address) -> Taker | None:
        """Callback for the messages of a key; None unless they are frames of the session."""
        name = address.topic.name
        if name not in self._formats or (address.vehicle, address.session) != self._which:
            return None
        return lambda frame, _: self._add(name, frame)

    def take(self, block: Block) -> None:
        """Compare the frames up to the end of the next block."""
        at, plant = block.at_controller, block.at_plant
        self._compare("measurement", block.plant, block.k[plant >= 0], plant[plant >= 0])
        self._compare("command", block.controller, block.k[at >= 0], at[at >= 0])

    def findings(self) -> dict[str, dict[str, int]] | None:
        """How many were recorded of either kind, and how many differ; None if none was recorded."""
        for name, waiting in self._waiting.items():
            self._counts[name]["differ"] += len(waiting)
            waiting.clear()
        return self._counts if any(count["recorded"] for count in self._counts.values()) else None

    def _add(self, name: str, frame: bytes) -> None:
        if not frame:  # silence, in lockstep
            return
        kind = self._formats[name]
        counter = kind.counter(frame)
        self._counts[name]["recorded"] += 1
        if counter is None:
            self._counts[name]["differ"] += 1
            return
        last = self._last.get(name, self._reached.get(self._which, -1))
        self._last[name] = tick = last + 1 + (counter - last - 1) % kind.counters
        self._waiting[name].append((tick, frame))

    def _compare(self, name: str, rows: Rows, k: Integers, at: Integers) -> None:
        waiting = self._waiting[name]
        if not waiting or not len(k):
            return
        framed = rows["sent_as"][at] == Sent.FRAME
        ticks, frames = k[framed], rows[name][at][framed]
        while waiting and waiting[0][0] <= k[-1]:
            tick, frame = waiting.popleft()
            place = int(np.searchsorted(ticks, tick))
            same = place < len(ticks) and ticks[place] == tick and frames[place].tobytes() == frame
            self._counts[name]["differ"] += not same
