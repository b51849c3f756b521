"""What a person sees in the terminal: tables and progress, by rich."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import degrees
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from protocol.frames import FrameFormat, SignalSpec, WireSpec
from protocol.quantizer import UniformQuantizer
from service.figures import Figures

if TYPE_CHECKING:
    from service.demo import Progress as DemoProgress

_stderr = Console(stderr=True)


def figures_table(figures: Figures) -> None:
    """Print figures of merit."""
    rows: list[tuple[str, str]] = [
        ("duration", f"{figures.duration_s:g} s"),
        ("z_track", _or_why(figures, "z_track", lambda z: f"{z:.6f}   ({z * 1e4:.2f} ×10⁻⁴)")),
        ("u_total", _or_why(figures, "u_total", lambda u: f"{u:.1f} V²·s")),
        ("largest attitude error", _or_why(figures, "max_error_deg", lambda e: f"{e:.2f}°")),
        ("final attitude error", _or_why(figures, "final_error_deg", lambda e: f"{e:.2f}°")),
    ]
    for name, stream in (("measurements", figures.measurement), ("commands", figures.command)):
        if stream.frames_per_s is not None and stream.bits_per_s is not None:
            rows.append((name, f"{stream.frames_per_s:.1f} frames/s, {stream.bits_per_s:.0f} payload bits/s"))
    rows.append(("skipped ticks", _or_why(figures, "skipped_ticks", lambda n: f"{n:.0f}")))
    latency = figures.latency_us
    rows.append(
        (
            "loop latency",
            f"p50 {latency.p50:.0f} µs, p99 {latency.p99:.0f} µs"
            if latency
            else f"— ({figures.reasons.get('latency_us', 'not measured')})",
        )
    )
    if figures.log:
        rows.append(("log", figures.log))
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def _or_why(figures: Figures, name: str, text: Callable[[float], str]) -> str:
    value = getattr(figures, name)
    return f"— ({figures.reasons.get(name, 'not measured')})" if value is None else text(value)


@contextmanager
def progress_bar(title: str, total_s: float, *, hidden: bool = False) -> Iterator[Callable[[float], None]]:
    """A bar on stderr that is told the seconds reached; gone when it is done, and never in a pipe."""
    with Progress(
        TextColumn(title),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} s"),
        TimeRemainingColumn(),
        console=_stderr,
        transient=True,
        disable=hidden or not _stderr.is_terminal,
    ) as bar:
        task = bar.add_task(title, total=total_s)
        yield lambda reached: bar.update(task, completed=reached)


@contextmanager
def live_demo(total_s: float) -> Iterator[Callable[[DemoProgress], None]]:
    """The demo's live view on stderr: a bar and a line of what the loop is doing."""
    bar = Progress(
        BarColumn(), TextColumn("{task.completed:5.1f}/{task.total:g} s"), TimeRemainingColumn(), console=_stderr
    )
    task = bar.add_task("", total=total_s)
    with Live(bar, console=_stderr, refresh_per_second=10, transient=True) as live:

        def update(now: DemoProgress) -> None:
            bar.update(task, completed=now.time_s)
            up, down = now.bits_per_s
            volts = "  ".join(f"{u:+6.1f}" for u in now.voltages) or "–"
            line = (
                f"error {degrees(now.error_rad):5.2f}°   volts {volts}   {now.rate_hz:5.0f} Hz   "
                f"skipped {now.skipped}   {up / 1000:.1f} + {down / 1000:.1f} kbit/s"
            )
            live.update(Group(bar, line if now.statuses.get("controller") else "starting three processes …"))

        yield update


def wire_table(wire: WireSpec) -> None:
    """Print a wire spec: each signal's quantizer, each frame's size."""
    table = Table("signal", "bits", "limit", "step", "largest error", box=None)
    signals: dict[str, tuple[SignalSpec, str]] = {
        "ε attitude": (wire.attitude, ""),
        "ω rate": (wire.rate, "rad/s"),
        "u voltage": (wire.voltage, "V"),
    }
    for name, (signal, unit) in signals.items():
        quantizer = signal.quantizer()
        step = f"{quantizer.step:.6g} {unit}" if isinstance(quantizer, UniformQuantizer) else "–"
        bits = "cont" if signal.bits is None else str(signal.bits)
        table.add_row(name, bits, f"±{signal.limit:g} {unit}", step, f"{quantizer.bound:.6g} {unit}")
    Console().print(table)
    frames: tuple[tuple[str, FrameFormat], ...] = (("measurement", wire.measurement), ("command", wire.command))
    for label, kind in frames:
        Console().print(f"{label}: {kind.bits} bits in {kind.size} bytes")
