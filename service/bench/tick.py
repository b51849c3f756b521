"""Tick of the controller, bytes in to bytes out, beside what no Python around CasADi can go below.

The floor unpacks the frame with bitstruct, calls the reference's and the law's functions once each on memory that
stays, and packs a command with bitstruct. Both answer the same measurements, those of the configured experiment.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from bitstruct.c import compile as compile_bits

from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.bench.item import Figure, in_turns
from aeroloop.service.config import Settings, load
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.evaluation import law_function
from aeroloop.service.control.laws.interface import ExpressionLaw
from aeroloop.service.control.laws.registry import law_of
from aeroloop.service.control.reference import reference_function
from aeroloop.service.lab.experiment import run_experiment

FRAMES_S: Final = 1.0
"""500 frames a round, some milliseconds: short enough that nothing disturbs the best of them."""
QUICK_ROUNDS: Final = 200
ROUNDS: Final = 2000

Tick = Callable[[bytes, int], object]


def tick(quick: bool) -> Figure:
    """Processor time of a tick [µs]."""
    settings, frames = load(), list[bytes]()
    run_experiment(settings, FRAMES_S, watch=lambda _, measurement, __: frames.append(measurement))
    controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
    ours, floor = _timed(controller.tick, frames), _timed(bare_tick(settings), frames)
    return in_turns(ours, floor, QUICK_ROUNDS if quick else ROUNDS)


def bare_tick(settings: Settings) -> Tick:
    """Unpack, both functions, pack; the codes are not used."""
    law = law_of(settings.law, settings.loop.period, settings.wire.actuators)
    assert isinstance(law, ExpressionLaw)
    evaluate_law, reference = Compiled(law_function(law)), Compiled(reference_function())
    attitude, rate, voltage, counter = (
        settings.wire.attitude.bits,
        settings.wire.rate.bits,
        settings.wire.voltage.bits,
        settings.wire.counter_bits,
    )
    measured = compile_bits(f"u{counter}" + f"s{attitude}" * 3 + f"s{rate}" * 3)
    command = compile_bits(f"u{counter}" + f"s{voltage}" * 2)

    def tick(frame: bytes, _: int) -> object:
        values = measured.unpack(frame)
        reference()
        evaluate_law()
        return command.pack(values[0], 1, 2)

    return tick


def _timed(tick: Tick, frames: list[bytes]) -> Callable[[], float]:
    """A function that answers all frames, at ticks that go on from call to call, and returns the time of one [µs]."""
    first = 0

    def timed() -> float:
        nonlocal first
        begun = time.thread_time_ns()
        for k, frame in enumerate(frames, first):
            tick(frame, k)
        spent_ns = time.thread_time_ns() - begun
        first += len(frames)
        return spent_ns / len(frames) / 1000

    return timed
