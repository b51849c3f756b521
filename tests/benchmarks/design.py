"""Splits of a frame's bits whose error is proven, for the least payload: which bits to choose for a bound.

uv run python -m tests.benchmarks.design 4 40 --set law.damping_bound=0.0126    # degrees, kbit/s

The bound of a set costs milliseconds, so every split is tried, for the paper's body. Of those that none beats, with
less payload or a smaller bound, an experiment says beside the bound how well it tracks.
"""

import argparse
from functools import partial
from itertools import product, starmap
from math import inf

from aeroloop.protocol.wire.spec import SignalBits
from aeroloop.service.config import load
from aeroloop.service.lab.engine import cell, figures_row, open_workers, run_of
from aeroloop.service.terminal.show import show
from aeroloop.service.theorem.extremes import extremes
from aeroloop.service.theorem.invariant import reach
from aeroloop.service.theorem.premises import PlantBounds, premises

BITS = range(4, 15)  # of each signal


def main() -> None:
    """Print the front: no split has less payload and as small a bound as one of these."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("degrees", type=float, help="largest attitude error to be proven")
    parser.add_argument("kbit", type=float, help="largest payload of both frames [kbit/s]")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--duration", type=float, default=50.0, help="of the experiments [s]")
    given = parser.parse_args()
    settings = load(overrides=given.set)
    desired, period = extremes(settings), settings.loop.period
    found = list[tuple[float, float, float, str]]()  # payload, radius, degrees, bits
    for bits in map(str, starmap(SignalBits, product(BITS, repeat=3))):
        split = settings.model_copy(update={"wire": settings.wire.with_bits(bits)})
        payload = (split.wire.measurement.size + split.wire.command.size) * 8 / period / 1e3
        if payload <= given.kbit:
            at = reach(premises(split, desired, PlantBounds(period), 0.0, 0.0))
            if at is not None and at.degrees <= given.degrees:
                found.append((payload, at.radius, at.degrees, bits))
    front, least = list[tuple[float, float, float, str]](), inf
    for one in sorted(found):
        if one[1] < least:
            front.append(one)
            least = one[1]
    runs = [
        run_of(settings, [f"wire.{name}.bits={n}" for name, n in SignalBits.parse(bits)._asdict().items()])
        for *_, bits in front
    ]
    with open_workers() as workers:
        rows = workers.rows(partial(figures_row, duration_s=given.duration), runs)
    show(
        [
            {"kbit/s": f"{payload:g}", "bits": bits, "proven ‖z‖": f"{radius:.4f}", "proven": f"{degrees:.2f}°"}
            | {"z_track·1e4": row["reason"] or cell(row["z_track"], "{:.1f}", 1e4)}
            for (payload, radius, degrees, bits), row in zip(front, rows, strict=True)
        ]
    )


if __name__ == "__main__":
    main()
