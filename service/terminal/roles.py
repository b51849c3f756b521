"""Roles of a vehicle as `op status` and `op top` draw them: a table, and a line for each cause and note.

What is silent is marked with the age of its last status.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from typing import Final

from rich.console import Console, Group
from rich.text import Text

from aeroloop.protocol.messages.models import Percentiles, Status
from aeroloop.protocol.messages.states import NOT_RECORDING
from aeroloop.protocol.transport.certificate import SOON_DAYS
from aeroloop.service.host.health import NEEDED, SILENT_S, troubles
from aeroloop.service.host.operator import Gathered
from aeroloop.service.terminal.show import Row, table

GOOD, BAD, WAITING, STALE = "green", "bold red", "yellow", "dim"
SILENT: Final = "silent"
STYLES: Final = {
    **dict.fromkeys(("running", "driven", "recording", "routing"), GOOD),
    **dict.fromkeys(("tripped", "faulted", NOT_RECORDING, SILENT), BAD),
}
"""Of a role's state; other states are `WAITING`."""


def roles_view(statuses: Mapping[str, tuple[float, Status]], width: int) -> Group:
    """The roles of one vehicle, for a terminal of this width.

    Args:
        statuses: By role: the age of its status [s], and the status.
        width: Columns of the terminal.
    """
    rows = [_row(role, age, status) for role, (age, status) in sorted(statuses.items())]
    lines = [line for role, (age, status) in sorted(statuses.items()) for line in _lines(role, age, status)]
    lines += [Text(f"no {role}", style=WAITING) for role in NEEDED if role not in statuses]
    styles = {row["state"]: STYLES.get(row["state"], WAITING) for row in rows}
    return Group(*([table(rows, width, styles=styles)] if rows else []), *lines)


def status_view(found: Gathered) -> None:
    """Print every vehicle's roles, as gathered."""
    console = Console()
    for i, (vehicle, roles) in enumerate(sorted(found.statuses.items())):
        console.print(*([""] if i else []), Text(vehicle, style="bold"), sep="\n")
        console.print(roles_view({role: (status.age_s, status) for role, status in roles.items()}, console.width))


def troubles_view(found: Gathered) -> None:
    """Print a line for each trouble; without any, one for each vehicle."""
    console, wrong = Console(), troubles(found)
    for trouble in wrong:
        console.print(Text(trouble.text, style=BAD), soft_wrap=True)
    for vehicle, roles in sorted(found.statuses.items()) if not wrong else []:
        states = ", ".join(f"{role} {status.state}" for role, status in sorted(roles.items()))
        console.print(Text(f"{vehicle} is well: {states}", style=GOOD), soft_wrap=True)


def _row(role: str, age: float, status: Status) -> Row:
    def p50_p99(spread: Percentiles | None) -> str:
        return f"{spread.p50:.0f}/{spread.p99:.0f}" if spread else "–"

    return {
        "role": role,
        "state": SILENT if age > SILENT_S else status.state,
        "rate 1/s": f"{status.rate_hz:.0f}",
        "skipped ticks": str(status.skipped),
        "latency p50/p99 µs": p50_p99(status.latency_us),
        "answers in p50/p99 µs": p50_p99(status.age_us),
        "up": duration(status.uptime_s),
    }


def _lines(role: str, age: float, status: Status) -> Iterator[Text]:
    if age > SILENT_S:
        yield Text(f"{role}: no status for {duration(age)}, then {status.state}", style=BAD)
    if status.cause:
        since = f" ({status.since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC)" if status.since else ""
        yield Text(f"{role}: {status.cause}{since}", style=STYLES.get(status.state, WAITING))
    if status.unkept:
        yield Text(f"{role}: would forget a stop at a restart: {status.unkept}", style=BAD)
    if (until := status.certificate_until) and until - datetime.now(UTC) < timedelta(days=SOON_DAYS):
        yield Text(f"{role}: its certificate expires at {until:%Y-%m-%d %H:%M} UTC", style=WAITING)
    for note in status.notes:
        yield Text(f"{role}: {note}", style=WAITING)
    for fault in status.faults:
        begins, ends = fault.begin_tick, fault.end_tick
        if begins is not None and begins < status.ticks and (ends is None or status.ticks <= ends):
            yield Text(f"{role}: {fault.fault} ({fault.source}): {fault.changed} {fault.effect}", style=BAD)
    if status.gains is not None:
        gains = ", ".join(f"{name} {' '.join(f'{x:g}' for x in gain)}" for name, gain in status.gains.named.items())
        yield Text(f"{role}: reference {status.reference} ({status.reference_from})")
        yield Text(f"{role}: gains {gains} ({status.gains_from})")


def duration(seconds: float) -> str:
    """A duration in the unit that leaves two or three digits."""
    for unit, name in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * unit:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds:.0f} s"
