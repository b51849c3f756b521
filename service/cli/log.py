"""`aeroloop log`: reviews, compares, replays, recovers and exports logs, and serves a running loop to viewers."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from aeroloop.service.cli.common import (
    Config,
    Force,
    Json,
    Overrides,
    Require,
    checked,
    fail,
    settings_of,
    show,
    working,
)
from aeroloop.service.cli.processes import run_alone

if TYPE_CHECKING:
    from threading import Event

    from aeroloop.service.logs.copies import Recovery
    from aeroloop.service.logs.export import Exported
    from aeroloop.service.review.report import Report
    from aeroloop.service.terminal.show import Sheets

Logs = Annotated[list[Path], typer.Argument(help="MCAP logs, folders, or a rotated run.")]
Html = Annotated[Path | None, typer.Option("--html", help="Write an interactive page that needs no network.")]
Vehicle = Annotated[
    str | None, typer.Option("--vehicle", metavar="NAME", help="Vehicle; the longest session's if left out.")
]
Since = Annotated[float, typer.Option("--from", metavar="S", help="From this time on only.", show_default=False)]
Until = Annotated[float, typer.Option("--to", metavar="S", help="To this time only.", show_default=False)]

LIVE_HZ: Final = 30.0
"""Messages a second of each topic to a viewer."""

SESSIONS_SHOWN = 9
"""Sessions that `log export` leaves out and names."""

group = typer.Typer()


@group.command()
def review(
    logs: Logs,
    figures: Annotated[
        Path | None, typer.Option("--figures", help="Draw the paper's figures into this folder: PDF, SVG, PNG.")
    ] = None,
    since_s: Since = -inf,
    until_s: Until = inf,
    require: Require = None,
    session: Annotated[
        str | None, typer.Option("--session", metavar="N|NAME", help="Session; the longest if left out.")
    ] = None,
    vehicle: Vehicle = None,
    html: Html = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compute every figure of a run from its logs. Checks limits, and draws the paper's figures."""
    from aeroloop.service.review.requirements import Limit, broken_limits

    with checked():
        limits = [Limit.parse(text) for text in require or []]
    _check_page(html, logs, force)

    from aeroloop.service.logs.outputs import writing_into
    from aeroloop.service.review.review import read
    from aeroloop.service.terminal.display import progress_bar
    from aeroloop.service.terminal.log_sheets import review_sheets

    _check_part(since_s, until_s)
    with progress_bar("reading", 1, hidden=json) as update:
        judged = read(*logs, session=session, vehicle=vehicle, progress=update, since_s=since_s, until_s=until_s)
    if figures is not None:
        from aeroloop.service.report.plots import draw_figures

        drawing = progress_bar("drawing", 1, hidden=json)
        with writing_into(figures, logs, force=force) as folder, drawing as update:
            drawn = draw_figures(judged.report(), judged.settings, folder, update)
        names = ", ".join(dict.fromkeys(path.stem for path in drawn))
        typer.echo(f"aeroloop: drew {names} into {figures}, as PDF, SVG and PNG", err=True)
    if html is not None:
        write_html([judged.report(limits)], html, logs, force)
    findings = judged.checked(limits)
    show(findings, json, review_sheets)
    if broken := broken_limits(findings):
        fail("; ".join(broken), 1)


