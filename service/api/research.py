"""Public names: what a user's law, plant or test builds on; configuration, experiment, certificate, recorded runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.quantizer import HysteresisQuantizer, LogarithmicQuantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.config import Settings, as_overrides, load
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.interface import (
    ExpressionLaw,
    Gain,
    Gains3,
    LawSettings,
    Now,
    PositiveGain,
    PythonLaw,
    gravity_torque,
    voltages_for,
)
from aeroloop.service.figures import Figures
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review import review
from aeroloop.service.testing.hil import Hil, HilError
from aeroloop.service.theorem.certificate import Certificate, certify

__all__ = [
    "AeroloopError", "Certificate", "Controller", "ExpressionLaw", "Figures", "Gain", "Gains3", "Hil", "HilError",
    "HysteresisQuantizer", "LawSettings", "LogarithmicQuantizer", "Measurement", "Now", "Plant", "PositiveGain",
    "PythonLaw", "RecordedRun", "Settings", "SignalSpec", "State", "Ticks", "UniformQuantizer", "WireSpec", "certify",
    "gravity_torque", "load_settings", "read_run", "run_experiment", "voltages_for",
]  # fmt: skip


def load_settings(file: Path | str | None = None, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Load a configuration: defaults, then a TOML file, then the environment, then overrides.

    Args:
        file: A TOML file, as for `--config`.
        overrides: `section.key` to value, as for `--set`, or nested by section; `"cont"` for bits without a quantizer.

    Raises:
        AeroloopError: What is wrong and where, in one line.
    """
    return load(Path(file) if file is not None else None, as_overrides(overrides or {}))


class RecordedRun(NamedTuple):
    """A session of a log.

    Attributes:
        settings: Configuration of the run.
        figures: Figures of merit, as `aeroloop log review`.
        ticks: One row a tick in each column; see `Ticks` for names, shapes and units.
    """

    settings: Settings
    figures: Figures
    ticks: Ticks

    @property
    def time(self) -> npt.NDArray[np.floating]:
        """Time of each tick on the law's clock [s]. Shape (n,)."""
        return self.ticks.k * self.settings.loop.period


def read_run(*paths: Path | str, session: str | None = None, vehicle: str | None = None) -> RecordedRun:
    """Read a session of a log as arrays.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        session: Its name, or its number from 1 in the order of recording; the longest if None.
        vehicle: Its vehicle; that of the longest session if None.

    Raises:
        AeroloopError: Not a log, several unrelated runs, or no such session.
    """
    read = review.read(*map(Path, paths), session=session, vehicle=vehicle)
    return RecordedRun(read.settings, read.figures, read.ticks)
