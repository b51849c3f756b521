"""A log never invents: figures begin where gains, reference and law's state are known, and are the truth from there."""

from __future__ import annotations

import csv
import random
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from aeroloop.protocol.messages.models import SessionRecord
from aeroloop.protocol.messages.operator import Change, Gains, Hold, Stream, in_force
from aeroloop.protocol.messages.trace import RECORD_S, Tail, TraceWriter, read_batch, record_json
from aeroloop.service.config import load
from aeroloop.service.figures import added, squares
from aeroloop.service.logs.export import export
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import read
from tests.support.made_log import SESSION, VEHICLE, Changes, Logged, lockstep, made, write

TICKS = 2400
LEVEL = Hold(attitude=(0.0, 0.0, 0.0))
AWAY = Hold(attitude=(0.0, 12.0, -40.0))
GOES_AWAY: Changes = {90: (Gains(C2=(0.2, 0.2, 0.2)), None), 200: (None, AWAY)}
COLUMNS = ["k", "attitude", "desired", "attitude_error", "rate_error", "unquantized", "gains", "state", "voltages"]


def ends_of(message: Logged) -> tuple[str, int, int] | None:
    """End, first and last tick of a batch with rows; None of any other message."""
    batch = read_batch(message.payload) if "/trace/" in message.key else None
    if batch is None or not batch.header.rows:
        return None
    ticks = batch.columns["tick" if batch.header.end == "controller" else "session_tick"]
    return batch.header.end, int(ticks[0]), int(ticks[-1])


def without(messages: list[Logged], first: int, last: int, end: str | None = None) -> list[Logged]:
    """The messages without the batches, of one end or both, that begin within these ticks; and without other topics."""
    kept = []
    for message in messages:
        found = ends_of(message)
        if found is None or not (first <= found[1] <= last and end in (None, found[0])):
            kept.append(message)
    return kept


@pytest.fixture(scope="module", params=["periodic", "on_change"])
def whole(request: pytest.FixtureRequest) -> tuple[list[Logged], str]:
    settings = load(overrides=["loop.lockstep=true", f'wire.transmit="{request.param}"'])
    return made(settings, TICKS, GOES_AWAY), request.param


def written(path: Path, messages: list[Logged], transmit: str = "periodic") -> Path:
    return write(path, load(overrides=["loop.lockstep=true", f'wire.transmit="{transmit}"']), messages)


def test_a_log_that_begins_late_agrees_with_the_whole_one(whole: tuple[list[Logged], str], tmp_path: Path) -> None:
    """The operator had moved the body before the recorder came: what is configured is not what was followed."""
    messages, transmit = whole
    truth = read(written(tmp_path / "whole.mcap", messages, transmit)).ticks
    late = written(tmp_path / "late.mcap", without(messages, 0, 800), transmit)
    known = read(late).ticks
    first = int(known.k[0])
    assert 800 < first < 860
    since = truth.where(truth.k >= first)
    for name in COLUMNS:
        assert (getattr(known, name) == getattr(since, name)).all(), name
    assert read(late).figures.z_track == added(0.0, squares(since.attitude_error) * lockstep().loop.period)
    both = replay([late])
    assert both.controller is not None
    assert (both.controller.ticks, both.controller.differ) == (TICKS - first, 0)
    assert both.unknown == read(late).findings.unknown == []
    exported = export([late], "csv", tmp_path / "late.csv")
    assert (exported.rows, exported.unknown) == (len(since.k), [])
    with (tmp_path / "late.csv").open(newline="") as file:
        row = next(csv.DictReader(file))
    assert int(row["tick"]) == first
    assert float(row["desired_pitch_deg"]) == pytest.approx(12.0)


def test_what_was_in_force_before_the_first_change_that_a_late_log_has_is_unknown(tmp_path: Path) -> None:
    """The first record is of after the change, and no reader knows what was followed before it."""
    messages = made(lockstep(), TICKS, GOES_AWAY | {1000: (Gains(C2=(0.1, 0.1, 0.1)), LEVEL)})
    truth = read(written(tmp_path / "whole.mcap", messages)).ticks
    late = written(tmp_path / "late.mcap", without(messages, 0, 899))
    (unknown,) = read(late).findings.unknown
    known = read(late).ticks
    assert (unknown.vehicle, unknown.session, unknown.last_tick) == (VEHICLE, SESSION, known.k[0] - 1)
    assert unknown.first_tick >= 900
    assert 1000 <= known.k[0] < 1060
    for name in COLUMNS:
        assert (getattr(known, name) == getattr(truth.where(truth.k >= known.k[0]), name)).all(), name
    replayed = replay([late])
    assert replayed.unknown == export([late], "csv", tmp_path / "late.csv").unknown == [unknown]
    assert replayed.controller is not None
    assert (replayed.controller.ticks, replayed.controller.differ) == (len(known.k), 0)
    assert f"ticks {unknown.first_tick} to {unknown.last_tick} of s1 are left out" in str(unknown)


