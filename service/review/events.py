"""Events of a session: published events, changes, recorder losses, faults of the plant, and what statuses say.

An event is shown at its sender's time, wherever it stands in the file: with a session tick at that tick, any other by
its time of publication, which the sender's own trace relates to ticks; for one without a trace the plant's does.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from math import inf, isfinite
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Event, Loss, Status
from aeroloop.protocol.messages.operator import Change, in_words
from aeroloop.service.logs.recording import Recording
from aeroloop.service.logs.session import Array, Integers, Session, SessionKey, TrueStates
from aeroloop.service.review.report import FaultInterval, Mark

MAX_MARKS: Final = 300  # marks of a kind and role; one more stands for the rest

_MODELS: Final[dict[str, type[Event | Loss | Status]]] = {"event": Event, "loss": Loss, "status": Status}


class Truths(NamedTuple):
    """True states by tick, ascending, none twice, with the plant's further signals. Shapes (n,), (n, 4), (n, 3)."""

    k: Integers
    attitude: Array
    rate: Array
    signals: Mapping[str, Array] = {}


class Messages(NamedTuple):
    """Messages beside the traces, one session's true states, and how many are malformed by topic, of any vehicle.

    Each message of the vehicle has its time on the wall clock of the role that published it [ns]; in order of time.
    """

    published: list[tuple[int, str, Event | Loss | Status]]
    truths: Truths
    malformed: Counter[str]

    def statuses(self, role: str) -> list[Status]:
        """Statuses of a role, in order of time."""
        return [one for _, whose, one in self.published if whose == role and isinstance(one, Status)]


def read_messages(recording: Recording, which: SessionKey, actuators: int) -> Messages:
    """Read the messages of a session and its vehicle; one that a restarted recorder recorded again counts once."""
    malformed, known = Counter[str](), set[int]()
    published = list[tuple[int, str, Event | Loss | Status]]()
    states = TrueStates({which[1]: actuators})

    for address, found in recording.messages:
        at_ns = found.publish_time
        name = address.topic.name
        try:
            if name == "truth":
                if address.vehicle == which[0]:
                    states.add(found.data)
            elif (identity := hash((address.vehicle, found.data, at_ns))) not in known:
                known.add(identity)
                message = _MODELS[name].model_validate_json(found.data)
                age = message.age_us if isinstance(message, Status) else None
                if age is not None and not isfinite(age.p50 + age.p99 + age.max):
                    raise ValueError
                if address.vehicle == which[0]:
                    published.append((at_ns, address.role or "recorder", message))
        except ValueError:  # untrusted publishers may send anything, such as 1e999
            malformed[name] += 1
    rows = states.rows(which[1])
    truths = Truths(rows[:, 0].astype(np.int64), rows[:, 1:5], rows[:, 5:8], states.signals(which[1]))
    return Messages(sorted(published, key=itemgetter(0)), truths, malformed)


def happened(
    messages: Messages, session: Session, span: tuple[int, int], alone: bool
) -> tuple[list[Mark], list[str], dict[str, int]]:
    """Marks in order of time, reasons of the vehicle's trips, and messages that the recorder lost, by topic.

    If `alone`, without the trips of other sessions. Marks outside of the `span`, the first and last tick, have no time.
    """
    found: defaultdict[tuple[str, str], list[tuple[float, float, str]]] = defaultdict(list)  # tick, tick shown, text
    trips, losses = list[str](), Counter[str]()
    (first, last), latest = span, max(session.extent.last.values())
    tick_at, period = _clocks(session), session.settings.loop.period
    for at_ns, role, message in messages.published:
        tick = shown = tick_at(role, at_ns)
        if isinstance(message, Event):
            of_session = message.session == session.which[1]
            if message.kind == "changed" and role == "controller" and of_session:
                continue  # the change itself is in the trace, with its tick
            if message.kind == "tripped" and role == "plant" and (of_session or not alone):
                trips.append(message.text)
            if of_session and message.tick is None:  # belongs to it, though published just before or after
                shown = min(max(tick, first), last)
            elif of_session and message.tick is not None and 0 <= message.tick <= latest + 1:
                tick = shown = message.tick
            found[role, message.kind].append((tick, shown, message.text))
        elif isinstance(message, Loss):
            lost = topics.read_key(message.key)
            name = lost.topic.name if lost else message.key
            losses[name] += message.count
            text = f"{message.count} of {name} lost: {LOSS_REASONS[message.reason]}"
            found["recorder", "lost"].append((tick, shown, text))
    found["controller", "change"] += [(one.tick, one.tick, described(one)) for one in session.changes]
    marks = list[tuple[tuple[int, float], Mark]]()
    for (role, kind), placed in found.items():
        kept, rest = placed[:MAX_MARKS], placed[MAX_MARKS:]
        if rest:
            tick, shown, text = rest[-1]
            kept.append((tick, shown, f"{len(rest)} more, the last: {text}"))
        for tick, shown, text in kept:
            outside = -1 if shown < first else 1 if shown > last + 1 else 0
            time_s = None if outside else round(shown * period, 9)
            marks.append(((outside, tick), Mark(time_s=time_s, kind=kind, role=role, text=text)))
    return [mark for _, mark in sorted(marks, key=itemgetter(0))], trips, dict(losses)


