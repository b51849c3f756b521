"""Sessions read from both traces: joined on the tick after any fault, replayed, true from their first known tick."""

from __future__ import annotations

import random
from collections.abc import Collection
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from aeroloop.protocol.messages.models import SessionRecord
from aeroloop.protocol.messages.operator import Change, Gains, Hold, Points, Stream, in_force
from aeroloop.protocol.messages.trace import (
    RECORD_S,
    ControllerRow,
    End,
    Outcome,
    PlantRow,
    Received,
    Sent,
    TraceWriter,
    read_batch,
    record_json,
)
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import Settings, load
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.logs.export import export
from aeroloop.service.logs.recording import ReviewError
from aeroloop.service.logs.replay import replay
from aeroloop.service.logs.session import Missing, TraceIndex
from aeroloop.service.review.review import read, review
from tests.support.edited_log import contents, edited, rewrite, write_messages
from tests.support.made_log import (
    AN_OPERATORS_WORDS,
    SESSION,
    VEHICLE,
    Changes,
    Logged,
    Rough,
    lockstep,
    made,
    make_log,
    rough_loop,
    write,
)

TICKS = 2400
LEVEL = Hold(attitude=(0.0, 0.0, 0.0))
AWAY = Hold(attitude=(0.0, 12.0, -40.0))
GOES_AWAY: Changes = {90: (Gains(C2=(0.2, 0.2, 0.2)), None), 200: (None, AWAY)}
COLUMNS = ["k", "attitude", "desired", "attitude_error", "rate_error", "unquantized", "gains", "state", "voltages"]


def end_of(message: Logged) -> str:
    """Which end's batch a message is; empty if it is none."""
    return message.key.rpartition("/")[2] if "/trace/" in message.key else ""


def rows_of(message: Logged) -> int:
    batch = read_batch(message.payload)
    return 0 if batch is None else batch.header.rows


def written(path: Path, known: Rough, messages: list[Logged] | None = None) -> Path:
    return write(path, known.settings, known.messages if messages is None else messages)


@pytest.mark.parametrize("seed", range(4))
def test_what_was_joined_is_what_happened_and_both_ends_replay_byte_for_byte(seed: int, tmp_path: Path) -> None:
    known = rough_loop(seed)
    path = written(tmp_path / "a.mcap", known)
    replayed = replay([path])
    assert replayed.controller is not None
    assert replayed.plant is not None
    assert (replayed.controller.ticks, replayed.controller.differ) == (len(known.commands), 0)
    assert replayed.plant.differ == 0
    assert replayed.plant.ticks >= len(known.measured)
    assert replayed.reasons == {}
    assert replayed.complete
    findings, ticks = read(path).findings, read(path).ticks
    assert findings.missing == []
    answered = sorted({*(k for k, command in known.commands.items() if command is not None), *known.acted})
    assert ticks.k.tolist() == [k for k in sorted({*known.measured, *known.commands}) if k <= answered[-1]]
    assert findings.skipped_ticks == ticks.k[-1] - ticks.k[0] + 1 - len(answered)
    missed = [k for k in known.measured if k not in known.commands and k <= answered[-1]]
    counted = {
        name: known.outcomes.count(outcome)
        for name, outcome in (("repeated", Outcome.REPEATED), ("withheld", Outcome.WITHHELD))
    }
    expected = {"late": known.late, "missed": len(missed), **counted}
    assert {name: findings.lapses.get(name, 0) for name in expected} == expected
    for k, latency in zip(ticks.k.tolist(), ticks.latency_ns.tolist(), strict=True):
        if k in known.acted and known.measured.get(k):
            assert latency == pytest.approx(known.acted[k] - known.sent[k], abs=2000)  # rows have whole microseconds
        else:
            assert np.isnan(latency)


@pytest.mark.parametrize("seed", range(2))
def test_one_way_delays_and_the_offset_are_found_on_clocks_that_differ_and_drift(seed: int, tmp_path: Path) -> None:
    """Both ways take 150 µs on average and may queue: the median of either is that, within what is not symmetrical."""
    findings = read(written(tmp_path / "a.mcap", rough_loop(seed, 3000, 'wire.transmit="periodic"'))).findings
    for name in ("measurement_delay", "command_delay"):
        assert findings.timing[name].p50 == pytest.approx(150, abs=30)
    assert findings.clock_offset_us is not None
    assert findings.clock_offset_us[0] == pytest.approx(82_800e6, abs=50)


