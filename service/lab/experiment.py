"""Controller and plant end in one process, in lockstep, through real frames.

No network and no clock: a `for` loop over the two ticks. What it computes repeats bit for bit, and a demo in lockstep
over Zenoh gives the very same figures.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from typing import TypeAlias

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Plant
from aeroloop.protocol.messages.models import Claim, Refusal
from aeroloop.protocol.wire.transmit import SILENCE
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.figures import Figures, Score

NO_CLOCK = "lockstep without a network has no latency"

Watch: TypeAlias = Callable[[int, bytes, bytes], None]
"""Sees every tick: k, the measurement, the command that answers it; SILENCE where a frame is not sent."""


class LoopEndedError(ValueError):
    """The loop ended before its time: the plant tripped. One line that says when and why."""


def run_experiment(
    settings: Settings,
    duration_s: float,
    progress: Callable[[float], None] | None = None,
    watch: Watch | None = None,
) -> Figures:
    """Run the closed loop for `duration_s` of the law's time and return its figures.

    Args:
        settings: The configuration.
        duration_s: How long [s].
        progress: Called now and then with the time reached [s].
        watch: Called at every tick with the frames of both directions, for whoever counts them.

    Raises:
        LoopEndedError: The plant tripped on the way.
        ValueError: The configuration does not make a loop, such as a law that commands 3 motors of a plant with 2.
    """
    loop, wire = settings.loop, settings.wire
    plant = _plant(settings)
    controller = Controller(wire, settings.law, settings.reference, loop.period)
    guard = settings.plant.guard(loop.period_ns, wire.voltage.quantizer().outermost)
    endpoint = Endpoint(plant, wire, loop.period_ns, lockstep=True, watchdog_s=settings.plant.watchdog_s, guard=guard)
    score = Score(wire, loop.period, settings.plant.watchdog_s)
    answer = endpoint.claim(
        Claim(controller="experiment", session="lab", period_ns=loop.period_ns, lockstep=True, auto_arm=True, wire=wire)
    )
    if isinstance(answer, Refusal):
        raise ValueError(answer.reason)

    level = wire.voltage.quantizer().level
    voltages: list[float] = []
    report_every = loop.ticks(1.0)
    measurement = endpoint.tick(None, 0)
    for k in _undisturbed(loop.ticks(duration_s)):
        command = controller.tick(measurement, k)
        if command is None:
            trips = [notice.text for notice in endpoint.notices if notice.kind == "tripped"]
            raise LoopEndedError(f"the loop ended after {k * loop.period:g} s: {'; '.join(trips) or 'no answer'}")
        if controller.tick_index == k:  # it used the measurement
            score.error(k, controller.attitude_error, sent=measurement != SILENCE)
        if read := wire.command.unpack(command):
            voltages = [level(code) for code in read[1]]
        score.command(k, voltages, sent=command != SILENCE)
        if watch is not None and measurement is not None:
            watch(k, measurement, command)
        measurement = endpoint.tick(command, k + 1)
        if progress is not None and k % report_every == 0:
            progress(k * loop.period)
    return score.figures(reasons={"latency_us": NO_CLOCK, "log": "nothing crossed a network"})


def _plant(settings: Settings) -> Plant:
    """The plant, with the faults that were asked for; frames cannot fail where they cross no network."""
    plant: Plant = settings.plant.build(settings.loop.period)
    if not settings.plant.faults:
        return plant
    for fault in settings.plant.parsed_faults:
        if fault.signal in ("measurement", "command"):
            raise ValueError(f"fault {fault} acts on frames that cross a network: use `aeroloop demo --lockstep`")
    faulty = settings.plant.with_faults(plant, settings.loop.period)
    faulty.start()
    return faulty


def _undisturbed(ticks: int) -> Iterator[int]:
    """Tick indices, with the garbage collector off until they are used up: the loop makes no cycles to collect."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield from range(ticks)
    finally:
        if collects:
            gc.enable()
