"""Each benchmark runs and prints its rows: one smoke run each, as short as its arguments allow."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parent.parent
LONGEST_S: Final = 300.0
"""Limit of one run, which takes 5 to 30 s on two idle cores; only a benchmark that hangs reaches it."""

RUNS: Final = {
    "tests.benchmarks": ["--turns=1", "--seconds=2", "--log-s=1"],
    "tests.benchmarks.console": ["1"],
    "tests.benchmarks.design": ["4", "40", "--duration=1", "--set=law.damping_bound=0.0126"],
    "tests.benchmarks.firmware": [],
    "tests.benchmarks.fit": ["as configured"],
    "tests.benchmarks.floods": ["--tries", "1", "tcp=20"],
    "tests.benchmarks.loss": ["--seconds=3", "--transport", "mixed", "--", "loss=0"],
}
NEEDS: Final = {
    "tests.benchmarks.firmware": "qemu-system-arm",
    "tests.benchmarks.floods": "nft",
    "tests.benchmarks.loss": "nft",
}
ON_NETWORK_NAMESPACES: Final = ("tests.benchmarks.floods", "tests.benchmarks.loss")


def test_every_benchmark_has_a_smoke_run() -> None:
    programs = {f"tests.benchmarks.{path.stem}" for path in (ROOT / "tests/benchmarks").glob("*.py")}
    # `loop` holds rows of `__main__`, which is run as the package.
    assert set(RUNS) == programs - {"tests.benchmarks.__main__", "tests.benchmarks.loop"} | {"tests.benchmarks"}


@pytest.mark.realtime
@pytest.mark.processes
@pytest.mark.parametrize("program", RUNS)
def test_a_benchmark_prints_figures(program: str) -> None:
    """In real time, as some run the loop; nothing is asserted of the figures."""
    if program in NEEDS and shutil.which(NEEDS[program]) is None:
        pytest.skip(f"{NEEDS[program]} is not installed")
    if program in ON_NETWORK_NAMESPACES and os.geteuid() != 0:
        pytest.skip("network namespaces need root")
    command = [sys.executable, "-m", program, *RUNS[program]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    assert done.returncode == 0, done.stderr
    rows_with_figures = re.findall(r"^.*\d.*$", done.stdout, re.MULTILINE)
    assert rows_with_figures, "nothing was printed"
