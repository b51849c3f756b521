"""Roles of a vehicle as `op status` shows them: a row each, and a row for each cause and note.

What is silent is marked with the age of its last status.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta

from aeroloop.protocol.messages.models import Percentiles, Status
from aeroloop.protocol.transport.certificate import SOON_DAYS
from aeroloop.service.host.health import NEEDED, SILENT_S, Trouble, lacking_recorder
from aeroloop.service.host.operator import Gathered
from aeroloop.service.terminal.show import Row, Sheets, paragraph


def role_sheets(statuses: Mapping[str, Status], vehicle: str) -> Sheets:
    """The roles of one vehicle, each with its last status; a recorder that is missed is missing, too."""
    roles = {*statuses, *NEEDED}
    notes = [{"role": role, "note": note} for role, status in sorted(statuses.items()) for note in _notes(status)]
    lacking = lacking_recorder(statuses)
    if lacking is not None:
        roles.add("recorder")
        notes.append({"role": "recorder", "note": f"{vehicle}{lacking}"})
    yield vehicle, [_row(role, statuses.get(role)) for role in sorted(roles)]
    if notes:
        yield "", notes


def status_sheets(found: Gathered) -> Sheets:
    """Every vehicle's roles, as gathered."""
    recorded = sorted(vehicle for vehicle, statuses in found.statuses.items() if "recorder" in statuses)
    for vehicle, statuses in sorted(found.statuses.items()):
        yield from role_sheets(statuses, vehicle)
        if recorded and vehicle not in recorded and lacking_recorder(statuses) is None:
            yield f"the recorder under {', '.join(recorded)} records every vehicle of its network", []


def trouble_sheets(found: Gathered, wrong: Sequence[Trouble]) -> Sheets:
    """A line for each trouble; without any, one for each vehicle."""
    lines = [trouble.text for trouble in wrong]
    for vehicle, roles in sorted(found.statuses.items()) if not lines else []:
        states = ", ".join(f"{role} {status.state}" for role, status in sorted(roles.items()))
        lines.append(f"{vehicle} is well: {states}")
    yield paragraph(lines), []


def _row(role: str, status: Status | None) -> Row:
    if status is None:
        columns = "rate 1/s", "skipped ticks", "latency p50/p99 µs", "answers in p50/p99 µs", "up"
        return {"role": role, "state": "missing"} | dict.fromkeys(columns, "–")

    def p50_p99(spread: Percentiles | None) -> str:
        return f"{spread.p50:.0f}/{spread.p99:.0f}" if spread else "–"

    return {
        "role": role,
        "state": "silent" if status.age_s > SILENT_S else status.state,
        "rate 1/s": f"{status.rate_hz:.0f}",
        "skipped ticks": str(status.skipped),
        "latency p50/p99 µs": p50_p99(status.latency_us),
        "answers in p50/p99 µs": p50_p99(status.age_us),
        "up": duration(status.uptime_s),
    }


def _notes(status: Status) -> Iterator[str]:
    if status.age_s > SILENT_S:
        yield f"no status for {duration(status.age_s)}, then {status.state}"
    if status.cause:
        since = f" ({status.since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC)" if status.since else ""
        yield status.cause + since
    if status.unkept:
        yield f"would forget a stop at a restart: {status.unkept}"
    if (until := status.certificate_until) and until - datetime.now(UTC) < timedelta(days=SOON_DAYS):
        yield f"its certificate expires at {until:%Y-%m-%d %H:%M} UTC"
    yield from status.notes
    for fault in status.faults:
        begins, ends = fault.begin_tick, fault.end_tick
        if begins is not None and begins < status.ticks and (ends is None or status.ticks <= ends):
            yield f"{fault.fault} ({fault.source}): {fault.changed} {fault.effect}"
    if status.gains is not None:
        yield f"reference {status.reference} ({status.reference_from})"
        gains = ", ".join(f"{name} {' '.join(f'{x:g}' for x in gain)}" for name, gain in status.gains.named.items())
        yield f"gains {gains} ({status.gains_from})"


def duration(seconds: float) -> str:
    """A duration in the unit that leaves two or three digits."""
    for unit, name in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * unit:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds:.0f} s"
