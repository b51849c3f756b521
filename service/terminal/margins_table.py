"""Terminal tables of margins: what a certificate survives, and below it from where simulation diverges."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rich.table import Table
from rich.text import Text

from aeroloop.service.lab.margins import NO_SET, Margin, Margins
from aeroloop.service.terminal.console import Console


def margins_table(margins: Margins) -> None:
    """Print the margins of every choice of bits and rate."""
    console = Console()
    first = {margin.bits: margin for margin in margins.margins}
    console.print(Text("largest age of a command", style="italic"))
    ages = _table(["with a set, ms", "in its ranges, ms", "limited by"])
    for bits, margin in first.items():
        ages.add_row(bits, *map(Text, (_age(margin.set_age_ms), _age(margin.age_ms), margin.limited_by)))
    console.print(ages)
    rates = dict.fromkeys(f"{margin.rate_hz:g} Hz" for margin in margins.margins)
    grids: tuple[tuple[str, Callable[[Margin], str]], ...] = (
        ("proven up to: delay, ms (or frames lost in a row)", _proven),
        ("simulation diverges from: delay, ms (or frames lost in a row)", _diverges),
    )
    for title, cell in grids:
        grid = _table([*rates])
        for bits in first:
            grid.add_row(bits, *(Text(cell(margin)) for margin in margins.margins if margin.bits == bits))
        console.print(Text(f"\n{title}", style="italic"))
        console.print(grid)
    for line in _notes(margins):
        console.print(Text(f"\n{line}"), soft_wrap=not console.is_terminal)


def _table(names: list[str]) -> Table:
    table = Table("bits", box=None, pad_edge=False)
    for name in names:
        table.add_column(name, justify="left" if name == "limited by" else "right", min_width=10)
    return table


def _age(age_ms: float | None) -> str:
    return "–" if age_ms is None else f"{age_ms:.1f}"


def _proven(margin: Margin) -> str:
    if margin.set_age_ms is None:
        return NO_SET
    return "–" if margin.delay_ms is None else f"{margin.delay_ms:.1f} ({margin.lost_frames})"


def _diverges(margin: Margin) -> str:
    delay, lost = margin.diverges_delay_ms, margin.diverges_lost_frames
    return f"{'–' if delay is None else f'{delay:g}'} ({'–' if lost is None else lost})"


def _notes(margins: Margins) -> Iterator[str]:
    yield (
        "A command's age is its hold (a period) + delay + frames lost in a row · period; a loop over a network has a "
        "period of delay by itself. Proven is a set of the paper's body, at every instant, and only while it lies "
        "within the ranges."
    )
    yield (
        f"Simulated is the same body for {margins.duration_s:g} s; it diverges if the plant trips, or ‖z‖ exceeds "
        f"{margins.diverged:g} in the second half; – is never, up to 1 s. A watchdog trips a real plant after "
        f"{margins.watchdog_ms:g} ms (plant.watchdog_s)."
    )
    if any(margin.set_age_ms is None for margin in margins.margins):
        yield (
            f"{NO_SET}: with law.damping_bound = {margins.damping_bound:g} none is proven at any age; a smaller bound "
            "may do, if ‖θ‖ is known to be within it."
        )
