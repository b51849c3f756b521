"""Emulator on Zenoh: a computed plant that also publishes its true state, accepts faults and steps on request."""

from __future__ import annotations

from collections.abc import Callable

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.plant_emulator.hosts.zenoh_network import ZenohNetwork
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import FaultStatus
from aeroloop.protocol.messages.operator import Advance, Answer, Inject
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec


def run_emulator(role: Node, loop: LoopSettings, wire: WireSpec, settings: PlantSettings) -> None:
    """Run the plant that `plant.kind` names until the role stops; then set 0 V and publish a last status.

    Raises:
        PluginError, PlantError: There is no such plant, it cannot be made, or it failed.
        ValueError: A fault of a motor that the plant does not have, or another number of motors than the wire's.
    """
    driver = Driver(settings.make(loop.period), loop, wire, settings, role.stop)
    driver.run(EmulatorNetwork(role, loop, driver, settings))


class EmulatorNetwork(ZenohNetwork):
    """An emulator on Zenoh."""

    def __init__(self, role: Node, loop: LoopSettings, driver: Driver, settings: PlantSettings) -> None:
        super().__init__(role, loop, driver.endpoint, settings.state_directory)
        self._driver = driver
        self.steps = 0 if settings.steps_on_request else None
        rate_hz = settings.truth_rate_hz
        self._truth_every = max(1, round(loop.rate_hz / rate_hz)) if rate_hz else 0

    def serve(self) -> None:
        """Declare the topics, and answer requests from now on."""
        self._role.serve("inject", Inject, self._inject)
        self._role.serve("advance", Advance, lambda advance: lambda: self._advance(advance.seconds))
        super().serve()

    def faults(self) -> list[FaultStatus]:
        """Status of every fault."""
        return self._driver.fault_statuses()

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """As every network, and publish the true state when it is due."""
        super().after_tick(measurement, arrival, sent_ns)
        due = self._truth_every and self._endpoint.ticked % self._truth_every == 0
        if due and (truth := self._driver.truth()) is not None:
            self._role.publish("truth", truth)

    def _inject(self, request: Inject) -> Callable[[], Answer]:
        def inject() -> Answer:
            done = self._driver.inject([Fault.parse(text) for text in request.faults], clear=request.clear)
            self.follow_session()  # here, so that its events name the operator
            return Answer(done=bool(done), text="; ".join(done) or "no fault was given")

        return inject

    def _advance(self, seconds: float) -> Answer:
        if self.steps is None:
            return Answer(done=False, text="this plant steps by itself: set plant.steps_on_request and loop.lockstep")
        self.steps += self._loop.ticks(seconds)
        return Answer(done=True, text=f"goes on for {seconds:g} s")
