"""Terminal table of a certificate: verdict, remedies, the terms that decide, or every term."""

from __future__ import annotations

import re
from collections.abc import Container
from typing import Final

from rich.table import Table
from rich.text import Text

from aeroloop.service.terminal.console import Console
from aeroloop.service.theorem.certificate import Certificate

DECIDING: Final = (
    "‖δ_ε‖", "‖δ_ω‖", "‖δ_u‖", "max ∡e/2", "δ_V1", "c₀/2 − δ_V1", "k", "√(δ_Q/k)", "4 asin(√(δ_Q/k)/2)"
)  # fmt: skip
"""Symbols of the terms that are shown unless all are asked for: what goes in, what decides, what comes out."""


def certificate_table(certificate: Certificate, *, verbose: bool = False) -> None:
    """Print a certificate, with all of its terms if verbose."""
    console = Console()
    console.print(Text(certificate.verdict, style="bold green" if certificate.holds else "bold red"))
    for remedy in certificate.remedies:
        console.print(Text(f"  {remedy.text}{':' if remedy.overrides else ''}"))
        if remedy.overrides:  # left whole, to be copied
            how = " ".join(f"--set {change!r}" for change in remedy.overrides)
            console.print(Text(f"    {how}"), soft_wrap=True)
    console.print()
    console.print(_terms(certificate, None if verbose else DECIDING))
    if not verbose:
        console.print(Text(f"\n--verbose prints all {len(certificate.terms)} terms, with their equations."))


def _terms(certificate: Certificate, symbols: Container[str] | None) -> Table:
    table = Table("symbol", "value", "unit", "meaning", box=None, pad_edge=False)
    table.columns[1].justify = "right"
    for column in table.columns[:3]:
        column.no_wrap = True
    for term in certificate.terms:
        if symbols is None or term.symbol in symbols:
            value = "–" if term.value is None else f"{term.value:.4g}"
            meaning = f"{term.meaning} ({term.equation})" if symbols is None else re.split("[;,]", term.meaning)[0]
            table.add_row(*(Text(cell) for cell in (term.symbol, value, term.unit, meaning)))
    return table