@pytest.mark.parametrize("seed", range(3))
def test_missing_batches_are_named_and_the_controller_still_replays(seed: int, tmp_path: Path) -> None:
    """Each batch has the controller's state before it, so a gap ends with it. A plant is only known from its start."""
    known, chance = rough_loop(seed, 2000, 'wire.transmit="periodic"'), random.Random(seed)
    messages, gone = list(known.messages), dict[str, list[Logged]]()
    for end in ("controller", "plant"):
        batches = [m for m in messages if end_of(m) == end and rows_of(m) and b'"changes"' not in m.payload]
        at = chance.randrange(1, len(batches) - 3)
        gone[end] = batches[at : at + 2]
    path = written(tmp_path / "a.mcap", known, [m for m in messages if m not in gone["controller"] + gone["plant"]])
    findings, replayed = read(path).findings, replay([path])
    assert findings.missing_ticks == {end: sum(map(rows_of, lost)) for end, lost in gone.items()}
    assert {gap.end for gap in findings.missing} == {"controller", "plant"}
    assert replayed.controller is not None
    assert replayed.controller.differ == 0
    computed, left_out = replayed.controller.ticks, RECORD_S / known.settings.loop.period
    assert len(known.commands) - findings.missing_ticks["controller"] - left_out < computed < len(known.commands)
    assert f"{findings.missing_ticks['plant']} rows are missing" in replayed.reasons["plant"]


@pytest.mark.parametrize("lacking", [0, 1, 2])
def test_the_last_rows_that_the_other_end_proves_are_missing_to_the_row(lacking: int) -> None:
    """The controller has received the measurements of so many ticks more than the plant's trace has."""
    wire, index, session = WireSpec(), TraceIndex(), "s1"
    frames = bytes(wire.measurement.size), bytes(wire.command.size)
    controller, plant = (TraceWriter(end, wire, 7) for end in ("controller", "plant"))
    controller.session = plant.session = session
    for k in range(25):
        controller.row(ControllerRow(k, Received.FRAME, Sent.FRAME, 10**10 + k, 10**10 + k, *frames))
        if k < 25 - lacking:
            volts = (0.0,) * wire.actuators
            plant.row(PlantRow(k, k, Sent.FRAME, Sent.NONE, Outcome.NONE, 0, -1, 10**10 + k, 0, *frames, volts))
    index.add(VEHICLE, controller.take(10**10, 1, final=True), 1)
    index.add(VEHICLE, plant.take(10**10, 1, final=not lacking), 1)
    index.finish()
    proven = Missing(vehicle=VEHICLE, session=session, end="plant", first_tick=25 - lacking, last_tick=24, rows=lacking)
    assert index.missing == ([proven] if lacking else [])


@pytest.mark.parametrize(("end", "proven"), [("controller", 1), ("plant", 0)])
def test_what_a_killed_end_did_last_is_named_by_what_the_other_proves(end: End, proven: int, tmp_path: Path) -> None:
    """The plant has acted on all commands but the last."""
    settings = load()
    messages = made(settings, 600)
    last = [m for m in messages if end_of(m) == end][-3:]
    path = write(tmp_path / "a.mcap", settings, [m for m in messages if m not in last])
    (missing,) = read(path).findings.missing
    rows = sum(map(rows_of, last))
    assert missing == Missing(
        vehicle=VEHICLE, session=SESSION, end=end, first_tick=600 - rows, last_tick=599 - proven, rows=rows - proven
    )
    if end == "controller":
        assert review(path).skipped_ticks == 0  # they were answered: the plant acted on it


def test_one_end_alone_is_read_for_what_it_has(tmp_path: Path) -> None:
    settings = load()
    messages = made(settings, 500)
    write(tmp_path / "whole.mcap", settings, messages)
    write(tmp_path / "a.mcap", settings, [m for m in messages if end_of(m) != "plant"])
    whole, alone = read(tmp_path / "whole.mcap"), read(tmp_path / "a.mcap")
    assert (alone.figures.z_track, alone.figures.u_total) == (whole.figures.z_track, whole.figures.u_total)
    assert alone.findings.missing_ticks == {"controller": 0, "plant": 500}
    assert "latency" not in alone.findings.timing
    assert replay([tmp_path / "a.mcap"]).reasons == {"plant": "the log has no trace of a plant"}
    write(tmp_path / "b.mcap", settings, [m for m in messages if end_of(m) == "plant"])
    assert read(tmp_path / "b.mcap").findings.missing_ticks["controller"] == 499


