"""Terminal tables of several runs, side by side; the rows are those of the HTML page."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from aeroloop.service.report.rows import figure_rows, shown
from aeroloop.service.review.report import Report, differences
from aeroloop.service.terminal.log_tables import DAMAGES_SHOWN, timed


def comparison_tables(reports: Sequence[Report]) -> None:
    """Print the figures of several runs and the differences between their configurations."""
    console = Console()
    figures = Table("", box=None)
    differing = Table("differs in the configurations", box=None)
    for report in reports:
        figures.add_column(escape(report.name), justify="right")
        differing.add_column(escape(report.name), overflow="fold")
    figures.add_column("")
    for row in figure_rows([report.findings for report in reports]):
        figures.add_row(row.figure.name, *(value.text for value in row.values), row.figure.unit)
    for key, values in differences(reports):
        differing.add_row(key, *(escape(shown(value)) for value in values))
    console.print(figures)
    console.print()
    console.print(differing if differing.row_count else "the configurations are the same")
    for report in reports:
        trips = [f"{when} {mark.text}" for when, mark in timed(report.findings.marks) if mark.kind == "tripped"]
        for line in [*trips, *report.findings.damages[:DAMAGES_SHOWN]]:
            console.print(f"{report.name}: {line}", markup=False)
