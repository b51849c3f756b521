"""Observations of a session beside its figures of merit: timing, gaps, saturation, and frames that went otherwise."""

from __future__ import annotations

from math import inf
from typing import Final

import numpy as np

from aeroloop.protocol.messages.trace import Outcome, Received
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.logs.session import Array, Integers, Session
from aeroloop.service.logs.ticks import Codes, Ticks
from aeroloop.service.review.report import Gap, Spread

LONGEST_GAPS: Final = 100
_BIN_EDGES_US: Final = 2 ** (np.arange(32 * 16 + 1) / 16)
"""16 bins an octave, from 1 µs to 2³² µs, as of protocol/runtime/timing.py."""


def timing(ticks: Ticks) -> dict[str, Spread]:
    """Distributions of durations by name, without those that no tick has."""
    durations = {
        "period": periods_ns(ticks),
        "latency": ticks.latency_ns,
        "measurement_delay": ticks.measurement_delay_ns,
        "command_delay": ticks.command_delay_ns,
    }
    known = {name: values[~np.isnan(values)] for name, values in durations.items()}
    return {name: spread(values) for name, values in known.items() if len(values)}


def spread(nanoseconds: Array) -> Spread:
    """Distribution of at least one duration [ns]; under 1 µs counts as 1 µs. Shape (n,)."""
    us = np.clip(nanoseconds * 1e-3, *_BIN_EDGES_US[[0, -1]])
    counts, _ = np.histogram(us, _BIN_EDGES_US)
    p50, p90, p99, p999, most = np.percentile(us, [50, 90, 99, 99.9, 100]).round(1).tolist()
    bins = [(round(float(_BIN_EDGES_US[i]), 3), int(counts[i])) for i in np.flatnonzero(counts)]
    return Spread(count=len(us), p50=p50, p90=p90, p99=p99, p999=p999, max=most, bins=bins)


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

    The codes are those of measurement frames, shape (n, 6), and of command frames, shape (m, actuators).
    """
    shares: dict[str, float] = {}
    invalid = {"measurement": np.zeros(len(measurements), np.bool_), "command": np.zeros(len(commands), np.bool_)}
    for name, frame, codes in (
        ("attitude", "measurement", measurements[:, :3]),
        ("rate", "measurement", measurements[:, 3:]),
        ("voltage", "command", commands),
    ):
        quantizer = getattr(wire, name).quantizer()
        wrong = np.isnan(codes) | (codes == quantizer.invalid)
        if valid := int((~wrong).sum()):
            outermost = (np.abs(codes) >= quantizer.encode(quantizer.limit)) & ~wrong
            shares[name] = int(outermost.sum()) / valid
        invalid[frame] |= wrong.any(axis=1)
    return shares, {frame: int(where.sum()) for frame, where in invalid.items()}


def lapses(session: Session, missed: Integers) -> dict[str, int]:
    """Deviations from one frame each way per tick, by kind; see `Findings.lapses`.

    `missed` are ticks that the plant measured and the controller did not compute; those whose rows of the controller
    the log lacks do not count.
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