def test_a_log_of_another_version_is_refused_with_what_to_do(tmp_path: Path) -> None:
    make_log(tmp_path / "a.mcap", 100)
    path = write_messages(tmp_path / "b.mcap", [], [other_description()])
    says = "is not a log of this version: it is of protocol version 1; read it with the aeroloop that wrote it"
    for reader in (review, lambda path: replay([path])):
        with pytest.raises(ReviewError, match=says) as refused:
            reader(path)
        assert str(refused.value) == f"{path} {says}"
    both = rewrite(tmp_path / "a.mcap", tmp_path / "c.mcap", metadata=[other_description()])
    assert review(both).z_track == review(tmp_path / "a.mcap").z_track
    assert "protocol version 1" in review(both).damages[0]


def test_a_log_from_before_points_named_their_interpolation_replays_as_it_was_followed(tmp_path: Path) -> None:
    """Points in the configuration and in an operator's change, of which the log has the times and attitudes alone."""
    attitudes = [(0.0, 0.0, 0.0), (0.0, 4.0, 6.0), (0.0, 4.0, 6.0)]
    points = Points(times=[0.0, 0.3, 5.0], attitudes=attitudes, interpolation="differences")
    settings = lockstep().model_copy(update={"reference": points})
    steeper = points.model_copy(update={"times": [0.0, 0.2, 3.0]})

    def older(interpolation: str) -> Path:
        """A log of a controller that joins points like that, without the key."""
        named = {"interpolation": interpolation}
        configured = settings.model_copy(update={"reference": points.model_copy(update=named)})
        changes: Changes = {300: (None, steeper.model_copy(update=named))}
        make_log(tmp_path / "new.mcap", 600, settings=configured, changes=changes)
        assert not replay([tmp_path / "new.mcap"]).differs
        key = f',"interpolation":"{interpolation}"'
        blank = " " * len(key)  # a batch's header has the length of its text
        messages, metadata = contents(tmp_path / "new.mcap")
        blanked = [said._replace(data=said.data.replace(key.encode(), blank.encode())) for said in messages]
        described = [
            (name, {"key": entries["key"], "json": entries["json"].replace(key, blank)})  # and no checksum
            for name, entries in metadata
            if name == "aeroloop.description"
        ]
        assert len(described) == 2
        old = write_messages(tmp_path / "old.mcap", blanked, described)
        assert not any(b"interpolation" in said.data for said in contents(old)[0])
        return old

    replayed = replay([older("differences")])
    assert replayed.controller is not None
    assert (replayed.controller.ticks, replayed.controller.differ) == (600, 0)
    assert replay([older("monotone")]).differs


def other_description() -> tuple[str, dict[str, str]]:
    text = '{"protocol": 1, "role": "plant", "vehicle": "aero", "host": "h", "versions": {}, "config": {}}'
    return "aeroloop.description", {"key": "aeroloop/aero/description/plant", "json": text}


def test_the_first_row_that_is_not_what_was_done_is_named_at_either_end(tmp_path: Path) -> None:
    """Of two sessions, the first is sound. The plant acted on what the controller sent, not on what it wrote down."""
    sound = made(lockstep(), 50, session="sound", at_ns=3_600_000_000_000)
    log = write(tmp_path / "a.mcap", lockstep(), [*sound, *made(lockstep(), 500)])

    def other_command(columns: dict[str, np.ndarray]) -> None:
        frames = columns["command"].view(np.uint8).reshape(len(columns["tick"]), -1)
        frames[columns["tick"] == 321, -1] ^= 0x10

    def weaker(columns: dict[str, np.ndarray]) -> None:
        columns["voltages"][columns["session_tick"] == 77] *= 0.5

    both = replay([rewrite(log, tmp_path / "b.mcap", edited("controller", other_command))])
    (session,) = (one for one in both.sessions if one.session == SESSION)
    assert {one.session: one.differ for one in both.sessions} == {"sound": 0, SESSION: 1}
    assert session.first_difference is not None
    assert session.first_difference.tick == 321
    assert session.first_difference.time_s == pytest.approx(0.642)
    assert both.plant is not None
    assert both.plant.differ == 0
    other = replay([rewrite(log, tmp_path / "c.mcap", edited("plant", weaker))])
    differences = [one.first_difference for one in other.plants if one.first_difference is not None]
    assert [(one.session_tick, one.field) for one in differences] == [(77, "voltages")]


