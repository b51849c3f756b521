"""Terminal table of a sweep: what was run, what it cost, where the rows are."""

from __future__ import annotations

from rich.console import Console

from aeroloop.service.sweep.sweep import Sweep
from aeroloop.service.terminal.display import labelled


def sweep_table(sweep: Sweep) -> None:
    """Print what a sweep did."""
    table = labelled()
    seeds = sweep.experiments // sweep.configurations
    table.add_row(
        "experiments", f"{sweep.experiments}: {_count(sweep.configurations, 'configuration')} × {_count(seeds, 'seed')}"
    )
    table.add_row("run now", f"{sweep.done} in {sweep.seconds:.1f} s")
    table.add_row("resumed", str(sweep.resumed))
    table.add_row("failed", f"{sweep.failed}{' (column reason says why)' if sweep.failed else ''}")
    if sweep.cpu_s_per_experiment is not None:
        table.add_row("cost of an experiment", f"{sweep.cpu_s_per_experiment:.3g} s of a core")
    if sweep.overhead_ms_per_job is not None:
        table.add_row("between two jobs", f"{sweep.overhead_ms_per_job:.2g} ms")
    table.add_row("table", sweep.out)
    table.add_row("rows", sweep.rows)
    Console().print(table)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
