"""What a controller tick costs, from frame bytes to frame bytes, beside the same law in plain NumPy.

Run with `uv run pytest tests/benchmarks --benchmark-enable`. Figures are for reading: nothing is asserted about time.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from plant_emulator.aero import Aero, AeroSettings
from plant_emulator.endpoint import Endpoint
from protocol.frames import WireSpec
from protocol.messages import Claim
from service.controller import Controller
from service.law import LawSettings
from service.reference import SinusoidSettings, reference_function
from tests.service import numpy_twin

PERIOD = 0.002
TICKS = 2000


def _controller() -> Controller:
    return Controller(WireSpec(), LawSettings(), reference_function(SinusoidSettings()), PERIOD)


@pytest.fixture(scope="module")
def measurements() -> list[bytes]:
    """Measurement frames of four seconds of the paper's experiment."""
    wire = WireSpec()
    endpoint = Endpoint(Aero(AeroSettings(), PERIOD), wire, round(PERIOD * 1e9))
    endpoint.claim(Claim(controller="c", session="s", period_ns=round(PERIOD * 1e9), lockstep=False, wire=wire))
    controller = _controller()
    frames = []
    frame = endpoint.tick(None, 0)
    for k in range(TICKS):
        assert frame is not None
        frames.append(frame)
        frame = endpoint.tick(controller.tick(frame, k), k + 1)
    return frames


def test_controller_tick(benchmark: BenchmarkFixture, measurements: list[bytes]) -> None:
    controller = _controller()
    frames = cycle(enumerate(measurements))

    def tick() -> bytes | None:
        k, frame = next(frames)
        return controller.tick(frame, k)

    assert benchmark(tick) is not None
