"""The fake board in real time, with an emulated Aero, under the names that Quanser's module has."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[5]))

from aeroloop.plant_emulator.settings import PlantSettings
from tests.support.fake_quanser import BufferOverflowMode, Clock, FakeQuanser, HILError

HIL = FakeQuanser(PlantSettings(), 0.002, realtime=True).HIL

__all__ = ["HIL", "BufferOverflowMode", "Clock", "HILError"]
