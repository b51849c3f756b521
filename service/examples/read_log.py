"""Read a recorded run into NumPy: attitude error and latency of the longest session of a log.

aeroloop demo --lockstep --duration 5 --log run.mcap
python read_log.py run.mcap
"""

from __future__ import annotations

import sys

import numpy as np

import aeroloop


def main(*paths: str) -> None:
    """Print what the log says of its longest session."""
    run = aeroloop.read_run(*paths)
    ticks = run.ticks
    # ε̃ is the vector part of the attitude error, so its length is the sine of half the error's angle.
    sine = np.minimum(1.0, np.linalg.norm(ticks.attitude_error, axis=1))
    error_deg = np.degrees(2 * np.arcsin(sine))
    # What a tick lacks is NaN: a measurement that no command answered has no latency.
    latency_us = ticks.latency_ns * 1e-3
    print(f"{len(ticks.k)} ticks of {run.settings.loop.period * 1e3:g} ms, {run.time[-1]:g} s")
    print(f"attitude error: {error_deg.max():.2f}° at the most, {error_deg[-1]:.2f}° at the end")
    if not np.isnan(latency_us).all():
        print(f"latency: {np.nanmedian(latency_us):.0f} µs at the median")
    print(f"z_track = {run.figures.z_track}, u_total = {run.figures.u_total}")


if __name__ == "__main__":
    main(*sys.argv[1:])
