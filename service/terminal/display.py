"""Terminal tables and progress bars, drawn by rich.

Tables go to stdout, bars to stderr. A bar is drawn only on a terminal and erased at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from math import degrees
from typing import TYPE_CHECKING, Any, Final

from rich.columns import Columns
from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table
from rich.text import Text

from aeroloop.protocol.wire.attitude import angle
from aeroloop.service.figures import Figures

if TYPE_CHECKING:
    from aeroloop.service.config import Settings
    from aeroloop.service.testing.process_group import ProcessGroup

LABELS: Final = 22
"""Width of the column of labels."""

_stderr = Console(stderr=True)


def figures_table(figures: Figures) -> None:
    """Print figures of merit."""

    def shown(name: str, text: Callable[[Any], str]) -> str:
        value = getattr(figures, name)
        return f"— ({figures.reasons.get(name, 'not measured')})" if value is None else text(value)

    table = labelled()
    table.add_row("duration", f"{figures.duration_s:g} s")
    table.add_row("z_track", shown("z_track", lambda z: f"{z:.6f}   ({z * 1e4:.2f} ×10⁻⁴)"))
    table.add_row("u_total", shown("u_total", "{:.1f} V²·s".format))
    table.add_row("largest attitude error", shown("max_error_deg", "{:.2f}°".format))
    table.add_row("final attitude error", shown("final_error_deg", "{:.2f}°".format))
    for name, stream in (("measurements", figures.measurement), ("commands", figures.command)):
        if stream.frames_per_s is not None and stream.bits_per_s is not None:
            table.add_row(name, f"{stream.frames_per_s:.1f} frames/s, {stream.bits_per_s:.0f} payload bits/s")
    table.add_row("skipped ticks", shown("skipped_ticks", "{:.0f}".format))
    table.add_row("loop latency", shown("latency_us", "p50 {0.p50:.0f} µs, p99 {0.p99:.0f} µs".format))
    for trip in figures.trips:
        table.add_row("tripped", trip)
    for damage in figures.damages:
        table.add_row("not read", damage)
    if figures.log:
        table.add_row("log", figures.log)
    Console().print(table)


def labelled() -> Table:
    """An empty table of labels and texts."""
    labels, texts = Column(style="bold", no_wrap=True, min_width=LABELS), Column(overflow="fold")
    return Table(labels, texts, show_header=False, box=None, pad_edge=False)


class _Rate(ProgressColumn):
    """How many are done a second, lately."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.1f}/s")


@contextmanager
def _bar(title: str, total: float | None, hidden: bool, *columns: ProgressColumn) -> Iterator[Callable[..., None]]:
    shown = not hidden and _stderr.is_terminal
    drawn = (TextColumn(title), BarColumn(), *columns)
    with Progress(*drawn, console=_stderr, transient=True, disable=not shown) as progress:
        yield partial(progress.update, progress.add_task(title, total=total))


@contextmanager
def progress_bar(title: str, total_s: float, *, hidden: bool = False) -> Iterator[Callable[[float], None]]:
    """A bar updated with the seconds reached."""
    seconds = TextColumn("{task.completed:.0f}/{task.total:.0f} s")
    with _bar(title, total_s, hidden, seconds, TimeRemainingColumn()) as update:
        yield lambda reached: update(completed=reached)


@contextmanager
def count_bar(title: str, *, hidden: bool = False) -> Iterator[Callable[[int, int | None], None]]:
    """A bar updated with the number done and the number in all, None where it is open."""
    columns = MofNCompleteColumn(), _Rate(), TimeElapsedColumn(), TimeRemainingColumn()
    with _bar(title, None, hidden, *columns) as update:
        yield lambda done, total: update(completed=done, total=total)


@contextmanager
def share_bar(title: str, *, hidden: bool = False) -> Iterator[Callable[[float], None]]:
    """A bar updated with the share done, 0…1."""
    with _bar(title, 1.0, hidden, TextColumn("{task.percentage:.0f} %"), TimeRemainingColumn()) as update:
        yield lambda share: update(completed=share)


@contextmanager
def live_demo(settings: Settings, total_s: float) -> Iterator[Callable[[str, ProcessGroup], None]]:
    """The demo's live view on stderr: what it waits for; from the first command on, a bar and the figures of now."""
    bar = Progress(BarColumn(), TextColumn("{task.completed:5.1f}/{task.total:g} s"), console=_stderr)
    task = bar.add_task("", total=total_s)
    with Live("starting", console=_stderr, refresh_per_second=10, transient=True) as live:

        def update(waiting_for: str, now: ProcessGroup) -> None:
            if waiting_for or now.telemetry is None:
                states = f" ({now.states})" if now.states and now.telemetry is None else ""
                live.update(f"waiting for {waiting_for}{states}", refresh=True)
                return
            bar.update(task, completed=now.telemetry.tick * settings.loop.period)
            figures = [
                f"error {degrees(angle(*now.telemetry.attitude_error)):5.2f}°",
                f"voltages {' '.join(f'{u:+6.1f}' for u in now.telemetry.voltages)} V",
            ]
            if "controller" in now.statuses:
                skipped = sum(status.skipped for status in now.statuses.values())
                figures.append(f"{now.statuses['controller'].rate_hz:3.0f} ticks/s, {skipped} skipped")
            live.update(Group(bar, Columns(figures, padding=(0, 3, 0, 0))))

        yield update
