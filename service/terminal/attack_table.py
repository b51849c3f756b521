"""Terminal table of an attack: verdict, then the largest value found beside each bound."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from aeroloop.service.lab.attack import DIVERGED, Attack, Statement
from aeroloop.service.terminal.console import Console


def attack_table(attack: Attack, *, verbose: bool = False) -> None:
    """Print an attack; unless verbose, ‖z‖ of each kind of run, and of all else what comes nearest to its bound."""
    console = Console()
    verdict, style = _verdict(attack)
    console.print(Text(verdict, style=style))
    console.print(
        f"{attack.runs} experiments of {attack.duration_s:g} s, of which {attack.left_ranges} left the wire's ranges; "
        f"{attack.instants} instants for Lemma 1; seed {attack.seed}.\n"
    )
    table = Table("", "errors", "from", "largest", "bound", "share", box=None, pad_edge=False)
    for column in table.columns[2:]:
        column.justify = "right"
    for row in attack.statements if verbose else _nearest(attack.statements):
        numbers = (_number(value) for value in (row.start, row.found, row.bound, row.share))
        table.add_row(row.what, row.errors or "", *numbers)
    console.print(table)
    console.print("\nerrors: of the wire's quantizers, or any within their bounds. from: largest ‖x‖ at the start.")
    if attack.ticks_per_s:
        console.print(
            f"{attack.seconds:.0f} s, {attack.ticks_per_s / 1e6:.2f} million ticks a second; path: {attack.path}."
        )


def _verdict(attack: Attack) -> tuple[str, str]:
    if attack.beaten:
        beaten = [row.what for row in attack.statements if row.beaten]
        return f"Beaten: {', '.join(dict.fromkeys(beaten))} exceeds what is proven.", "bold red"
    if all(row.bound is None for row in attack.statements if row.what == "‖z‖"):
        return "No bound of ‖z‖ to beat: no invariant set is proven (`lab certify` says why).", "bold yellow"
    return "Not beaten: nothing found exceeds what is proven.", "bold green"


def _nearest(statements: list[Statement]) -> list[Statement]:
    """‖z‖ of every kind of run; of all else the nearest to its bound, Lemma 1 as one."""
    kinds: dict[tuple[str, ...], list[Statement]] = {}
    for row in statements:
        kind = (row.what, row.errors or "", str(row.start)) if row.what == "‖z‖" else ((row.errors and row.what) or "",)
        kinds.setdefault(kind, []).append(row)
    nearest = [max(rows, key=lambda row: (row.share or 0.0, row.found)) for rows in kinds.values()]
    return sorted(nearest, key=lambda row: row.what != "‖z‖")


def _number(value: float | None) -> str:
    return "–" if value is None else "diverges" if value >= DIVERGED else f"{value:.4g}"
