"""`aeroloop log compare`: compares several runs; also writes the HTML page of one or more runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aeroloop.service.cli.common import Force, Json, Require, checked, fail, guarded

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aeroloop.service.review.report import Report

Html = Annotated[
    Path | None, typer.Option("--html", help="Write an interactive page that needs no network.", show_default=False)
]


def compare(
    logs: Annotated[list[Path], typer.Argument(help="MCAP logs, or a folder for each run.", show_default=False)],
    html: Html = None,
    require: Require = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compare the figures and the configurations of several runs, side by side."""
    from aeroloop.service.review.requirements import Limit, broken_limits

    if len(logs) < 2:
        fail("log compare takes two logs or more", 2)
    with checked():
        limits = [Limit.parse(text) for text in require or []]
    if html is not None:
        check_page(html, logs, force)

    from aeroloop.service.review.compare import Comparison, read_runs
    from aeroloop.service.terminal.display import share_bar
    from aeroloop.service.terminal.log_tables import comparison_tables

    with guarded():
        with share_bar("reading", hidden=json) as update:
            reports = read_runs(logs, limits, update)
        if html is not None:
            write_html(reports, html, logs, force)
    if json:
        typer.echo(Comparison.of(reports).model_dump_json(indent=2))
    else:
        comparison_tables(reports)
    if broken := [f"{run.name}: {line}" for run in reports for line in broken_limits(run.findings)]:
        fail("; ".join(broken), 1)


def check_page(out: Path, logs: Sequence[Path], force: bool) -> None:
    """Check, before the logs are read, that their page may be written; else the command ends."""
    from aeroloop.service.logs.outputs import check_output

    with guarded():
        check_output(out, logs, force=force)


def write_html(reports: Sequence[Report], out: Path, logs: Sequence[Path], force: bool) -> None:
    """Write the page of some runs and log its path. Raises AeroloopError if it cannot be written."""
    from aeroloop.service.logs.outputs import writing
    from aeroloop.service.report.page import page

    with writing(out, logs, force=force) as part:
        part.write_text(page(reports), encoding="utf-8")
    typer.echo(f"aeroloop: wrote {out}", err=True)
