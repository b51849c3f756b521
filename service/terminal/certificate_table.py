"""Terminal table of a certificate: verdict, bounds, assumptions, the terms that decide, or every term."""

from __future__ import annotations

import re
from collections.abc import Container
from typing import Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from aeroloop.service.terminal.display import labelled
from aeroloop.service.theorem.any_law import OwnCertificate
from aeroloop.service.theorem.certificate import Certificate

DECIDING: Final = (
    "‖δ_ε‖", "‖δ_ω‖", "‖δ_u‖", "max ‖θ̃‖", "δ_V1", "c₀/2 − δ_V1", "k", "‖w_s‖", "‖w_f‖", "τ_h of the plant"
)  # fmt: skip
"""Symbols of the terms that are shown unless --verbose: what goes in, what decides, what comes out."""


def certificate_table(certificate: Certificate, *, verbose: bool = False) -> None:
    """Print a certificate, with all of its terms if verbose."""
    console = Console()
    console.print(Text(certificate.verdict, style="bold green" if certificate.holds else "bold red"))
    for reason in certificate.violated[1:]:
        console.print(Text(f"  {reason}"))
    console.print()
    console.print(_bounds(certificate))
    if certificate.delay_ms is not None:
        late = f"{certificate.delay_ms:.1f} ms of further delay, or {certificate.lost_frames} frames lost in a row"
        console.print(Text(f"\nIt still holds with {late}."))
    console.print(Text("\nAssumed:"))
    for assumption in certificate.assumptions:
        console.print(Text(f"  {assumption}"))
    console.print()
    console.print(_terms(certificate, None if verbose else DECIDING))
    if not verbose:
        console.print(Text(f"\n--verbose prints all {len(certificate.terms)} terms, with their equations."))


def own_certificate(certificate: OwnCertificate) -> None:
    """Print what a user's law says is proven."""
    console, table = Console(), labelled()
    console.print(Text(certificate.verdict, style="bold green" if certificate.holds else "bold red"))
    for name, value in (certificate.model_extra or {}).items():
        table.add_row(name, Text(str(value)))
    if table.row_count:
        console.print(table)


def _bounds(certificate: Certificate) -> Table:
    table = Table("proven, in the end", "‖z‖", "attitude", box=None, pad_edge=False)
    for what, radius, angle in (
        ("paper's body, root of the mean square", certificate.rms_radius, None),
        ("paper's body, at every instant", certificate.pointwise_radius, certificate.pointwise_deg),
        ("configured plant, at every instant", certificate.plant_radius, certificate.plant_deg),
    ):
        shown = "not proven" if radius is None else f"{radius:.4g}"
        table.add_row(what, shown, "" if angle is None else f"{angle:.2f}°")
    return table


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