def test_a_made_log_has_the_experiments_figures_and_with_another_law_what_would_have_been_commanded(
    tmp_path: Path,
) -> None:
    make_log(tmp_path / "a.mcap", 600)
    figures, expected = review(tmp_path / "a.mcap"), run_experiment(load(), 1.2)
    assert (figures.z_track, figures.u_total) == (expected.z_track, expected.u_total)
    both = replay([tmp_path / "a.mcap"], ["law.C2=[0.3, 0.3, 0.3]"])
    (session,) = both.sessions
    assert both.plant is None
    assert session.differ > 300
    assert session.first_difference is not None
    assert session.first_difference.signals == ["voltage_2 3.80952 and 7.61905 V, 5 steps apart"]


def missing_of(kept: Collection[int]) -> list[str]:
    """What is found missing where one process ran s1 (100 ticks), s2 (50) and s3 (100) and these batches were kept.

    Each batch has 25 rows: 0 to 3 are of s1, 4 and 5 of s2, 6 to 9 of s3.
    """
    wire = WireSpec()
    writer, index = TraceWriter("controller", wire, 7), TraceIndex()
    frames = bytes(wire.measurement.size), bytes(wire.command.size)
    batches = []
    for session, ticks in (("s1", 100), ("s2", 50), ("s3", 100)):
        writer.session = session
        for k in range(ticks):
            writer.row(ControllerRow(k, Received.SILENT, Sent.FRAME, 10**10 + k, 10**10 + k, *frames))
            if k % 25 == 24:
                batches.append(writer.take(10**10 + k, k, final=k == ticks - 1))
    for i in kept:
        assert index.add(VEHICLE, batches[i], i)
    index.finish()
    return [str(gap) for gap in index.missing if gap.end == "controller"]


@pytest.mark.parametrize(
    ("kept", "missing"),
    [
        ((0, 1, 2, 3, 8, 9), ["50 of the controller's ticks in sessions of which the log has nothing",
                              "50 of the controller's ticks in s3, ticks 0 to 49"]),
        ((0, 1, 8, 9), ["100 or more of the controller's ticks, from tick 50 of s1 on",
                        "50 of the controller's ticks in s3, ticks 0 to 49"]),
        ((0, 3, 4, 5, 6, 7, 8, 9), ["50 of the controller's ticks in s1, ticks 25 to 74"]),
    ],
)  # fmt: skip
def test_rows_of_one_session_are_never_counted_as_those_of_another(kept: tuple[int, ...], missing: list[str]) -> None:
    """A process numbers the rows of all its sessions; which of them a gap held is known only where both ends are."""
    assert missing_of(kept) == missing


def test_a_log_in_the_order_in_which_a_late_recorder_received_it_reads_as_one_in_order(tmp_path: Path) -> None:
    """Topic by topic, the newest page first, some twice: rows are sorted by number, all else by its sender's time."""
    made, late = tmp_path / "made.mcap", tmp_path / "late.mcap"
    make_log(made, 600, truth_every=2, changes=AN_OPERATORS_WORDS, injected={100: "rate:off", 120: None})
    messages, metadata = contents(made)
    by_key = {key: [one for one in messages if one.key == key] for key in sorted({one.key for one in messages})}
    pages = [said[max(0, end - 20) : end + 5] for said in by_key.values() for end in range(len(said), 0, -20)]
    write_messages(late, [one for page in pages for one in page], metadata)
    out = []
    for path in (made, late):
        export([path], "csv", path.with_suffix(".csv"))
        findings = read(path).findings.model_dump(exclude={"log", "marks", "started"})
        out.append((findings, replay([path]), path.with_suffix(".csv").read_bytes()))
    assert out[0] == out[1]
    assert out[0][0]["faults"]


# A log never invents: figures begin where gains, reference and state are known, and are the truth from there


def ends_of(message: Logged) -> tuple[str, int, int] | None:
    """End, first and last tick of a batch with rows; None of any other message."""
    batch = read_batch(message.payload) if "/trace/" in message.key else None
    if batch is None or not batch.header.rows:
        return None
    ticks = batch.columns["tick" if batch.header.end == "controller" else "session_tick"]
    return batch.header.end, int(ticks[0]), int(ticks[-1])


def without(messages: list[Logged], first: int, last: int, end: str | None = None) -> list[Logged]:
    """The messages without the batches, of one end or both, that begin within these ticks."""
    spans = [(message, ends_of(message)) for message in messages]
    return [one for one, span in spans if span is None or not (first <= span[1] <= last and end in (None, span[0]))]


@pytest.fixture(scope="module", params=["periodic", "on_change"])
def whole(request: pytest.FixtureRequest) -> tuple[list[Logged], Settings]:
    settings = load(overrides=["loop.lockstep=true", f'wire.transmit="{request.param}"'])
    return made(settings, TICKS, GOES_AWAY), settings


