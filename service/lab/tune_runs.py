"""Runs of a search for gains: experiments with a candidate's gains, each under a seed and a wind.

A run that trips, or whose law fails, is a result like any other: it has the part of the time that it lasted.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, with_law_settings
from aeroloop.service.lab.cells import with_seed
from aeroloop.service.lab.experiment import experiment

LawValues = dict[str, Any]
"""`[law]` as plain data."""


class Case(BaseModel):
    """What an experiment is repeated under; a plant without our wind and sensors takes no notice."""

    model_config = ConfigDict(frozen=True)

    seed: int = Field(description="of wind and sensors")
    wind: float = Field(description="part of plant.wind.torque that blows; 0 is calm [1]")


class Ran(NamedTuple):
    """Figures of a run.

    Attributes:
        z_track: As of `Figures` [s].
        u_total: As of `Figures` [V²·s].
        saturated: Part of the ticks with a voltage at its limit [1].
        changes_per_s: Changes of a commanded voltage [1/s].
        settled_deg: Largest error in the second half [deg].
        lasted: Part of the time that it ran: 1, or less where it tripped [1].
        reason: Why it ended early; None if it did not.
    """

    z_track: float
    u_total: float
    saturated: float
    changes_per_s: float
    settled_deg: float
    lasted: float = 1.0
    reason: str | None = None


def largest_voltage(settings: Settings) -> float:
    """At which a command saturates: the supply's limit, or that of its quantizer [V]."""
    return min(settings.plant.voltage_limit, settings.wire.voltage.quantizer().outermost)


def with_case(settings: Settings, case: Case) -> Settings:
    """The configuration with the seed and the wind of a case."""
    settings = with_seed(settings, case.seed)
    if not settings.plant.emulated:
        return settings
    torque = tuple(case.wind * value for value in settings.plant.wind.torque)
    wind = settings.plant.wind.model_copy(update={"blowing": case.wind != 0, "torque": torque})
    return settings.model_copy(update={"plant": settings.plant.model_copy(update={"wind": wind})})


def run_cases(config: str, law: LawValues, cases: Sequence[Case], duration_s: float) -> list[Ran]:
    """Run a candidate under each case, in any process; `config` is the JSON of the configuration."""
    settings = with_law(config, law)
    return [run_case(with_case(settings, case), duration_s) for case in cases]


def with_law(config: str, law: LawValues) -> Settings:
    """The configuration with another `[law]`. Raises ValueError or AeroloopError if that is wrong."""
    settings = _settings(config)
    return with_law_settings(settings.model_copy(update={"law": type(settings.law).model_validate(law)}))


@lru_cache(maxsize=2)
def _settings(config: str) -> Settings:
    return Settings.model_validate_json(config)


def run_case(settings: Settings, duration_s: float) -> Ran:
    """Run an experiment."""
    ticks, full = settings.loop.ticks(duration_s), largest_voltage(settings)
    level = settings.wire.voltage.quantizer().level
    largest = [0.0]

    def watch(_k: int, _measurement: bytes, command: bytes) -> None:  # frame by frame only
        read = settings.wire.command.unpack(command)
        largest.append(max(abs(level(code)) for code in read[1]) if read else largest[-1])  # held without a frame

    try:
        figures, course = experiment(settings, duration_s, watch=watch)
    except (ValueError, AeroloopError) as error:
        return Ran(0, 0, 0, 0, 0, (len(largest) - 1) / ticks, reason=str(error).splitlines()[0])
    voltages = np.abs(course.voltages).max(axis=1) if course else np.array(largest)
    saturated = float(np.count_nonzero(voltages >= full)) / ticks
    found = figures.z_track, figures.u_total, saturated, figures.command_changes_per_s, figures.second_half_error_deg
    z_track, u_total, saturated, changes, settled = (inf if value is None else value for value in found)
    if not all(map(isfinite, (z_track, u_total, changes, settled))):
        return Ran(0, 0, 0, 0, 0, 0, "it has no figures: it answers nothing, or no number")
    return Ran(z_track, u_total, saturated, changes, settled)
