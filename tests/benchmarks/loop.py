"""The loop in real time, in figures: `uv run python -m tests.benchmarks.loop`.

Recorder, plant and controller run as a user starts them, on TCP loopback, for some seconds a turn. Each turn is a row,
computed from its log and from the plant's last status alone:

- ticks that a command answered within a period, and ticks that none answered;
- round trip, from a measurement sent to its command received, and p99.9 of the plant's wake-up, in µs;
- z_track, and that over z_track of the same seconds in lockstep;
- resident and proportional memory of controller, plant and recorder halfway through, in MB of 10⁶ bytes.

    … [--seconds 20] [--rate 500] [--turns 3] [--set KEY=VALUE] [--python OLD/bin/python --python NEW/bin/python]

With several `--python` the turns alternate between the checkouts that these environments have installed, so that both
have the same share of what else the machine does. A last row for each has sums of ticks, the largest round trip, and
medians of all else.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple, NoReturn

from aeroloop.service.testing.process_group import free_rendezvous

COLUMNS: Final = (
    "environment, turn, ticks, in time, skipped, p50 µs, p99, p99.9, max, wake-up p99.9, z_track, × lockstep, "
    "RSS/PSS MB: controller, plant, recorder"
)
START_S: Final = 2.0
"""From a controller's start to its session, on an idle machine."""
PATIENCE_S: Final = 60.0

Figures = dict[str, Any]


class Turn(NamedTuple):
    """Figures of one run. Times are in µs; memory is resident and proportional, of each role, in MB."""

    ticks: int
    in_time: int
    skipped: int
    p50: float
    p99: float
    p999: float
    longest: float
    wake_p999: float
    z_track: float
    over_lockstep: float
    memory: list[tuple[float, float]]
    notes: list[str]

    def row(self) -> list[str]:
        """Cells of the table."""
        micros = (self.p50, self.p99, self.p999, self.longest, self.wake_p999)
        memory = ", ".join(f"{resident:.0f}/{shared:.0f}" for resident, shared in self.memory)
        counts = [str(self.ticks), f"{self.in_time / self.ticks:.3%}", str(self.skipped)]
        return [*counts, *(f"{us:.0f}" for us in micros), f"{self.z_track:.6f}", f"{self.over_lockstep:.4f}", memory]


