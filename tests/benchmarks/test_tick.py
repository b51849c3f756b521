"""Tick benchmark: the law in plain NumPy from frame bytes to frame bytes, and a row of the plant's trace.

Run with `uv run pytest tests/benchmarks --benchmark-enable`. No time is asserted.
"""

from __future__ import annotations

import time
from itertools import cycle

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.zenoh_network import PlantTrace
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Claim
from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.config import load
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.lab.experiment import run_experiment
from tests.support import numpy_twin as twin
from tests.support.twin_body import body_of

PERIOD = 0.002
TICKS = 2000


def test_a_tick_in_plain_numpy(benchmark: BenchmarkFixture) -> None:
    """The tests' NumPy twin of the law and the reference, between the project's own frames and quantizers."""
    wire, p, paper = WireSpec(), AdaptiveSettings(), Sinusoid()
    body = body_of(p)
    reference = twin.Sinusoids(np.radians(paper.amplitude), np.array(paper.frequency))
    level, quantizer = wire.attitude.quantizer().level, wire.voltage.quantizer()
    theta, last = np.array(p.damping_estimate), np.array([1.0, 0.0, 0.0, 0.0])
    measurements: list[bytes] = []
    run_experiment(load(), TICKS * PERIOD, watch=lambda _, measurement, __: measurements.append(measurement))
    frames = cycle(enumerate(measurements))

    def tick() -> bytes:
        nonlocal theta, last
        k, frame = next(frames)
        read = wire.measurement.unpack(frame)
        assert read is not None
        values = np.array([level(code) for code in read[1]])
        last = twin.reconstructed(values[:3], last)
        state = twin.law(body, last, values[3:], *reference.desired(k * PERIOD), theta, 1.0)
        theta = theta + PERIOD * state.theta_dot
        return wire.command.pack(read[0], [quantizer.encode(float(u)) for u in state.u[1:]])

    assert len(benchmark(tick)) == wire.command.size


def test_a_row_of_the_plants_trace(benchmark: BenchmarkFixture) -> None:
    wire, loop = WireSpec(), LoopSettings(trace_s=10)
    endpoint = Endpoint(PlantSettings(ideal=True).build(PERIOD), wire, loop.period_ns)
    endpoint.claim(
        Claim(controller="c", session="s", period_ns=loop.period_ns, lockstep=False, auto_arm=True, wire=wire)
    )
    trace = PlantTrace(loop, wire, lambda _: None)
    trace.follow(endpoint)
    endpoint.tick(None, 0)
    arrival = Arrival(wire.command.pack(0, (1, 2)), time.monotonic_ns())
    measurement = endpoint.tick(arrival.frame, 1)
    benchmark(trace.row, endpoint, measurement, arrival, time.monotonic_ns())
