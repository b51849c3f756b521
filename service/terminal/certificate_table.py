"""Terminal table of a certificate: verdict, remedies, every term."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from aeroloop.service.terminal.console import Console
from aeroloop.service.theorem.certificate import Certificate


def certificate_table(certificate: Certificate) -> None:
    """Print a certificate."""
    console = Console()
    console.print(Text(certificate.verdict, style="bold green" if certificate.holds else "bold red"))
    for remedy in certificate.remedies:
        how = f"  --set {' --set '.join(repr(change) for change in remedy.overrides)}" if remedy.overrides else ""
        console.print(Text(f"  {remedy.text}{how}"))
    console.print()
    table = Table("symbol", "value", "unit", "equation", "meaning", box=None)
    table.columns[1].justify = "right"
    table.columns[4].overflow = "fold"
    for term in certificate.terms:
        value = "–" if term.value is None else f"{term.value:.4g}"
        table.add_row(*(Text(cell) for cell in (term.symbol, value, term.unit, term.equation, term.meaning)))
    console.print(table)
