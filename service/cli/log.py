"""`aeroloop log`: reviews, compares, replays, recovers and exports logs, and serves a running loop to viewers."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from aeroloop.service.cli.common import (
    Config,
    DaemonOptions,
    Force,
    Json,
    Overrides,
    Require,
    checked,
    fail,
    guarded,
    run_alone,
    settings_of,
    show,
)
from aeroloop.service.cli.compare import Html, check_page, compare, write_html

if TYPE_CHECKING:
    from threading import Event

    from aeroloop.service.logs.export import Exported
    from aeroloop.service.logs.recover import Recovery

Logs = Annotated[list[Path], typer.Argument(help="MCAP logs, folders, or a rotated run.", show_default=False)]

Vehicle = Annotated[
    str | None,
    typer.Option("--vehicle", metavar="NAME", help="Vehicle; the longest session's if left out.", show_default=False),
]

group = typer.Typer()


def _part(since_s: float | None, until_s: float | None, until: str) -> tuple[float, float]:
    """From when to when to read, on the law's clock [s]; exits with 2 if that is no time. `until` names the option."""
    part = -inf if since_s is None else since_s, inf if until_s is None else until_s
    if part[0] >= part[1]:
        fail(f"--from {part[0]:g} is not before {until} {part[1]:g}", 2)
    return part


@group.command()
def review(
    logs: Logs,
    figures: Annotated[
        Path | None,
        typer.Option("--figures", help="Draw the paper's figures into this folder: PDF, SVG, PNG.", show_default=False),
    ] = None,
    since_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Review from this time on only.", show_default=False)
    ] = None,
    until_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Review to this time only.", show_default=False)
    ] = None,
    require: Require = None,
    session: Annotated[
        str | None,
        typer.Option("--session", metavar="N|NAME", help="Session; the longest if left out.", show_default=False),
    ] = None,
    vehicle: Vehicle = None,
    html: Html = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compute every figure of a run from its logs, check limits, and draw the paper's figures."""
    from aeroloop.service.review.requirements import Limit, broken_limits

    with checked():
        limits = [Limit.parse(text) for text in require or []]
    if html is not None:
        check_page(html, logs, force)

    from aeroloop.service.logs.outputs import writing_into
    from aeroloop.service.review.review import read
    from aeroloop.service.terminal.display import share_bar
    from aeroloop.service.terminal.log_tables import review_account

    begin_s, end_s = _part(since_s, until_s, "--to")
    with guarded():
        with share_bar("reading", hidden=json) as update:
            judged = read(*logs, session=session, vehicle=vehicle, progress=update, since_s=begin_s, until_s=end_s)
        if figures is not None:
            from aeroloop.service.report.plots import draw_figures

            with writing_into(figures, logs, force=force) as folder:
                drawn = draw_figures(judged.report(), judged.settings, folder)
            names = ", ".join(dict.fromkeys(path.stem for path in drawn))
            typer.echo(f"aeroloop: drew {names} into {figures}, as PDF, SVG and PNG", err=True)
        if html is not None:
            write_html([judged.report(limits)], html, logs, force)
    findings = judged.checked(limits)
    show(findings, json, review_account)
    if broken := broken_limits(findings):
        fail("; ".join(broken), 1)


group.command()(compare)


@group.command()
def replay(
    logs: Logs,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override the logged configuration.")
    ] = None,
    end: Annotated[
        Literal["controller", "plant"] | None,
        typer.Option("--end", help="Only this end; both if left out.", show_default=False),
    ] = None,
    since_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Replay from this time on only.", show_default=False)
    ] = None,
    until_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Replay to this time only.", show_default=False)
    ] = None,
    json: Json = False,
) -> None:
    """Compute both ends again from their traces and compare byte for byte; exit with 1 unless all of it is the same."""
    from aeroloop.protocol.messages.trace import ENDS
    from aeroloop.service.logs.replay import replay
    from aeroloop.service.terminal.display import share_bar
    from aeroloop.service.terminal.log_tables import replay_table

    times_s = _part(since_s, until_s, "--to")
    with guarded(), share_bar("replaying", hidden=json) as update:
        replayed = replay(logs, overrides or [], update, [end] if end else ENDS, *times_s)
    show(replayed, json, replay_table)
    if not overrides and (replayed.differs or not replayed.complete):
        raise typer.Exit(1)


@group.command()
def recover(
    broken: Annotated[Path, typer.Argument(help="A log that was cut or damaged; it is not changed.")],
    out: Annotated[Path, typer.Argument(help="The new file.")],
    force: Force = False,
    json: Json = False,
) -> None:
    """Copy the whole records of a broken log into a new log and report what was lost."""
    from aeroloop.service.logs.recover import recover
    from aeroloop.service.terminal.display import share_bar

    def account(recovery: Recovery) -> None:
        typer.echo(f"{recovery.out}: {recovery.messages} messages on {recovery.channels} channels")
        for line in recovery.lost:
            typer.echo(f"not recovered, {line}")

    with guarded(), share_bar("recovering", hidden=json) as update:
        recovery = recover(broken, out, update, force=force)
    show(recovery, json, account)


@group.command()
def live(
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="TCP port; 0 is any free one.")] = 8765,
    address: Annotated[str, typer.Option("--address", help="Address to listen on; 0.0.0.0 is all.")] = "127.0.0.1",
    rate: Annotated[float, typer.Option("--rate", min=0.1, max=1000, help="Messages a second of each topic.")] = 30.0,
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Serve a running loop to Foxglove or Lichtblick over a WebSocket until ^C."""
    settings = settings_of(config, overrides)
    vehicle = settings.vehicle

    def ready(url: str) -> None:
        layout = f"aeroloop show layout --vehicle {vehicle}"
        typer.echo(f"{vehicle} at {url} for Foxglove and Lichtblick, until ^C; `{layout}` prints a layout to import")

    def run(stop: Event) -> None:
        from aeroloop.service.viewers.foxglove_server import serve

        serve(settings.network, vehicle, stop, address=address, port=port, rate_hz=rate, ready=ready)

    run_alone(run, DaemonOptions())


@group.command()
def export(
    logs: Logs,
    to: Annotated[Literal["parquet", "csv", "mat", "mcap"], typer.Option("--to", help="Format of the new file.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The new file; the log's name with another suffix if left out.", show_default=False),
    ] = None,
    session: Annotated[
        str | None,
        typer.Option("--session", metavar="N|NAME|all", help="The longest session if left out.", show_default=False),
    ] = None,
    vehicle: Vehicle = None,
    since_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Rows from this time on only.", show_default=False)
    ] = None,
    until_s: Annotated[
        float | None, typer.Option("--until", metavar="S", help="Rows to this time only.", show_default=False)
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a log as a table with a row per tick or, with --to mcap, as a log with every message decoded."""
    from aeroloop.service.logs.export import export
    from aeroloop.service.terminal.display import share_bar

    def account(exported: Exported) -> None:
        if exported.sessions is None:
            typer.echo(f"{exported.out}: {exported.rows} messages on {len(exported.columns)} channels")
        else:
            typer.echo(f"{exported.out}: {exported.rows} ticks of {', '.join(exported.sessions)}")
        for line in exported.damages:
            typer.echo(f"not read, {line}")
        for one in exported.unknown:
            typer.echo(str(one))

    times_s = _part(since_s, until_s, "--until")
    with guarded(), share_bar("exporting", hidden=json) as update:
        exported = export(
            logs,
            to,
            out,
            session=session,
            vehicle=vehicle,
            since_s=times_s[0],
            until_s=times_s[1],
            force=force,
            progress=update,
        )
    show(exported, json, account)
