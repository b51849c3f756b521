"""Adaptive attitude control over Eclipse Zenoh, in frames whose every bit is a quantizer's bit.

The public Python API. Everything else under `aeroloop` may change without notice.

    import aeroloop

    settings = aeroloop.load_settings(overrides={"wire.voltage.bits": 8})
    figures = aeroloop.run_experiment(settings, duration_s=10)
    print(figures.z_track, aeroloop.certify(settings).verdict)

Examples are in `aeroloop/service/examples`.
"""

from __future__ import annotations

TYPE_CHECKING = (
    False  # as in typing, which, like importlib, is slow to import: ^C has no handler before `cli.entry` runs
)
if TYPE_CHECKING:
    from typing import Any, Final

    from aeroloop.plant_emulator.plant import Measurement as Measurement
    from aeroloop.plant_emulator.plant import Plant as Plant
    from aeroloop.plant_emulator.plant import State as State
    from aeroloop.protocol.errors import AeroloopError as AeroloopError
    from aeroloop.protocol.wire.quantizer import HysteresisQuantizer as HysteresisQuantizer
    from aeroloop.protocol.wire.quantizer import LogarithmicQuantizer as LogarithmicQuantizer
    from aeroloop.protocol.wire.quantizer import UniformQuantizer as UniformQuantizer
    from aeroloop.protocol.wire.spec import SignalSpec as SignalSpec
    from aeroloop.protocol.wire.spec import WireSpec as WireSpec
    from aeroloop.research import RecordedRun as RecordedRun
    from aeroloop.research import certify as certify
    from aeroloop.research import load_settings as load_settings
    from aeroloop.research import read_run as read_run
    from aeroloop.research import run_experiment as run_experiment
    from aeroloop.service.config import Settings as Settings
    from aeroloop.service.control.controller import Controller as Controller
    from aeroloop.service.control.laws.interface import ExpressionLaw as ExpressionLaw
    from aeroloop.service.control.laws.interface import Gain as Gain
    from aeroloop.service.control.laws.interface import Gains3 as Gains3
    from aeroloop.service.control.laws.interface import LawSettings as LawSettings
    from aeroloop.service.control.laws.interface import Now as Now
    from aeroloop.service.control.laws.interface import PositiveGain as PositiveGain
    from aeroloop.service.control.laws.interface import PythonLaw as PythonLaw
    from aeroloop.service.control.laws.interface import gravity_torque as gravity_torque
    from aeroloop.service.control.laws.interface import voltages_for as voltages_for
    from aeroloop.service.figures import Figures as Figures
    from aeroloop.service.logs.ticks import Ticks as Ticks
    from aeroloop.service.testing.hil import Hil as Hil
    from aeroloop.service.theorem.certificate import Certificate as Certificate

_HOMES: Final = {
    "AeroloopError": "aeroloop.protocol.errors",
    "Certificate": "aeroloop.service.theorem.certificate",
    "Controller": "aeroloop.service.control.controller",
    "ExpressionLaw": "aeroloop.service.control.laws.interface",
    "Figures": "aeroloop.service.figures",
    "Gain": "aeroloop.service.control.laws.interface",
    "Gains3": "aeroloop.service.control.laws.interface",
    "Hil": "aeroloop.service.testing.hil",
    "HysteresisQuantizer": "aeroloop.protocol.wire.quantizer",
    "LawSettings": "aeroloop.service.control.laws.interface",
    "LogarithmicQuantizer": "aeroloop.protocol.wire.quantizer",
    "Measurement": "aeroloop.plant_emulator.plant",
    "Now": "aeroloop.service.control.laws.interface",
    "Plant": "aeroloop.plant_emulator.plant",
    "PositiveGain": "aeroloop.service.control.laws.interface",
    "PythonLaw": "aeroloop.service.control.laws.interface",
    "RecordedRun": "aeroloop.research",
    "Settings": "aeroloop.service.config",
    "SignalSpec": "aeroloop.protocol.wire.spec",
    "State": "aeroloop.plant_emulator.plant",
    "Ticks": "aeroloop.service.logs.ticks",
    "UniformQuantizer": "aeroloop.protocol.wire.quantizer",
    "WireSpec": "aeroloop.protocol.wire.spec",
    "certify": "aeroloop.research",
    "gravity_torque": "aeroloop.service.control.laws.interface",
    "load_settings": "aeroloop.research",
    "read_run": "aeroloop.research",
    "run_experiment": "aeroloop.research",
    "voltages_for": "aeroloop.service.control.laws.interface",
}
"""Module of each public name. Names load on first use: `import aeroloop` stays light, and so does every command."""

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'aeroloop' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