def age_us(messages: Messages, which: SessionKey) -> dict[str, float] | None:
    """Age of measurements when used: median of all medians, largest p99 and maximum [µs]; None without."""
    ages = [one.age_us for one in messages.statuses("controller") if one.session == which[1] and one.age_us]
    if not ages:
        return None
    median = round(float(np.median([age.p50 for age in ages])), 1)
    return {"p50": median, "p99": max(age.p99 for age in ages), "max": max(age.max for age in ages)}


def fault_intervals(messages: Messages, session: Session) -> list[FaultInterval]:
    """Faults of an emulated plant that acted in a session, in order of time.

    Its status has their begin and end in ticks of the plant, and the trace the plant's tick of each of the session's:
    intervals are known to the tick, whatever event was lost.
    """
    statuses = messages.statuses("plant")
    own = [i for i, status in enumerate(statuses) if status.session == session.which[1]]
    if not own or not len(session.plant):
        return []
    last = statuses[own[-1]]
    # The first status after the session has its final counts, if it is of the same process; likewise the one before.
    last = next((status for status in statuses[own[-1] + 1 :] if status.uptime_s >= last.uptime_s), last)
    before = [status for status in statuses[: own[0]][-1:] if status.uptime_s <= last.uptime_s]
    changed = {(one.fault, one.source, one.begin_tick): one.changed for status in before for one in status.faults}
    first = int(session.plant["tick"][0]) - int(session.plant["session_tick"][0])
    ticks, period, found = int(session.k[-1]) + 1, session.settings.loop.period, list[FaultInterval]()
    for one in last.faults:
        if one.begin_tick is None:
            continue
        begin, end = max(0, one.begin_tick - first), inf if one.end_tick is None else one.end_tick - first
        if begin < min(ticks, end):
            found.append(FaultInterval(
                fault=one.fault, source=one.source, effect=one.effect, begin_s=round(begin * period, 9),
                end_s=None if end >= ticks else round(end * period, 9),
                changed=one.changed - changed.get((one.fault, one.source, one.begin_tick), 0),
            ))  # fmt: skip
    return sorted(found, key=lambda interval: interval.begin_s)


def described(change: Change) -> str:
    """A change in words."""
    gains = change.gains.named if change.gains is not None else {}
    parts = [", ".join(f"{name} = [{', '.join(f'{x:g}' for x in xs)}]" for name, xs in gains.items())] * bool(gains)
    if change.reference is not None:
        within = f" within {change.within_s:g} s" if change.within_s else ""
        parts.append(f"follows {in_words(change.reference)}{within}")
    return "; ".join(parts)


def _clocks(session: Session) -> Callable[[str, int], float]:
    """The session's tick at a time on a role's wall clock, by its rows; negative before it, ∞ without any row."""
    known = dict[str, tuple[int, Array, Array]]()
    ends = ("controller", session.controller, session.at_controller), ("plant", session.plant, session.at_plant)
    for end, rows, at in ends:
        time = np.maximum(rows["received"], rows["sent"])
        its, ticks = at[at >= 0], session.k[at >= 0]
        its, ticks = its[time[its] >= 0], ticks[time[its] >= 0]
        if len(its):
            walls = (time + rows["wall"])[its]
            order, first = np.argsort(walls, kind="stable"), int(walls.min())
            known[end] = first, (walls[order] - first).astype(np.float64), ticks[order].astype(np.float64)

    def tick(role: str, at_ns: int) -> float:
        clock = known.get(role) or known.get("plant") or known.get("controller")
        if clock is None:
            return inf
        first, walls, ticks = clock
        within = min(max(at_ns - first, 0), int(walls[-1]))
        return float(np.interp(within, walls, ticks)) + (at_ns - first - within) / (session.settings.loop.period * 1e9)

    return tick
