"""One progress bar on stderr: drawn on a terminal, and erased at its end; elsewhere a share is a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import degrees, inf
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from aeroloop.protocol.wire.attitude import angle

if TYPE_CHECKING:
    from aeroloop.service.config import Settings
    from aeroloop.service.testing.process_group import ProcessGroup

LINE_S: Final = 10.0


@contextmanager
def progress_bar(title: str, total: float | None = None, *, hidden: bool = False) -> Iterator[Callable[..., None]]:
    """A bar, updated by the yielded `update(done, total, title)`; what is None stays.

    Where stderr is no terminal, a share (`total` is 1) is a line every `LINE_S` instead.
    """
    console = Console(stderr=True)
    line_due = inf if hidden or total != 1 or console.is_terminal else time.monotonic() + LINE_S
    columns = TextColumn("{task.description}", markup=False), BarColumn(20), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=hidden or not console.is_terminal) as progress:
        task = progress.add_task(title, total=total)

        def update(done: float | None = None, total: float | None = None, title: str | None = None) -> None:
            nonlocal line_due
            progress.update(task, completed=done, total=total, description=title)
            if time.monotonic() >= line_due:
                line_due = time.monotonic() + LINE_S
                now = progress.tasks[0]
                sys.stderr.write(f"aeroloop: {now.description}, {now.percentage:.0f} %\n")

        yield update


def demo_progress(settings: Settings, update: Callable[..., None]) -> Callable[[str, ProcessGroup], None]:
    """Update a bar with what the demo waits for, and from the first command on with time and error."""

    def show(waiting_for: str, now: ProcessGroup) -> None:
        if waiting_for or now.telemetry is None:
            update(title=f"waiting for {waiting_for}")
        else:
            error = degrees(angle(*now.telemetry.attitude_error))
            update(now.telemetry.tick * settings.loop.period, title=f"error {error:5.2f}°")

    return show