@pytest.mark.parametrize("seed", range(4))
def test_whatever_batches_are_lost_no_tick_is_computed_otherwise(
    whole: tuple[list[Logged], Settings], tmp_path: Path, seed: int
) -> None:
    """Every recorded tick is computed as of the whole log, or named: as unknown, or among rows that are missing.

    Of the first seed the log begins late: the operator had moved the body before the recorder came.
    """
    (messages, settings), rng = whole, random.Random(seed)
    truth = read(write(tmp_path / "whole.mcap", settings, messages)).ticks
    for first in (rng.randrange(0, TICKS, 50) for _ in range(3 if seed else 0)):
        messages = without(messages, first, first + rng.randrange(40, 500), rng.choice(["controller", "plant", None]))
    log = write(tmp_path / "a.mcap", settings, messages if seed else without(messages, 0, 800))
    known, findings, replayed = read(log).ticks, read(log).findings, replay([log])
    its = truth.where(np.isin(truth.k, known.k))
    assert (known.k == its.k).all()
    assert (known.desired == its.desired).all()
    for name in COLUMNS:
        found = getattr(known, name)
        same = (found == getattr(its, name)) | np.isnan(found)
        assert same.all(), (name, known.k[~same.all(axis=1)])
    assert seed or 800 < known.k[0] < 860
    batches = [found for message in messages if (found := ends_of(message)) is not None]
    recorded = {k for _, first, last in batches for k in range(first, last + 1)}
    spans = [(one.first_tick, one.last_tick) for one in findings.unknown]
    spans += [(one.first_tick, one.last_tick) for one in findings.missing if one.last_tick is not None]
    named = {k for first, last in spans for k in range(first, last + 1)}
    answered = range(int(known.k[-1]) + 1)
    assert recorded & set(answered) <= set(known.k.tolist()) | named
    assert not replayed.differs
    exported = export([log], "csv", tmp_path / "a.csv")
    assert (exported.rows, exported.unknown) == (len(known.k), findings.unknown)
    assert replayed.unknown == findings.unknown


def test_what_was_in_force_before_the_first_change_that_a_late_log_has_is_unknown(tmp_path: Path) -> None:
    """The first record is of after the change, and no reader knows what was followed before it."""
    messages = made(lockstep(), TICKS, GOES_AWAY | {1000: (Gains(C2=(0.1, 0.1, 0.1)), LEVEL)})
    found = read(write(tmp_path / "late.mcap", lockstep(), without(messages, 0, 899)))
    (unknown,) = found.findings.unknown
    assert 900 <= unknown.first_tick < unknown.last_tick == found.ticks.k[0] - 1
    assert 1000 <= found.ticks.k[0] < 1060
    assert f"ticks {unknown.first_tick} to {unknown.last_tick} of s1 are left out" in str(unknown)


def test_without_a_record_and_a_beginning_nothing_is_known(tmp_path: Path) -> None:
    """The beginning of a log shorter than a record's period is missing, or all of the controller's trace."""
    short, long = without(made(lockstep(), 480), 0, 100), made(lockstep(), TICKS, GOES_AWAY)
    assert all(b'"record"' not in one.payload for one in short)
    plants = [one for one in long if not one.key.endswith("trace/controller")]
    for name, messages in (("short", short), ("plants", plants)):
        log = write(tmp_path / f"{name}.mcap", lockstep(), messages)
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
    log = write(tmp_path / "a.mcap", lockstep(), [*made(lockstep(), 700, GOES_AWAY), *without(second, 0, 1000)])
    later = read(log, session="s2").findings
    assert later.final_error_deg is not None
    assert later.final_error_deg < 2
    both = replay([log])
    assert both.unknown == []
    assert [(one.session, one.differ) for one in both.sessions] == [("s1", 0), ("s2", 0)]


def test_a_batch_has_the_record_once_a_second_and_a_long_one_less_often() -> None:
    for points, least in ((1, 10), (600, 20)):  # batches of 0.1 s
        writer = TraceWriter("plant", load().wire, 1)
        writer.session = "s"
        writer.record = record_json([Change(session="s", tick=7, gains=Gains(C1=(0.3,) * 3), reference=AWAY)] * points)
        batches = [read_batch(writer.take(n * 10**8, 0)) for n in range(1, 200)]
        with_it = [i for i, batch in enumerate(batches) if batch is not None and batch.tail.record]
        gaps = {b - a for a, b in pairwise(with_it)}
        assert (with_it[0], gaps) == (0, {10}) if points == 1 else min(gaps) >= least


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
    assert record.model_copy(update={"reference": Stream()}).in_force == []
