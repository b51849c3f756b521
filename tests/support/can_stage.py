"""The plant's side of a CAN bus: a node, step by step.

The node has a real endpoint and a bus inside this process; the test turns its loop while it waits for something.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import MEASUREMENT_ID, CanSettings, Heartbeat, fingerprint
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import LoopSettings
from tests.support.can_in_process import Stranger
from tests.support.plant_end import COUNTERS, PERIOD_NS, WIRE, RecordingPlant, command
from tests.support.zenoh_network import PATIENCE_S

OURS = fingerprint(WIRE, PERIOD_NS, lockstep=False)


def measurement(counter: int, codes: Sequence[int] = (1, -2, 3, -4, 5, -6)) -> bytes:
    return WIRE.measurement.pack(counter % COUNTERS, codes)


class Bus:
    """A node, whose loop turns while the test waits for something, and the controller's side of its bus."""

    def __init__(self, settings: CanSettings) -> None:
        self.plant = RecordingPlant()
        # Ticks are as fast as this test goes, so the endpoint's own watchdog, which counts them, is out of the way.
        self.endpoint = Endpoint(self.plant, WIRE, PERIOD_NS, watchdog_s=3600)
        self.front = CanNetwork(settings, LoopSettings(), self.endpoint)
        self.side = CanLink(settings, WIRE, "controller")
        self.stranger = Stranger(settings)
        self.say: Heartbeat | None = None
        self.said_at = 0.0
        self._k = -1
        self.front.serve()

    def close(self) -> None:
        self.front.leave()
        self.side.close()
        self.stranger.__exit__(None, None, None)

    def send_heartbeat(self, state: PlantState, number: int = 1, mark: bytes = OURS) -> None:
        """Let the controller's side say this from now on, ten times a second."""
        self.say, self.said_at = Heartbeat(state, number, mark), 0.0

    def turn(self) -> None:
        if self.say is not None and time.monotonic() >= self.said_at + 0.1:
            self.said_at = time.monotonic()
            self.side.beat(self.say)
        self._k += 1
        self.front.take_inbox()
        arrival = self.front.link.take() if self.front.link else None
        frame = self.endpoint.tick(arrival.frame if arrival else None, self._k)
        if frame and self.front.link:
            self.front.link.send(frame)
        self.front.after_tick(frame, arrival, 0)
        time.sleep(0.001)

    def until(self, what: str, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what} did not happen within {PATIENCE_S:g} s"
            self.turn()

    def turn_for(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.turn()

    def await_heartbeat(self, state: PlantState, number: int = 0) -> None:
        """Turn until the controller's side has received this from the node."""
        wanted = (state, number, OURS)
        self.until(f"heartbeat {wanted}", lambda: self.side.peer is not None and self.side.peer[:3] == wanted)

    def begin(self, number: int = 1) -> None:
        self.send_heartbeat(PlantState.GRANTED, number)
        self.until("the session", lambda: self.endpoint.session == f"can-{number}")

    def drive(self, code: int = 5) -> None:

        def driven() -> bool:
            arrival = self.side.take()
            if arrival is not None:
                self.side.send(command(arrival.frame[0], code))
            return self.endpoint.state is PlantState.DRIVEN

        self.until("the first command", driven)

    def counters(self, least: int) -> list[int]:
        """Counters of all measurements that were not looked at yet, at least so many."""
        seen: list[int] = []

        def come() -> bool:
            messages = self.stranger.everything()
            seen.extend(message.data[0] for message in messages if message.arbitration_id == MEASUREMENT_ID + 1)
            return len(seen) >= least

        self.until("measurements", come)
        return seen
