"""Both ends in one process, sans-I/O, through real frames: as a network without any delay connects them.

The order of a tick is that of `aeroloop demo --lockstep`: the controller answers what the plant has sent, and the plant
acts on the answer from its next period on. Injected faults of frames act; where they hold frames back, a tick has no
answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.protocol.messages.trace import Received
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.control.controller import Controller

OLD: Final = 0.75  # of a counter's range: a frame that seems so far ahead is a repetition, or older than the last one


class Answered(NamedTuple):
    """A measurement that the controller received, of tick k, and its command; None where it sends none."""

    k: int
    received_as: Received
    measurement: bytes
    command: bytes | None


class LockstepLoop:
    """A controller and a plant end that has taken a measurement which the controller has not received.

    `k` is the tick of the last measurement received; `measurement` is the plant's last one, as `Endpoint.tick` returned
    it. `before` is called before the controller's tick k, to change gains or reference.
    """

    def __init__(
        self, endpoint: Endpoint, controller: Controller, measurement: bytes | None, k: int = -1,
        before: Callable[[int], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self.endpoint, self.controller, self.measurement, self.k = endpoint, controller, measurement, k
        self._before = before

    def answer(self) -> list[Answered]:
        """The controller's answers to what the plant has sent: one, or what faults of frames leave, in order."""
        wire, answered = self.endpoint.wire, list[Answered]()
        counters = wire.measurement.counters
        for frame in self.endpoint.outgoing:
            counter = wire.measurement.counter(frame)
            ahead = 1 if counter is None else (counter - self.k) % counters
            if ahead == 0 or ahead > OLD * counters:
                continue
            self.k += ahead
            received_as = Received.FRAME if counter is not None else Received.MALFORMED
            if frame == UNCHANGED:
                received_as = Received.SILENT
            self._before(self.k)
            answered.append(Answered(self.k, received_as, frame, self.controller.tick(frame, self.k)))
        return answered

    def advance(self, command: bytes | None) -> None:
        """The plant acts on a command, if any, for a period, and measures."""
        if command == UNCHANGED and not self.endpoint.lockstep:
            command = None  # silence is no frame
        self.measurement = self.endpoint.tick(command, self.endpoint.ticked + 1)
