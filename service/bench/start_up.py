"""Start-up of a verb: processor time of its process beside that of an interpreter that imports the libraries it needs.

Processor time and not the clock's, so that what `op status` waits for the network is left out. A first round, not
counted, writes the bytecode; both have the environment that the command line sets for itself.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Sequence
from typing import Final

from aeroloop.service.bench.item import Figure, NotMeasuredError, in_turns
from aeroloop.service.config import load
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous

WAIT_S: Final = 60.0
QUICK_ROUNDS: Final = 3
ROUNDS: Final = 15
_MODEL: Final = "pydantic; pydantic.create_model('M', a=(int, 0))"
"""Pydantic imports most of itself with the first model."""


def start_help(quick: bool) -> Figure:
    """`aeroloop --help` [s]."""
    return _start_up(["--help"], "rich.panel, rich.table, typer", quick)


def start_experiment(quick: bool) -> Figure:
    """`aeroloop lab experiment --duration 1` [s]."""
    return _start_up(["lab", "experiment", "--duration=1"], f"casadi, numpy, rich.table, typer, {_MODEL}", quick)


def start_status(quick: bool) -> Figure:
    """`aeroloop op status` while a plant answers [s]."""
    override = f"network.rendezvous={free_rendezvous()}"
    with ProcessGroup(load(overrides=[override, "loop.realtime=off"])) as processes:
        processes.start("plant")
        processes.await_role("plant")
        return _start_up(["op", "status", f"--set={override}"], f"rich.table, typer, zenoh, {_MODEL}", quick)


def _start_up(verb: Sequence[str], libraries: str, quick: bool) -> Figure:
    ours = ["-P", "-m", "aeroloop", *verb]
    floor = ["-P", "-c", f"import {libraries}"]
    _cpu_s(ours)
    return in_turns(lambda: _cpu_s(ours), lambda: _cpu_s(floor), QUICK_ROUNDS if quick else ROUNDS)


def _cpu_s(words: Sequence[str]) -> float:
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, *words]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=WAIT_S, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        last = [*done.stderr.splitlines(), ""][-1]
        raise NotMeasuredError(f"`{' '.join(words)}` ends with {done.returncode}: {last}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