def main() -> None:
    """Print a row for each turn of each environment, and one for all turns of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=500.0)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--python", action="append", help="interpreter of an environment; this one by default")
    given = parser.parse_args()
    environments = [Environment(path, given.rate, given.overrides) for path in given.python or [sys.executable]]
    for number, environment in enumerate(environments, 1):
        print(f"{number}: {environment.version}, {environment.python}")
    lockstep = [environment.lockstep(given.seconds) for environment in environments]
    names = COLUMNS.split(", ", 12)
    print("\n| " + " | ".join(names) + " |\n|" + len(names) * "--:|")
    turns: list[list[Turn]] = [[] for _ in environments]
    for turn in range(1, given.turns + 1):
        for number, environment in enumerate(environments):
            turns[number].append(environment.turn(given.seconds, lockstep[number]))
            print_row(number + 1, str(turn), turns[number][-1])
    for number, done in enumerate(turns, 1):
        print_row(number, "all", together(done))
    for note in sorted({note for done in turns for turn in done for note in turn.notes}):
        print(f"\n{note}")


def print_row(environment: int, turn: str, figures: Turn) -> None:
    """Print a row of the table."""
    print("| " + " | ".join([str(environment), turn, *figures.row()]) + " |", flush=True)


def together(turns: Sequence[Turn]) -> Turn:
    """Sums of ticks, the largest round trip, medians of all else."""
    columns = list(zip(*turns, strict=True))
    sums, middle = map(sum, columns[:3]), map(median, columns[3:10])
    memory = [(median(r for r, _ in role), median(p for _, p in role)) for role in zip(*columns[10], strict=True)]
    return Turn._make([*sums, *middle, memory, []])._replace(longest=max(columns[6]))


class Environment:
    """An environment with aeroloop installed, used by its command line alone."""

    def __init__(self, python: str, rate_hz: float, overrides: Sequence[str]) -> None:
        self.python = python
        self.version = self._run("--version").strip()
        self._rate_hz = rate_hz
        self._overrides = [f"loop.rate_hz={rate_hz}", *overrides]

    def lockstep(self, seconds: float) -> float:
        """z_track of these seconds in lockstep."""
        with tempfile.TemporaryDirectory() as folder:
            words = ["demo", "--lockstep", f"--duration={seconds}", "--log", f"{folder}/log.mcap", "--json"]
            z_track: float = json.loads(self._run(*words, *options(self._overrides)))["z_track"]
            return z_track

    def turn(self, seconds: float, lockstep: float) -> Turn:
        """One run in real time."""
        own = [f"network.rendezvous={free_rendezvous()}", "controller.after_restart=configured"]
        words = options([*own, "controller.require_recorder=true", *self._overrides])
        with tempfile.TemporaryDirectory() as folder:
            with self._daemons(Path(folder), words, seconds) as daemons:
                time.sleep(START_S + seconds / 2)
                memory = [memory_mb(process.pid) for process in daemons]
                try:
                    daemons[0].wait(seconds + PATIENCE_S)
                except subprocess.TimeoutExpired:
                    fail(f"the controller does not end: {Path(folder, 'controller').read_text()}")
                (status,) = json.loads(self._run("op", "status", "--json", *words)).values()
            review = json.loads(self._run("log", "review", f"{folder}/log.mcap", "--json"))
        return self._figures(review, status["plant"], memory, seconds, lockstep)

    def _figures(
        self, review: Figures, plant: Figures, memory: list[tuple[float, float]], seconds: float, lockstep: float
    ) -> Turn:
        trip, period_us = review["latency_us"], 1e6 / self._rate_hz
        broken = [f"{review['sessions']} sessions instead of one"] if review["sessions"] != 1 else []
        return Turn(
            ticks=round(seconds * self._rate_hz) - 1,  # the last one ends the session
            in_time=sum(count for begin_us, count in review["timing"]["latency"]["bins"] if begin_us < period_us),
            skipped=review["skipped_ticks"],
            p50=trip["p50"],
            p99=trip["p99"],
            p999=trip["p999"],
            longest=trip["max"],
            wake_p999=plant["timing"]["wake"]["p999"],
            z_track=review["z_track"],
            over_lockstep=review["z_track"] / lockstep,
            memory=memory,
            notes=[*broken, *plant["notes"], *review["trips"], *review["damages"]],
        )

    @contextmanager
    def _daemons(self, folder: Path, words: list[str], seconds: float) -> Iterator[list[subprocess.Popen[bytes]]]:
        """Controller, plant and recorder, stopped at the end; each writes to a file that is named for it."""
        verbs = [
            ["controller", "--auto-arm", f"--duration={seconds}"],
            ["emulator"],
            ["recorder", f"--log={folder}/log.mcap"],
        ]
        processes = []
        try:
            for verb in verbs:
                with Path(folder, verb[0]).open("wb") as output:
                    processes.append(subprocess.Popen([self.python, "-Pm", "aeroloop", *verb, *words], stderr=output))
            yield processes
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                process.wait()

    def _run(self, *words: str) -> str:
        """Output of a verb. Ends this program with the verb's error if it fails."""
        command = [self.python, "-Pm", "aeroloop", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            fail(f"{' '.join(command)}: {done.stderr.strip()}")
        return done.stdout


def options(overrides: Sequence[str]) -> list[str]:
    """Overrides as words of a command line."""
    return [f"--set={override}" for override in overrides]


def memory_mb(pid: int) -> tuple[float, float]:
    """Resident and proportional memory of a process now [MB], see proc(5); the kernel's kB are 1024 bytes."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    resident, shared = (re.search(rf"^{name}:\s+(\d+) kB$", text, re.MULTILINE) for name in ("Rss", "Pss"))
    assert resident is not None
    assert shared is not None
    return int(resident[1]) * 1024e-6, int(shared[1]) * 1024e-6


def fail(line: str) -> NoReturn:
    """End with a line on stderr."""
    raise SystemExit(f"tests.benchmarks.loop: {line}")


if __name__ == "__main__":
    main()
