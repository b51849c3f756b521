"""`aeroloop log`: what is done with logs, and a running loop served to viewers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from math import inf, isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from aeroloop.protocol.plugins import trusting
from aeroloop.service.cli.common import (
    Address,
    Config,
    Force,
    Json,
    NewLog,
    Overrides,
    Port,
    fail,
    load_settings,
    report,
    show,
    working,
)
from aeroloop.service.cli.entry import run_alone

if TYPE_CHECKING:
    from threading import Event

    from aeroloop.service.review.report import Report

Logs = Annotated[list[Path], typer.Argument(help="MCAP logs, folders, or a rotated run.")]
Html = Annotated[Path | None, typer.Option("--html", help="Write an interactive page that needs no network.")]
Vehicle = Annotated[
    str | None, typer.Option("--vehicle", metavar="NAME", help="Vehicle; the longest session's if left out.")
]
Since = Annotated[float, typer.Option("--from", metavar="S", help="From this time on only.", show_default=False)]
Until = Annotated[float, typer.Option("--to", metavar="S", help="To this time only.", show_default=False)]

TrustLaw = Annotated[
    bool,
    typer.Option(
        "--trust-law",
        help="Import the law, and the plant, that the log names, which runs their code. Without it only ours, those "
        "installed beside aeroloop, and what this command names are imported.",
    ),
]

Session = Annotated[str | None, typer.Option("--session", metavar="N|NAME", help="Session; the longest if left out.")]

Require = Annotated[
    list[str] | None,
    typer.Option(
        "--require",
        metavar="FIGURE=LIMIT",
        help="Exit with 1 unless a figure (of every run) is at most this, such as z_track=50e-4, skipped_ticks=0 or "
        "latency_us.p99=2000; theorem.held=1: unless the run kept to all that is proven.",
    ),
]

LIVE_HZ: Final = 30.0
"""Messages a second of each topic to a viewer."""

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
    session: Session = None,
    vehicle: Vehicle = None,
    html: Html = None,
    trust_law: TrustLaw = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compute every figure of a run from its logs. Checks limits, and draws the paper's figures."""
    from aeroloop.service.logs.outputs import check_output, writing_into
    from aeroloop.service.review.requirements import Limit, broken_limits
    from aeroloop.service.review.review import read
    from aeroloop.service.terminal.log_sheets import review_sheets

    limits = [Limit.parse(text) for text in require or []]
    check_output(html, logs, force=force)
    _check_part(since_s, until_s)
    with working("reading", json, 1) as update, trusting(trust_law):
        judged = read(*logs, session=session, vehicle=vehicle, progress=update, since_s=since_s, until_s=until_s)
    if figures is not None:
        from aeroloop.service.report.plots import draw_figures

        with writing_into(figures, logs, force=force) as folder, working("drawing", json, 1) as update:
            drawn = draw_figures(judged.report(), judged.settings, folder, update)
        names = ", ".join(dict.fromkeys(path.stem for path in drawn))
        report(f"drew {names} into {figures}, as PDF, SVG and PNG")
    if html is not None:
        _write_page([judged.report(limits)], html, logs, force)
    findings = judged.checked(limits)
    show(findings, json, review_sheets)
    if broken := broken_limits(findings):
        fail("; ".join(broken), 1)


