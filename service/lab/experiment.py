"""Experiment: runs controller and plant end in one process, in lockstep, through real frames.

A `for` loop over the two ticks, without network or clock. It repeats bit for bit, and a demo in lockstep over Zenoh
gives the same figures.
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
"""Called at every tick with k, the measurement and the command that answers it; SILENCE where none is sent."""


class LoopEndedError(ValueError):
    """The plant tripped before the end; one line with time and cause."""


def run_experiment(
    settings: Settings,
    duration_s: float,
    progress: Callable[[float], None] | None = None,
    watch: Watch | None = None,
    *,
    plant: Plant | None = None,
    controller: Controller | None = None,
) -> Figures:
    """Run the closed loop for `duration_s` of the law's time and return its figures.

    Args:
        settings: The configuration.
        duration_s: Length of the run [s].
        progress: Called once a second of the run with the time reached [s].
        watch: Called at every tick with the frames of both directions.
        plant: Plant to control; the emulated one of the configuration if None.
        controller: Controller to run; the configuration's if None.

    Raises:
        LoopEndedError: The plant tripped.
        ValueError: The ends do not fit each other, such as a law for 3 motors and a plant with 2.
    """
    loop, wire = settings.loop, settings.wire
    plant = plant or _plant(settings)
    controller = controller or Controller(wire, settings.law, settings.reference, loop.period)
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
    """The plant with its configured faults; faults of frames need a network."""
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
    """Tick indices, with the garbage collector off meanwhile: the loop makes no cycles to collect."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield from range(ticks)
    finally:
        if collects:
            gc.enable()