@pytest.mark.parametrize("seed", range(4))
def test_whatever_batches_are_lost_no_tick_is_computed_otherwise(
    whole: tuple[list[Logged], str], tmp_path: Path, seed: int
) -> None:
    """Every recorded tick is computed as of the whole log, or named: as unknown, or among rows that are missing."""
    (messages, transmit), rng = whole, random.Random(seed)
    truth = read(written(tmp_path / "whole.mcap", messages, transmit)).ticks
    for first in (rng.randrange(0, TICKS, 50) for _ in range(3)):
        messages = without(messages, first, first + rng.randrange(40, 500), rng.choice(["controller", "plant", None]))
    log = written(tmp_path / "a.mcap", messages, transmit)
    known, findings = read(log).ticks, read(log).findings
    its = truth.where(np.isin(truth.k, known.k))
    assert (known.k == its.k).all()
    assert (known.desired == its.desired).all()
    for name in COLUMNS:
        found = getattr(known, name)
        same = (found == getattr(its, name)) | np.isnan(found)
        assert same.all(), (name, known.k[~same.all(axis=1)])
    batches = [found for message in messages if (found := ends_of(message)) is not None]
    recorded = {k for _, first, last in batches for k in range(first, last + 1)}
    spans = [(one.first_tick, one.last_tick) for one in findings.unknown]
    spans += [(one.first_tick, one.last_tick) for one in findings.missing if one.last_tick is not None]
    named = {k for first, last in spans for k in range(first, last + 1)}
    answered = range(int(known.k[-1]) + 1)
    assert recorded & set(answered) <= set(known.k.tolist()) | named
    assert not replay([log]).differs


def test_without_a_record_and_a_beginning_nothing_is_known(tmp_path: Path) -> None:
    """The beginning of a log shorter than a record's period is missing, or all of the controller's trace."""
    short, long = without(made(lockstep(), 480), 0, 100), made(lockstep(), TICKS, GOES_AWAY)
    assert all(b'"record"' not in one.payload for one in short)
    plants = [one for one in long if not one.key.endswith("trace/controller")]
    for name, messages in (("short", short), ("plants", plants)):
        log = written(tmp_path / f"{name}.mcap", messages)
        findings = read(log).findings
        assert findings.z_track is None
        assert replay([log]).unknown == findings.unknown != []


def test_ticks_before_the_first_that_the_controller_received_are_judged_by_no_reference(tmp_path: Path) -> None:
    """A session follows nothing until its first measurement is received, and holds what it finds then."""
    messages = made(load(), TICKS, {5: (None, AWAY)}, lost=set(range(5)))
    found = read(write(tmp_path / "a.mcap", load(), messages))
    assert found.ticks.k.tolist() == list(range(5, TICKS))
    assert [(one.first_tick, one.last_tick) for one in found.findings.unknown] == [(0, 4)]


def test_a_second_session_has_its_own_gains_and_reference(tmp_path: Path) -> None:
    """The record of one session says nothing about another."""
    changes: Changes = {300: (Gains(C2=(0.1, 0.1, 0.1)), LEVEL), 1100: (Gains(C2=(0.3, 0.3, 0.3)), None)}
    second = made(lockstep(), TICKS, changes, session="s2", at_ns=3_600_000_000_000)
    log = written(tmp_path / "a.mcap", [*made(lockstep(), 700, GOES_AWAY), *without(second, 0, 1000)])
    later = read(log, session="s2").findings
    assert later.final_error_deg is not None
    assert later.final_error_deg < 2
    both = replay([log])
    assert both.unknown == []
    assert [(one.session, one.differ) for one in both.sessions] == [("s1", 0), ("s2", 0)]


def test_a_batch_has_the_record_once_a_second_and_a_long_one_less_often() -> None:
    wire = load().wire
    for points, least_s in ((1, RECORD_S), (600, 2.0)):
        writer = TraceWriter("plant", wire, 1)
        writer.session = "s"
        change = Change(session="s", tick=7, gains=Gains(C1=tuple([0.3] * 3)), reference=AWAY)
        writer.record = record_json([change] * points)
        batches = [read_batch(writer.take(n * 10**8, 0)) for n in range(1, 200)]
        with_it = [i for i, batch in enumerate(batches) if batch is not None and batch.tail.record]
        assert with_it[0] == 0
        gaps = {b - a for a, b in pairwise(with_it)}
        assert min(gaps) >= least_s * 10
        assert (points > 1) or gaps == {10}


def test_a_sessions_record_says_what_is_in_force_as_its_changes_do() -> None:
    changes = [
        Change(session="s", tick=0, gains=Gains(C1=(0.3,) * 3, C2=(0.1,) * 3), reference=LEVEL),
        Change(session="s", tick=40, reference=AWAY, within_s=1.0, here=((0.1, 0.2, 0.3),) * 3),
        Change(session="s", tick=90, gains=Gains(C2=(0.2,) * 3)),
    ]
    record = SessionRecord(
        controller="c", session="s", gains=Gains(C1=(0.3,) * 3, C2=(0.2,) * 3), gains_from="operator", reference=AWAY,
        reference_from="operator", within_s=1.0, since_tick=40, gains_since_tick=90, here=((0.1, 0.2, 0.3),) * 3,
    )  # fmt: skip
    assert record.in_force == in_force(changes)
    assert Tail.model_validate_json(b'{"record":' + record_json(record.in_force) + b"}").record == in_force(changes)
    assert record.model_copy(update={"reference": Stream()}).in_force == []
