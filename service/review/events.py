"""What happened in a session: events, changes, losses, faults of the plant, timing, gaps, and frames gone otherwise.

An event is shown at its sender's time, wherever it stands in the file: with a session tick at that tick, any other by
its time of publication, which the sender's own trace relates to ticks; for one without a trace the plant's does.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable
from math import inf
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Event, Loss, Status
from aeroloop.protocol.messages.operator import Change, in_words
from aeroloop.protocol.messages.trace import Outcome, Received
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.logs.recording import Recording
from aeroloop.service.logs.session import Array, Integers, Session, SessionKey, Truths
from aeroloop.service.logs.ticks import Codes, Flags, Ticks
from aeroloop.service.review.report import FaultInterval, Gap, Mark, Spread

LONGEST_GAPS: Final = 100
MAX_MARKS: Final = 300  # marks of a kind and role; one more stands for the rest

_MODELS: Final[dict[str, type[Event | Loss | Status]]] = {"event": Event, "loss": Loss, "status": Status}


class Messages(NamedTuple):
    """Messages beside the traces, and one session's true states.

    Each message of the vehicle has its time on the wall clock of the role that published it [ns]; in order of time.
    """

    published: list[tuple[int, str, Event | Loss | Status]]
    truths: Truths

    def statuses(self, role: str) -> list[Status]:
        """Statuses of a role, in order of time."""
        return [one for _, whose, one in self.published if whose == role and isinstance(one, Status)]


def read_messages(recording: Recording, which: SessionKey, actuators: int) -> Messages:
    """Read the messages of a session and its vehicle; one that a restarted recorder recorded again counts once.

    Malformed ones are counted by the recording, of whatever vehicle they are.
    """
    published, known = list[tuple[int, str, Event | Loss | Status]](), set[int]()
    for address, found in recording.messages:
        at_ns, name = found.publish_time, address.topic.name
        if name == "truth" or (identity := hash((address.vehicle, found.data, at_ns))) in known:
            continue
        known.add(identity)
        try:
            message = _MODELS[name].model_validate_json(found.data)
            if address.vehicle == which[0]:
                published.append((at_ns, address.role or "recorder", message))
        except ValueError:  # untrusted publishers may send anything, such as 1e999
            recording.malformed[name] += 1
    return Messages(sorted(published, key=itemgetter(0)), recording.true_states(which, actuators))


def happened(
    messages: Messages, session: Session, span: tuple[int, int], alone: bool
) -> tuple[list[Mark], list[str], dict[str, int]]:
    """Marks in order of time, reasons of the vehicle's trips, and messages that the recorder lost, by topic.

    If `alone`, without the trips of other sessions. Marks outside of the `span`, the first and last tick, have no time.
    """
    found: defaultdict[tuple[str, str], list[tuple[float, float, str]]] = defaultdict(list)  # tick, tick shown, text
    trips, losses, asked = list[str](), Counter[str](), dict[int, str]()  # who asked, by the tick of the change
    (first, last), latest = span, max(session.extent.last.values())
    tick_at, period = _clocks(session), session.settings.loop.period
    for at_ns, role, message in messages.published:
        tick = shown = tick_at(role, at_ns)
        if isinstance(message, Event):
            of_session = message.session == session.which[1]
            if message.kind == "changed" and role == "controller" and of_session:
                if message.tick is not None and (by := re.search(r" \(by .*\)$", message.text)):
                    asked[message.tick] = by.group()
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
    changes = ((one.tick, described(one) + asked.get(one.tick, "")) for one in session.changes)
    found["controller", "change"] += [(tick, tick, text) for tick, text in changes]
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


# ── timing, gaps, saturation, and frames that went otherwise ──


def timing(ticks: Ticks) -> dict[str, Spread]:
    """Distributions of durations by name, without those that no tick has."""
    durations = {
        "period": periods_ns(ticks), "latency": ticks.latency_ns, "measurement_delay": ticks.measurement_delay_ns,
        "command_delay": ticks.command_delay_ns,
    }  # fmt: skip
    known = {name: values[~np.isnan(values)] for name, values in durations.items()}
    return {name: spread(values) for name, values in known.items() if len(values)}


def spread(nanoseconds: Array) -> Spread:
    """Distribution of at least one duration [ns]; under 1 µs counts as 1 µs. Shape (n,)."""
    us = np.maximum(nanoseconds * 1e-3, 1.0)
    p50, p90, p99, p999, most = np.percentile(us, [50, 90, 99, 99.9, 100]).round(1).tolist()
    return Spread(count=len(us), p50=p50, p90=p90, p99=p99, p999=p999, max=most)


def periods_ns(ticks: Ticks) -> Array:
    """Time since the measurement sent before each; NaN of the first, and of those that were not sent. Shape (n,)."""
    periods, sent = np.full(len(ticks.k), np.nan), np.flatnonzero(ticks.sent_ns >= 0)
    periods[sent[1:]] = np.diff(ticks.sent_ns[sent])
    return periods


def gaps(answered: Integers, period: float) -> tuple[int, list[Gap]]:
    """How many times ticks in a row were not answered, and the longest hundred, in order. Shape (n,)."""
    missing = np.diff(answered) - 1
    at = np.flatnonzero(missing)
    longest = np.sort(at[np.argsort(missing[at], kind="stable")][-LONGEST_GAPS:])
    found = [(int(answered[i]) + 1, int(missing[i])) for i in longest]
    return len(at), [Gap(time_s=round(k * period, 9), tick=k, ticks=ticks) for k, ticks in found]


def saturation(wire: WireSpec, measurements: Codes, commands: Codes) -> tuple[dict[str, float], dict[str, int]]:
    """Share of each signal's values at its outermost level, and how many frames have a component without a valid value.

    Shapes of the codes: (n, 6) and (m, actuators).
    """
    shares, invalid = dict[str, float](), dict[str, Flags]()
    signals = {"attitude": measurements[:, :3], "rate": measurements[:, 3:], "voltage": commands}
    for name, codes in signals.items():
        quantizer = getattr(wire, name).quantizer()
        invalid[name] = wrong = np.isnan(codes) | (codes == quantizer.invalid)
        if valid := int((~wrong).sum()):
            outermost = (np.abs(codes) >= quantizer.encode(quantizer.limit)) & ~wrong
            shares[name] = int(outermost.sum()) / valid
    measured = np.hstack([invalid["attitude"], invalid["rate"]]).any(axis=1)
    return shares, {"measurement": int(measured.sum()), "command": int(invalid["voltage"].any(axis=1).sum())}


def lapses(session: Session, missed: Integers) -> dict[str, int]:
    """Deviations from one frame each way per tick, by kind; see `Findings.lapses`.

    Of the ticks that were `missed`, those whose rows of the controller the log lacks do not count.
    """
    for gap in session.missing:
        if gap.end == "controller" and gap.rows:
            missed = missed[(missed < gap.first_tick) | (missed > (inf if gap.last_tick is None else gap.last_tick))]
    first, last = session.k[[0, -1]] if len(session.k) else (0, -1)
    ticks = np.maximum.accumulate(session.controller["tick"])  # a late row is of a lower one
    received_as = session.controller["received_as"][(ticks >= first) & (ticks <= last)]
    outcome = session.plant["outcome"][session.at_plant[session.at_plant >= 0]]
    counts = {
        "late": int((received_as == Received.LATE).sum()),
        "malformed": int((received_as == Received.MALFORMED).sum()),
        "stale": int((outcome == Outcome.STALE).sum()),
        "repeated": int((outcome == Outcome.REPEATED).sum()),
        "refused": int(np.isin(outcome, [Outcome.MALFORMED, Outcome.INVALID]).sum()),
        "withheld": int((outcome == Outcome.WITHHELD).sum()),
        "missed": len(missed),
    }
    return {name: count for name, count in counts.items() if count}


def of_nearer_sign(q: Array, other: Array) -> Array:
    """Of ±q, which are the same attitude, the one nearer to another. Shapes (n, 4)."""
    return np.asarray(np.where((q * other).sum(axis=1, keepdims=True) < 0, -q, q))


def error_deg(error: Array) -> Array:
    """Angle of an attitude error ε̃ [deg]. Shapes (n, 3) and (n,)."""
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(1.0, np.linalg.norm(error, axis=1)))))