@group.command()
def compare(
    logs: Annotated[list[Path], typer.Argument(help="MCAP logs, or a folder for each run.")],
    html: Html = None,
    require: Require = None,
    trust_law: TrustLaw = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compare figures and configurations of several runs."""
    if len(logs) < 2:
        fail("log compare takes two logs or more", 2)
    from aeroloop.service.logs.outputs import check_output
    from aeroloop.service.review.requirements import Limit, broken_limits
    from aeroloop.service.review.review import compared, read_runs
    from aeroloop.service.terminal.log_sheets import comparison_sheets

    limits = [Limit.parse(text) for text in require or []]
    check_output(html, logs, force=force)
    with working("reading", json, 1) as update, trusting(trust_law):
        reports = read_runs(logs, limits, update)
    if html is not None:
        _write_page(reports, html, logs, force)
    show(compared(reports), json, lambda _: comparison_sheets(reports))
    if broken := [f"{run.name}: {line}" for run in reports for line in broken_limits(run.findings)]:
        fail("; ".join(broken), 1)


def _check_part(since_s: float, until_s: float) -> None:
    if since_s >= until_s:
        fail(f"--from {since_s:g} is not before --to {until_s:g}", 2)


def _write_page(reports: Sequence[Report], out: Path, logs: Sequence[Path], force: bool) -> None:
    from aeroloop.service.logs.outputs import writing
    from aeroloop.service.report.page import page

    with writing(out, logs, force=force) as part:
        part.write_text(page(reports), encoding="utf-8")
    report(f"wrote {out}")


@group.command()
def replay(
    logs: Logs,
    end: Annotated[
        Literal["controller", "plant", "c"] | None,
        typer.Option("--end", help="Only this end, c: the controller as `show c` exports it; both if left out."),
    ] = None,
    machine: Annotated[
        Literal["host", "aarch64", "cortex-m4"], typer.Option("--machine", help="With --end c: where it runs.")
    ] = "host",
    trust_law: TrustLaw = False,
    vehicle: Vehicle = None,
    json: Json = False,
) -> None:
    """Compute both ends again from their traces, byte for byte. Exits with 1 unless all of it is the same."""
    from aeroloop.protocol.messages.trace import ENDS
    from aeroloop.service.logs.replay import replay
    from aeroloop.service.terminal.log_sheets import replay_sheets

    answering = None
    if end == "c":
        from aeroloop.service.firmware.machines import InC

        end, answering = "controller", InC(machine)
    elif machine != "host":
        fail("--machine is for --end c", 2)
    with working("replaying", json, 1) as update, trusting(trust_law):
        ends = [end] if end else ENDS
        replayed = replay(logs, progress=update, ends=ends, answering=answering, vehicle=vehicle)
    show(replayed, json, replay_sheets)
    if replayed.differs or not replayed.complete:
        raise typer.Exit(1)


@group.command()
def check(
    logs: Annotated[list[Path], typer.Argument(help="MCAP logs, and folders of logs.")],
    overrides: Overrides = None,
    law: Annotated[str | None, typer.Option("--law", metavar="KIND", help="Another law, as of law.kind.")] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="Accept what differs: written beside each log, and expected from then on.")
    ] = False,
    markdown: Annotated[
        Path | None, typer.Option("--markdown", metavar="FILE", help="Write the table for a pull request.")
    ] = None,
    trust_law: TrustLaw = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Judge a change by logs. Each is computed again and its closed loop runs again; exits with 1 on a difference."""
    from aeroloop.service.lab.check import check_logs
    from aeroloop.service.logs.outputs import check_output, writing
    from aeroloop.service.terminal.log_sheets import check_sheets
    from aeroloop.service.terminal.show import markdown as in_markdown

    words = [*(overrides or ()), *([f"law.kind={law}"] if law else [])]
    check_output(markdown, logs, force=force)
    with working("checking", json, 1) as update:
        results = check_logs(logs, words, accept=accept, trust_law=trust_law, progress=update)
    same = all(one.same for one in results)
    show({"same": same, "logs": results}, json, lambda _: check_sheets(results), keys=2)
    if markdown is not None:
        with writing(markdown, logs, force=force) as part:
            part.write_text(in_markdown(check_sheets(results)) + "\n", encoding="utf-8")
    if not same:
        raise typer.Exit(1)


At = Annotated[str, typer.Option("--at", metavar="S|tick:K", help="The instant: a time on the law's clock, or a tick.")]


def _instant(text: str) -> int | float:
    """A tick, or a time on the law's clock [s], as `--at` gives it."""
    word, _, number = text.partition(":")
    try:
        at = int(number) if word == "tick" else float(text)
    except ValueError:
        at = nan
    if not isfinite(at):
        fail(f"--at is a time such as 12.34, or a tick such as tick:6170, not {text}", 2)
    return at


@group.command()
def step(
    logs: Logs,
    at: At,
    following: Annotated[bool, typer.Option("--next", help="The tick after it.")] = False,
    previous: Annotated[bool, typer.Option("--previous", help="The tick before it.")] = False,
    until: Annotated[
        str | None,
        typer.Option(
            "--until",
            metavar="CONDITION",
            help="The first tick after it where a column of the exported table is so, as 'attitude_error_deg > 5', or "
            "where an event of a kind is: trip, fault, mark, change.",
        ),
    ] = None,
    session: Session = None,
    vehicle: Vehicle = None,
    trust_law: TrustLaw = False,
    json: Json = False,
) -> None:
    """Show all that is known of one tick. In a terminal, keys go on: n, p, u (until), q."""
    from aeroloop.service.review.instant import Instants
    from aeroloop.service.terminal.log_sheets import instant_sheets

    instant = _instant(at)
    with working("reading", json, 1) as update, trusting(trust_law):
        run = Instants(logs, session, vehicle, update)
    tick = run.tick_at(instant)

    if until is None:
        tick = run.tick_at(tick + following - previous)
    elif (later := run.find(until, tick)) is None:
        fail(f"no tick after {tick}, {tick * run.settings.loop.period:g} s: {until}", 1)
    else:
        tick = later
    show(run.at(tick), json, instant_sheets)
    live = not json and sys.stdin.isatty() and sys.stdout.isatty()
    while live and (key := typer.getchar()) not in ("q", "\x1b", "\x04"):
        moved: int | None = tick + {"n": 1, "\x1b[C": 1, "p": -1, "\x1b[D": -1}.get(key, 0)
        if key == "u":
            until = until or typer.prompt("until")
            moved = run.find(until, tick)
        if moved is None or not run.first <= moved <= run.last:
            report(f"no such tick beside {tick}: there are {run.first} to {run.last}")
        elif moved != tick:
            tick = moved
            typer.echo("\x1b[H\x1b[2J", nl=False)
            show(run.at(tick), json, instant_sheets)


@group.command()
def fork(
    logs: Logs,
    at: At,
    overrides: Overrides = None,
    gains: Annotated[
        list[str] | None, typer.Option("--gains", metavar="NAME=A,B,C", help="As --set law.NAME=[A,B,C].")
    ] = None,
    inject: Annotated[
        list[str] | None,
        typer.Option("--inject", metavar="FAULT", help="A fault, as of `op inject`, from that tick on."),
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", min=0.01, help="Length; the rest of the log if left out.")
    ] = None,
    log: NewLog = None,
    html: Html = None,
    session: Session = None,
    vehicle: Vehicle = None,
    trust_law: TrustLaw = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Continue a recorded run from an instant, with something changed. In lockstep, beside what was recorded."""
    from aeroloop.service.lab.fork import fork
    from aeroloop.service.logs.outputs import check_output
    from aeroloop.service.review.panels import MAX_POINTS
    from aeroloop.service.terminal.log_sheets import fork_sheets, fork_tree

    words = [
        *(overrides or ()),
        *(f"law.{name}=[{values}]" for name, _, values in (g.partition("=") for g in gains or ())),
    ]
    check_output(html, logs, force=force)
    with working("forking", json, 1) as update, trusting(trust_law):
        forked = fork(
            logs, _instant(at), session=session, vehicle=vehicle, overrides=words, faults=inject or (),
            duration_s=duration, log=log, progress=update,
        )  # fmt: skip
    reports = [one.report(points=MAX_POINTS // 2) for one in (forked.recorded, forked.forked)]
    if html is not None:
        _write_page(reports, html, logs, force)
    show(fork_tree(forked, reports), json, lambda _: fork_sheets(forked, reports))


@group.command()
def live(
    port: Port = 8765,
    address: Address = "127.0.0.1",
    config: Config = None,
    overrides: Overrides = None,
) -> None:
    """Serve a running loop to Foxglove or Lichtblick until ^C. It is a WebSocket."""
    settings = load_settings(config, overrides)
    vehicle = settings.vehicle

    def ready(url: str) -> None:
        layout = f"aeroloop show layout --set vehicle={vehicle}"
        typer.echo(f"{vehicle} at {url} for Foxglove and Lichtblick, until ^C; `{layout}` prints a layout to import")

    def run(stop: Event) -> None:
        from aeroloop.service.viewers.foxglove_server import serve

        serve(settings.network, vehicle, stop, address=address, port=port, rate_hz=LIVE_HZ, ready=ready)

    run_alone(run)


Format = Literal["parquet", "csv", "mcap"]


def _format_of(out: Path | None) -> Format:
    """The format that a new file's name ends in."""
    formats: dict[str, Format] = {".parquet": "parquet", ".csv": "csv", ".mcap": "mcap"}
    if out is None or out.suffix not in formats:
        fail("name the new file's format: --format, or --out FILE.parquet, FILE.csv or FILE.mcap", 2)
    return formats[out.suffix]


@group.command()
def export(
    logs: Logs,
    form: Annotated[
        Format | None,
        typer.Option("--format", help="Format of the new file; what --out ends in if left out."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="The new file; the log's name with another suffix if left out.")
    ] = None,
    session: Session = None,
    vehicle: Vehicle = None,
    since_s: Since = -inf,
    until_s: Until = inf,
    around: Annotated[
        tuple[str, float] | None,
        typer.Option(
            "--around",
            metavar="EVENT S",
            help="Only S seconds before and after a trip, fault or mark, or words of one.",
        ),
    ] = None,
    trust_law: TrustLaw = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a log as a table with a row for each tick. With --format mcap: all that can be read of it, as one log."""
    from aeroloop.service.terminal.log_sheets import export_sheets

    _check_part(since_s, until_s)
    if form is None:
        form = _format_of(out)
    if form == "mcap" and (session, vehicle, since_s, until_s) != (None, None, -inf, inf):
        fail("--session, --vehicle, --from and --to choose the rows of a table; --format mcap takes --around only", 2)
    with working("exporting", json, 1) as update, trusting(trust_law):
        if form == "mcap":
            from aeroloop.service.logs.copies import copy

            exported = copy(logs, out, around=around, force=force, progress=update)
        else:
            from aeroloop.service.logs.export import export

            exported = export(
                logs, form, out, session=session, vehicle=vehicle, since_s=since_s, until_s=until_s, around=around,
                force=force, progress=update,
            )  # fmt: skip
    show(exported, json, export_sheets)
