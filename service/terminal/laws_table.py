"""Terminal tables of compared laws: figures of each combination, then what each law survives."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

from rich.console import Console
from rich.table import Table
from rich.text import Text

from aeroloop.service.lab.tables import markdown_table
from aeroloop.service.sweep.laws import LawMargin, LawRow, Laws

_HEADER = ["law", "z_track 10⁻⁴ s", "u_total V²·s", "largest", "settled", "changes/s", "kbit/s"]
Sections = Iterator[tuple[str, list[list[str]]]]


def laws_table(laws: Laws) -> None:
    """Print a comparison of laws."""
    console = Console()
    for title, (header, *rows) in _sections(laws):
        console.print(Text(title, style="italic"), soft_wrap=not console.is_terminal)
        table = Table(box=None, pad_edge=False)
        for i, name in enumerate(header):
            table.add_column(name, justify="right" if i else "left", min_width=0 if i else 11, no_wrap=not i)
        failed = [row for row in rows if len(row) == 2]
        for row in rows:
            if row not in failed:
                table.add_row(*map(Text, row))
        console.print(table)
        for law, reason in failed:
            console.print(Text(f"{law}: {reason}", style="red"), soft_wrap=not console.is_terminal)
        console.print()
    for line in _notes(laws):
        console.print(Text(line), soft_wrap=not console.is_terminal)


def markdown(laws: Laws) -> str:
    """The same as Markdown."""
    lines: list[str] = []
    for title, (header, *rows) in _sections(laws):
        filled = [row if len(row) == len(header) else [row[0], row[1], *[""] * (len(header) - 2)] for row in rows]
        lines += [f"**{title}**", "", markdown_table([header, *filled]), ""]
    return "\n\n".join(["\n".join(lines).rstrip(), *_notes(laws)])


def _sections(laws: Laws) -> Sections:
    """Titles and rows of text, a header first; a row of two has no figures."""
    for (plant, sensors, wind, bits), rows in groupby(laws.rows, lambda r: (r.plant, r.sensors, r.wind, r.bits)):
        around = [f"sensors and wind: {wind}"] if sensors == wind else [f"sensors: {sensors}", wind]
        yield " · ".join([plant, *around, f"{bits} bits"]), [_HEADER, *map(_figures, rows)]
    for plant, margins in groupby(laws.margins, lambda margin: margin.plant):
        title = f"{plant} · calm · {laws.margin_at} · survived with an error within {laws.within_deg:g}°"
        yield title, [["law", "delay", "frames lost in a row"], *map(_margin, margins)]


def _figures(row: LawRow) -> list[str]:
    if row.reason is not None:
        return [row.law, row.reason]
    figures = ((row.z_track, "{:.1f}", 1e4), (row.u_total, "{:.0f}", 1), (row.max_error_deg, "{:.1f}°", 1),
               (row.second_half_error_deg, "{:.2f}°", 1), (row.command_changes_per_s, "{:.0f}", 1),
               (row.bits_per_s, "{:.1f}", 1e-3))  # fmt: skip
    return [row.law, *("–" if value is None else form.format(value * scale) for value, form, scale in figures)]


def _margin(margin: LawMargin) -> list[str]:
    delay, lost = margin.delay_ms, margin.lost_frames
    return [margin.law, "none" if delay is None else f"{delay:g} ms", "none" if lost is None else str(lost)]


def _notes(laws: Laws) -> Iterator[str]:
    bandwidth, damping = ("/".join(dict.fromkeys(f"{value:.2f}" for value in values)) for values in (
        laws.bandwidth, laws.damping_ratio))  # fmt: skip
    yield (
        f"Tuned to ωₙ = {bandwidth} rad/s and ζ = {damping} of the linearised error, which the paper's gains have "
        "(service/control/laws/README.md has the rule); a law of your own, and the configured one, as configured."
    )
    yield (
        f"{laws.duration_s:g} s each, {laws.seeds} seed{'s' * (laws.seeds > 1)}, sent on change. Settled is the "
        f"largest error of the second half. Survived for {laws.margin_duration_s:g} s, without a watchdog: commands "
        "that act later, or of which so many in a row never do, again and again, up to 1 s."
    )
    if laws.out is not None:
        yield f"All experiments: {laws.out}"
