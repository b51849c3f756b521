"""Public names: what a user's law, plant or test builds on; configuration, experiment, certificate, recorded runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.plugins import trusting
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
from aeroloop.service.lab.check import LogCheck, check_logs
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.fork import Fork, fork
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review import review
from aeroloop.service.review.instant import Instant, Instants
from aeroloop.service.testing.hil import Hil, HilError
from aeroloop.service.theorem.certificate import Certificate, certify

__all__ = [
    "AeroloopError", "Certificate", "Controller", "ExpressionLaw", "Figures", "Fork", "Gain", "Gains3", "Hil",
    "HilError", "HysteresisQuantizer", "Instant", "LawSettings", "LogCheck", "LogarithmicQuantizer", "Measurement",
    "Now", "Plant", "PositiveGain", "PythonLaw", "RecordedRun", "Settings", "SignalSpec", "State", "Ticks",
    "UniformQuantizer", "WireSpec", "certify", "check_logs", "gravity_torque", "load_settings", "read_run",
    "run_experiment", "voltages_for",
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


@dataclass(frozen=True)
class RecordedRun:
    """A session of a log.

    Attributes:
        settings: Configuration of the run.
        figures: Figures of merit, as `aeroloop log review`.
        ticks: One row a tick in each column; see `Ticks` for names, shapes and units.
        paths: The log's files.
        vehicle, session: Which session of them it is.
        trust_law: Whether a law that only the log names may be imported, as of `read_run`.
    """

    settings: Settings
    figures: Figures
    ticks: Ticks
    paths: tuple[Path, ...]
    vehicle: str
    session: str
    trust_law: bool = False

    @property
    def time(self) -> npt.NDArray[np.floating]:
        """Time of each tick on the law's clock [s]. Shape (n,)."""
        return self.ticks.k * self.settings.loop.period

    def at(self, at: int | float) -> Instant:
        """All that is known of one tick, given as an int, or as a time on the law's clock [s]. Raises AeroloopError."""
        return self._instants.at(at)

    def fork(
        self,
        at: int | float,
        overrides: Mapping[str, Any] | None = None,
        *,
        faults: Sequence[str] = (),
        duration_s: float | None = None,
        log: Path | str | None = None,
    ) -> Fork:
        """Continue the run in lockstep from an instant, with something changed; see `aeroloop log fork`.

        Args:
            at: The tick, as an int, or a time on the law's clock [s].
            overrides: As of `load_settings`. From a tick after the session's first: law, reference, and of an emulated
                body its mechanics, wind and sensors.
            faults: As of `aeroloop op inject`; their times count from there.
            duration_s: Length [s]; the rest of the run if None.
            log: New file for the fork's ticks.

        Raises:
            AeroloopError: It cannot be forked so.
        """
        with trusting(self.trust_law):
            return fork(
                self.paths, at, session=self.session, vehicle=self.vehicle, overrides=as_overrides(overrides or {}),
                faults=faults, duration_s=duration_s, log=None if log is None else Path(log),
            )  # fmt: skip

    @cached_property
    def _instants(self) -> Instants:
        with trusting(self.trust_law):
            return Instants(self.paths, self.session, self.vehicle)


def read_run(
    *paths: Path | str, session: str | None = None, vehicle: str | None = None, trust_law: bool = False
) -> RecordedRun:
    """Read a session of a log as arrays.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        session: Its name, or its number from 1 in the order of recording; the longest if None.
        vehicle: Its vehicle; that of the longest session if None.
        trust_law: Whether to import a law, or a plant, that only the log names, which runs its code. Ours, installed
            and already imported ones always are. Without its law, a run's gains and state are empty, and its voltages
            before quantization NaN.

    Raises:
        AeroloopError: Not a log, several unrelated runs, or no such session.
    """
    files = tuple(map(Path, paths))
    with trusting(trust_law):
        read = review.read(*files, session=session, vehicle=vehicle)
    found = read.findings
    return RecordedRun(read.settings, read.figures, read.ticks, files, found.vehicle, found.session, trust_law)
