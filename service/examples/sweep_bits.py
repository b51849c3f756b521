"""Sweep over bits: tracking error of the paper's experiment against the bits of attitude and rate, with a plot.

python sweep_bits.py [seconds] [figure.svg]
"""

from __future__ import annotations

import sys

from matplotlib.figure import Figure

import aeroloop

BITS = (6, 7, 8, 9, 10, 12)


def main(duration_s: float = 10.0, out: str = "sweep.svg") -> None:
    """Run one lockstep experiment per number of bits, print a line for each, and draw them."""
    errors = []
    for bits in BITS:
        # One configuration gives both ends their quantizers, so no scale stands twice.
        settings = aeroloop.load_settings(overrides={"wire.attitude.bits": bits, "wire.rate.bits": bits})
        figures = aeroloop.run_experiment(settings, duration_s)
        assert figures.z_track is not None  # it is null only where nothing was measured
        errors.append(figures.z_track)
        print(f"{bits:2d} bits: z_track = {figures.z_track * 1e4:.1f} ×10⁻⁴ s")

    unquantized = aeroloop.load_settings(overrides={"wire.attitude.bits": "cont", "wire.rate.bits": "cont"})
    floor = aeroloop.run_experiment(unquantized, duration_s).z_track
    assert floor is not None

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot(xlabel="bits of attitude and rate", ylabel="z_track, 10⁻⁴ s", yscale="log")
    axes.plot(BITS, [error * 1e4 for error in errors], "o-", label="quantized")
    axes.axhline(floor * 1e4, linestyle="--", color="gray", label="not quantized")
    axes.legend()
    figure.savefig(out)
    print(f"drawn into {out}")


if __name__ == "__main__":
    main(*(convert(word) for convert, word in zip((float, str), sys.argv[1:], strict=False)))
