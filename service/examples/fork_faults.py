"""Search over faults at the hardest instants of a log: each is forked there, and what comes of it is printed.

aeroloop demo --lockstep --duration 20 --log run.mcap
python fork_faults.py run.mcap
"""

from __future__ import annotations

import sys

import numpy as np

import aeroloop

FAULTS = ["rate.y:bias=0.1@0..1", "motor1:off@0..0.5", "attitude:stuck@0..0.2", "command:drop=0.5@0..2"]


def main(path: str, instants: int = 3) -> None:
    """Print the largest attitude error within 5 s after each fault, at the hardest of the run's seconds."""
    run = aeroloop.read_run(path)
    errors = np.linalg.norm(run.ticks.attitude_error, axis=1)
    seconds = np.array_split(np.arange(len(errors)), max(1, round(run.time[-1])))
    hardest = sorted((int(second[np.argmax(errors[second])]) for second in seconds), key=lambda i: -errors[i])
    for tick in run.ticks.k[hardest[:instants]].tolist():
        for fault in FAULTS:
            fork = run.fork(at=tick, faults=[fault], duration_s=5)
            print(f"tick {tick}, {fault}: {fork.figures.max_error_deg:.2f}° {fork.ended or ''}")


if __name__ == "__main__":
    main(sys.argv[1])