@group.command()
def compare(
    logs: Annotated[list[Path], typer.Argument(help="MCAP logs, or a folder for each run.")],
    html: Html = None,
    require: Require = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compare figures and configurations of several runs."""
    from aeroloop.service.review.requirements import Limit, broken_limits

    if len(logs) < 2:
        fail("log compare takes two logs or more", 2)
    with checked():
        limits = [Limit.parse(text) for text in require or []]
    _check_page(html, logs, force)

    from aeroloop.service.review.review import Comparison, read_runs
    from aeroloop.service.terminal.display import progress_bar
    from aeroloop.service.terminal.log_sheets import comparison_sheets

    with progress_bar("reading", 1, hidden=json) as update:
        reports = read_runs(logs, limits, update)
    if html is not None:
        write_html(reports, html, logs, force)
    show(Comparison.of(reports), json, lambda _: comparison_sheets(reports))
    if broken := [f"{run.name}: {line}" for run in reports for line in broken_limits(run.findings)]:
        fail("; ".join(broken), 1)


def _check_part(since_s: float, until_s: float) -> None:
    if since_s >= until_s:
        fail(f"--from {since_s:g} is not before --to {until_s:g}", 2)


def _check_page(out: Path | None, logs: Sequence[Path], force: bool) -> None:
    """Check, before the logs are read, that their page may be written; else the command ends."""
    if out is not None:
        from aeroloop.service.logs.outputs import check_output

        check_output(out, logs, force=force)


def write_html(reports: Sequence[Report], out: Path, logs: Sequence[Path], force: bool) -> None:
    """Write the page of some runs and log its path. Raises AeroloopError if it cannot be written."""
    from aeroloop.service.logs.outputs import writing
    from aeroloop.service.report.page import page

    with writing(out, logs, force=force) as part:
        part.write_text(page(reports), encoding="utf-8")
    typer.echo(f"aeroloop: wrote {out}", err=True)


@group.command()
def replay(
    logs: Logs,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override the logged configuration.")
    ] = None,
    end: Annotated[
        Literal["controller", "plant"] | None, typer.Option("--end", help="Only this end; both if left out.")
    ] = None,
    json: Json = False,
) -> None:
    """Compute both ends again from their traces, byte for byte. Exits with 1 unless all of it is the same."""
    from aeroloop.protocol.messages.trace import ENDS
    from aeroloop.service.logs.replay import replay
    from aeroloop.service.terminal.log_sheets import replay_sheets

    with working("replaying", json, 1) as update:
        replayed = replay(logs, overrides or [], update, [end] if end else ENDS)
    show(replayed, json, replay_sheets)
    if not overrides and (replayed.differs or not replayed.complete):
        raise typer.Exit(1)


@group.command()
def recover(
    broken: Annotated[Path, typer.Argument(help="A log that was cut or damaged; it is not changed.")],
    out: Annotated[Path, typer.Argument(help="The new file.")],
    force: Force = False,
    json: Json = False,
) -> None:
    """Copy what is whole of a broken log into a new one. Reports what was lost."""
    from aeroloop.service.logs.copies import recover

    def sheets(recovery: Recovery) -> Sheets:
        found = f"{recovery.out}: {recovery.messages} messages on {recovery.channels} channels"
        yield "\n".join([found, *(f"not recovered, {line}" for line in recovery.lost)]), []

    with working("recovering", json, 1) as update:
        recovery = recover(broken, out, update, force=force)
    show(recovery, json, sheets)


@group.command()
def live(
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="TCP port; 0 is any free one.")] = 8765,
    address: Annotated[str, typer.Option("--address", help="Address to listen on; 0.0.0.0 is all.")] = "127.0.0.1",
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Serve a running loop to Foxglove or Lichtblick until ^C. It is a WebSocket."""
    settings = settings_of(config, overrides)
    vehicle = settings.vehicle

    def ready(url: str) -> None:
        layout = f"aeroloop show layout --set vehicle={vehicle}"
        typer.echo(f"{vehicle} at {url} for Foxglove and Lichtblick, until ^C; `{layout}` prints a layout to import")

    def run(stop: Event) -> None:
        from aeroloop.service.viewers.foxglove_server import serve

        serve(settings.network, vehicle, stop, address=address, port=port, rate_hz=LIVE_HZ, ready=ready)

    run_alone(run)


@group.command()
def export(
    logs: Logs,
    form: Annotated[Literal["parquet", "csv", "mat", "mcap"], typer.Option("--format", help="Format of the new file.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="The new file; the log's name with another suffix if left out.")
    ] = None,
    session: Annotated[
        str | None, typer.Option("--session", metavar="N|NAME|all", help="The longest session if left out.")
    ] = None,
    vehicle: Vehicle = None,
    since_s: Since = -inf,
    until_s: Until = inf,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a log as a table with a row for each tick. With --format mcap: a log with every message decoded."""
    from aeroloop.service.logs.export import export

    def sheets(exported: Exported) -> Sheets:
        if exported.sessions is None:
            found = f"{exported.rows} messages on {len(exported.columns)} channels"
        else:
            found = f"{exported.rows} ticks of {', '.join(exported.sessions)}"
        lines = [f"not read, {line}" for line in exported.damages] + [str(one) for one in exported.unknown]
        if others := exported.left_out:
            more = f" and {len(others) - SESSIONS_SHOWN} more" if len(others) > SESSIONS_SHOWN else ""
            names = ", ".join(others[:SESSIONS_SHOWN]) + more
            lines.append(f"not exported of this log: {names}; choose by --vehicle and --session, which may be all")
        yield "\n".join([f"{exported.out}: {found}", *lines]), []

    _check_part(since_s, until_s)
    with working("exporting", json, 1) as update:
        exported = export(
            logs,
            form,
            out,
            session=session,
            vehicle=vehicle,
            since_s=since_s,
            until_s=until_s,
            force=force,
            progress=update,
        )
    show(exported, json, sheets)
