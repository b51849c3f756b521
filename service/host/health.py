"""Health of the roles on the network: what is tripped, faulted, silent, late or missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, Literal, NamedTuple

from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.states import NOT_RECORDING, ControllerState, PlantState
from aeroloop.service.host.operator import Gathered

SILENT_S: Final = 3.0
"""A role without a new status for this long, three of its periods, is silent [s]."""
LATE_SHARE: Final = 0.01
"""A loop that skipped more than this share of its ticks in the last 10 s is late."""
NEEDED: Final = ("controller", "plant")
"""Roles that every vehicle needs; a recorder may be absent, unless it was there or is required."""


def replaces(status: Status, last: Status, age_s: float) -> bool:
    """Whether a status takes the place of the `last` of its vehicle and role, received `age_s` before.

    Of several controllers of a vehicle the one with the session counts, else the first.
    """
    return status.role != "controller" or status.process == last.process or bool(status.session) or age_s > SILENT_S


class Trouble(NamedTuple):
    """Something that is wrong, in one line; vehicle and role are None of a process that does not answer."""

    kind: Literal["tripped", "faulted", "not recording", "lossy", "silent", "late", "missing", "not kept"]
    vehicle: str | None
    role: str | None
    text: str


def lacking_recorder(roles: Mapping[str, Status]) -> str | None:
    """Why a vehicle's recorder is missed, after the vehicle's name; None if it is not."""
    lacking = {status.lacks_recorder for status in roles.values()}
    if "gone" in lacking:
        return "'s recorder is gone: it was there, and did not stop in order"
    if "required" in lacking:
        return " has no recorder, and its controller requires one (controller.require_recorder)"
    return None


def troubles(found: Gathered) -> list[Trouble]:
    """Everything that is wrong, by vehicle and role; of one role the gravest."""
    wrong: list[Trouble] = []
    for vehicle, roles in sorted(found.statuses.items()):
        for role in sorted({*roles, *NEEDED}):
            if role not in roles:
                wrong.append(Trouble("missing", vehicle, role, f"{vehicle} has no {role}"))
            else:
                wrong += list(_of_role(vehicle, role, roles[role]))[:1]
        why = lacking_recorder(roles)
        if why is not None:
            wrong.append(Trouble("missing", vehicle, "recorder", f"{vehicle}{why}"))
    return wrong + [Trouble("silent", None, None, line) for line in found.silent]


def _of_role(vehicle: str, role: str, status: Status) -> Iterator[Trouble]:
    name = f"{vehicle}'s {role}"
    if status.age_s > SILENT_S:
        yield Trouble("silent", vehicle, role, f"{name}: no status for {status.age_s:.0f} s")
    if status.state == PlantState.TRIPPED:
        forgotten = f"; a restart would forget it: {status.unkept}" if status.unkept else ""
        yield Trouble("tripped", vehicle, role, f"{name} tripped: {status.cause}; `aeroloop op arm` arms it{forgotten}")
    if status.unkept:
        yield Trouble("not kept", vehicle, role, f"{name} would forget a stop at a restart: {status.unkept}")
    if status.state == ControllerState.FAULTED:
        why = f": {status.cause}" if status.cause else ""
        yield Trouble("faulted", vehicle, role, f"{name} faulted{why}; `aeroloop op arm` lets it claim again")
    if status.state == NOT_RECORDING:
        yield Trouble("not recording", vehicle, role, f"{name} records nothing: {status.cause}")
    if status.lost:
        yield Trouble("lossy", vehicle, role, f"{name} lost {status.lost} messages: its log lacks them")
    period = status.timing.recent_period if status.timing else None
    if period is None:
        return
    if status.recent_skipped > LATE_SHARE * period.count:
        yield Trouble("late", vehicle, role, f"{name} is late: {status.recent_skipped} ticks skipped in the last 10 s")
    if status.recent_latency_us and status.recent_latency_us.p99 > period.p50:
        took, due = status.recent_latency_us.p99, period.p50
        text = f"{name} is late: commands take {took:.0f} µs at the 99th percentile, and a period is {due:.0f} µs"
        yield Trouble("late", vehicle, role, text)
