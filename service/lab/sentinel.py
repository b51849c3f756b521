"""Sentinel: a fixed experiment by whose figures workers are compared, to the last bit.

It uses what differs between machines (sines, logarithms, random numbers, CasADi's own arithmetic), so two workers with
one fingerprint compute the same figures; with another libm, processor or version of anything, the fingerprint differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from typing import Final

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, load_over
from aeroloop.service.figures import Figures
from aeroloop.service.lab.experiment import run_experiment

_SENTINEL: Final = (
    "plant.wind.blowing=true",
    "plant.sensors.rate=gyro",
    "plant.sensors.gyro_noise=0.002",
    "wire.rate.kind=logarithmic-uniform",
    "wire.attitude.kind=hysteresis-uniform",
)
_SENTINEL_S: Final = 40.0
"""As long as runs that are compiled to C [s]: a worker's compiler counts, too."""


def run_each(settings: Sequence[Settings], duration_s: float) -> list[Figures | str]:
    """Figures of an experiment with each configuration, or the reason why it has none, such as a trip."""
    return [_run(each, duration_s) for each in settings]


def _run(settings: Settings, duration_s: float) -> Figures | str:
    try:
        return run_experiment(settings, duration_s)
    except (AeroloopError, ValueError) as error:  # the plant tripped, a law or plant failed, the ends do not fit
        return str(error).splitlines()[0]


@cache
def fingerprint() -> str:
    """The version of aeroloop, and a digest of what it computes here, such as `0.2.0+1f0c83a6be25`."""
    [figures] = run_each([load_over(Settings(), _SENTINEL)], _SENTINEL_S)
    assert isinstance(figures, Figures), figures
    exact = (figures.z_track, figures.u_total, figures.max_error_deg, figures.final_error_deg)
    return f"{version('aeroloop')}+{sha256(repr(exact).encode()).hexdigest()[:12]}"
