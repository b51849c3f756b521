"""A verdict is about what a session's own processes did: no stranger's message turns it red, and no lost end is green.

Anyone on the network may publish a batch. What ends a session without its last batch in the log is counted.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from aeroloop.plant_emulator.hosts.trace import PlantReplay
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Change, Gains
from aeroloop.protocol.messages.trace import (
    ControllerRow,
    End,
    PlantChange,
    Received,
    Sent,
    TraceWriter,
    read_batch,
)
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.lab.check import check_log
from aeroloop.service.logs.recording import Recording
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import read
from tests.support.edited_log import Said, message_of, parts, rewrite
from tests.support.made_log import RUNS, SESSION, START_NS, VEHICLE, Changes, Logged, lockstep, made, make_log, write

TICKS = 600
LATER_NS = 30_000_000_000


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("judged") / "a.mcap"
    make_log(path, TICKS, settings=lockstep())
    return rewrite(path, path.with_name("whole.mcap"))


# ── strangers ──


def batch_of(end: End, run: int, session: str, first_row: int = 0, ticks: int = 20) -> bytes:
    """A well-formed batch as a stranger may make it, with rows of a session from tick `first_row` on."""
    wire = lockstep().wire
    writer = TraceWriter("controller", wire, run)
    writer.session = session
    frames = bytes(wire.measurement.size), bytes(wire.command.size)
    for k in range(first_row, first_row + ticks):
        at_ns = LATER_NS + k
        writer.row(ControllerRow(k, Received.FRAME, Sent.FRAME, at_ns, at_ns, *frames))
    data = bytearray(writer.take(LATER_NS, START_NS + LATER_NS))
    data[24:32] = first_row.to_bytes(8, "little")
    return bytes(data) if end == "controller" else of_plant(bytes(data))


def of_plant(controllers: bytes) -> bytes:
    """A plant's batch of the same rows, of which no column means anything."""
    batch = read_batch(controllers)
    assert batch is not None
    header = batch.header._replace(end="plant")
    columns = bytes(header.rows * header.row_dtype.itemsize)
    head = bytearray(controllers[:112])
    head[1] = 1
    head[12:16] = bytes(4)
    return bytes(head) + columns


def unclaimed(run: int) -> bytes:
    """A plant's batch whose claim does not say what it claims."""
    writer = TraceWriter("plant", lockstep().wire, run)
    writer.operations.append(PlantChange(tick=-1, kind="claim"))
    return writer.take(LATER_NS, START_NS + LATER_NS)


def ended(run: int, first_row: int) -> bytes:
    """A plant's batch without rows that ends the real session before a row."""
    writer = TraceWriter("plant", lockstep().wire, run)
    writer.session = SESSION
    data = bytearray(writer.take(LATER_NS, START_NS + LATER_NS, final=True))
    data[24:32] = first_row.to_bytes(8, "little")
    return bytes(data)


def trace(end: End, data: bytes, vehicle: str = VEHICLE) -> Said:
    return Said(topics.key("trace", vehicle, role=end), START_NS + LATER_NS, data)


ROWS = 100_000  # later than any that the log has
STRANGERS: dict[str, list[Said]] = {
    "a claim without a claim": [trace("plant", unclaimed(77))],
    "a run of its own": [trace(end, batch_of(end, 77, SESSION)) for end in ("controller", "plant")],
    "a session of its own": [trace("controller", batch_of("controller", 77, "mine"))],
    "two batches of it": [trace("plant", batch_of("plant", 77, "mine", row)) for row in (0, 40)],
    "a vehicle of its own": [trace(end, batch_of(end, 77, "mine"), "ghost") for end in ("controller", "plant")],
    "later rows of the real run": [
        trace(end, batch_of(end, RUNS[end], SESSION, ROWS)) for end in ("controller", "plant")
    ],
    "later rows of the real run, of another session": [
        trace("controller", batch_of("controller", RUNS["controller"], "mine", ROWS)),
        trace("plant", batch_of("plant", RUNS["plant"], "other", ROWS)),
    ],
    "an end in the middle of the real run": [trace("plant", ended(RUNS["plant"], row)) for row in (7, 60, 599)],
    "a tick of the far future": [trace("controller", batch_of("controller", 77, "mine", 4_000_000_000))],
    "a description of an unknown end": [
        Said(topics.key("description", "ghost", role="controller"), START_NS, b'{"protocol": 2}'),
        Said(topics.key("description", "ghost", role="plant"), START_NS, b"\xff" * 40),
    ],
}


@pytest.mark.parametrize("said", STRANGERS.values(), ids=STRANGERS.keys())
def test_a_stranger_turns_no_verdict_red(log: Path, tmp_path: Path, said: list[Said]) -> None:
    path = rewrite(log, tmp_path / "b.mcap", more=said)
    both, clean = replay([path]), replay([log])
    assert (both.controller, both.plant) == (clean.controller, clean.plant)
    assert (both.complete, both.missing, both.reasons) == (True, [], {})
    assert execute(["log", "replay", str(path)]) == 0
    assert execute(["log", "review", str(path), "--require", "skipped_ticks=0", "--require", "missing_ticks=0"]) == 0
    assert check_log([path], []).same


def test_what_is_not_judged_is_named(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rewrite(log, tmp_path / "b.mcap", more=STRANGERS["two batches of it"])
    assert replay([path]).others == ["aero/mine, 40 rows"]
    assert "not judged: aero/mine, 40 rows" in check_log([path], []).notes
    assert execute(["log", "replay", str(path)]) == 0
    assert "not judged: aero/mine, 40 rows" in " ".join(capsys.readouterr().out.split())
    assert read(path, session="mine").findings.session == "mine"  # named, it is


def test_sessions_of_both_ends_and_all_others_of_their_processes_are_judged(tmp_path: Path) -> None:
    """Both ends were restarted. The second plant's controller is not in the log: its rows are missing."""
    first, second = made(lockstep(), 300), made(lockstep(), 200, session="s2", at_ns=LATER_NS)
    both = write(tmp_path / "a.mcap", lockstep(), [*first, *second])
    assert [one.session for one in replay([both]).sessions] == [SESSION, "s2"]
    assert replay([both]).complete
    lone = [one for one in second if not one.key.endswith("trace/controller")]
    lone = [one._replace(payload=of_run(one, RUNS["plant"], 300)) for one in lone]
    found = replay([write(tmp_path / "b.mcap", lockstep(), [*first, *lone])])
    assert [str(gap) for gap in found.missing] == ["199 of the controller's ticks in s2, ticks 0 to 198"]
    assert not found.complete


def of_run(one: Logged, run: int, rows: int) -> bytes:
    """A batch of a plant as of another process, which has published so many rows before."""
    if "/trace/" not in one.key:
        return one.payload
    data = bytearray(one.payload)
    data[16:24] = run.to_bytes(8, "little")
    data[24:32] = (int.from_bytes(data[24:32], "little") + rows).to_bytes(8, "little")
    return bytes(data)


def test_a_claim_that_says_nothing_ends_a_replay_with_its_reason() -> None:
    settings = lockstep()
    plant = PlantReplay(settings.loop, settings.wire, settings.plant)
    batch = read_batch(unclaimed(7))
    assert batch is not None
    plant.feed(batch)
    assert plant.result().stopped == "the claim after tick -1 does not say what it claims"


def test_gains_that_the_law_does_not_have_are_named(log: Path, tmp_path: Path) -> None:
    """As in a batch of the real run with a change that no operator asked for."""
    wire, run = lockstep().wire, RUNS["controller"]
    writer = TraceWriter("controller", wire, run)
    writer.session = SESSION
    writer.changes.append(Change(session=SESSION, tick=7, gains=Gains(C9=(1.0,))))
    more = [trace("controller", writer.take(LATER_NS, START_NS + LATER_NS))]
    found = check_log([rewrite(log, tmp_path / "b.mcap", more=more)], [])
    assert not found.same
    assert "law adaptive has no gain C9 of 1 numbers" in (found.error or "")


# ── recorders that were killed, and ends that died meanwhile ──


def without_index(path: Path) -> Path:
    """The file as a recorder leaves it that was killed between two chunks."""
    data = path.read_bytes()
    end = next(part for part in parts(data[: -len(MAGIC)], len(MAGIC)) if part.opcode == Opcode.DATA_END)
    path.write_bytes(data[: end.offset])
    return path


def test_a_recorder_killed_and_restarted_without_a_missing_row_is_green_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = made(lockstep(), TICKS)
    half = len(messages) // 2
    first = without_index(write(tmp_path / "a.mcap", lockstep(), messages[:half], chunk_every=1))
    second = write(tmp_path / "b.mcap", lockstep(), messages[half - 6 :])
    logs = [str(first), str(second)]
    assert execute(["log", "replay", *logs]) == 0
    assert "the file ends here, without its index" in " ".join(capsys.readouterr().out.split())
    assert execute(["log", "review", *logs, "--require", "skipped_ticks=1000"]) == 0
    found = check_log([first, second], [])
    assert found.same
    assert any("without its index" in note for note in found.notes)
    assert not replay([first]).complete  # the session goes on after it
    going_on = [
        one._replace(payload=one.payload[:2] + b"\0" + one.payload[3:]) if "/trace/" in one.key else one
        for one in messages
    ]
    stopped = write(tmp_path / "c.mcap", lockstep(), going_on[half - 6 :])  # before the session ended
    assert replay([first, stopped]).complete
    killed = without_index(write(tmp_path / "d.mcap", lockstep(), going_on))
    assert not replay([killed]).complete


@pytest.mark.parametrize("end", ["controller", "plant"])
def test_a_row_less_and_the_file_that_ends_early_is_a_damage(tmp_path: Path, end: End) -> None:
    messages = made(lockstep(), TICKS)
    half = len(messages) // 2
    first = without_index(write(tmp_path / "a.mcap", lockstep(), messages[:half], chunk_every=1))
    lost = next(one for one in messages[half:] if one.key.endswith(f"trace/{end}"))
    second = write(tmp_path / "b.mcap", lockstep(), [one for one in messages[half:] if one is not lost])
    replayed = replay([first, second])
    assert not replayed.complete
    assert any("without its index" in line for line in replayed.unseen[end])


def cut_off(messages: list[Logged]) -> list[Logged]:
    """Without the last batches of both ends, which died while the recorder received nothing."""
    tails = [[one for one in messages if one.key.endswith(f"trace/{end}")][-3:] for end in ("controller", "plant")]
    return [one for one in messages if one not in tails[0] and one not in tails[1]]


def restarted() -> list[Logged]:
    return made(lockstep(), 200, session="s2", at_ns=LATER_NS)


def event_later() -> list[Logged]:
    said = message_of("event", b"{}", START_NS + LATER_NS, role="recorder")
    return [Logged(said.at_ns, said.key, said.data, said.published_ns)]


@pytest.mark.parametrize("later", [restarted, event_later], ids=["new sessions came", "the recorder went on"])
def test_the_tail_that_was_lost_as_both_ends_died_is_counted(tmp_path: Path, later: Callable[[], list[Logged]]) -> None:
    log = write(tmp_path / "a.mcap", lockstep(), [*cut_off(made(lockstep(), TICKS)), *later()])
    findings = read(log, session=SESSION).findings
    assert all(count > 0 for count in findings.missing_ticks.values())
    lines = [str(gap) for gap in findings.missing]
    assert any(line.startswith("1 or more of the plant's ticks, from tick ") for line in lines)
    assert execute(["log", "review", str(log), "--session", SESSION, "--require", "missing_ticks=0"]) == 1
    permitted = f"missing_ticks={sum(findings.missing_ticks.values())}"
    assert execute(["log", "review", str(log), "--session", SESSION, "--require", permitted]) == 0
    assert not replay([log]).complete
    assert not check_log([log], []).same


def test_a_recording_that_ended_before_its_session_lacks_nothing(tmp_path: Path) -> None:
    log = write(tmp_path / "a.mcap", lockstep(), cut_off(made(lockstep(), TICKS)))
    findings = read(log).findings
    assert max(findings.missing_ticks.values()) <= 1  # what the other end proves
    assert "or more" not in " ".join(map(str, findings.missing))


# ── gains ──


def test_gains_of_a_lost_change_are_those_of_the_record_at_the_tick_of_the_next(tmp_path: Path) -> None:
    """C2 is set, then Gamma within the same second, and C2's batch is lost: the record has both since Gamma's tick."""
    settings = load()
    changes: Changes = {120: (Gains(C2=(0.3, 0.3, 0.3)), None), 320: (Gains(Gamma=(0.01, 0.01, 0.01)), None)}
    messages = made(settings, 2000, changes)
    lost = next(one for one in messages if b'"C2":[0.3' in one.payload and b'"tick":120' in one.payload)
    log = write(tmp_path / "a.mcap", settings, [one for one in messages if one is not lost])
    whole = read(write(tmp_path / "whole.mcap", settings, messages)).ticks
    ticks, replayed = read(log).ticks, replay([log])
    assert replayed.controller is not None
    assert replayed.controller.differ == 0
    after = ticks.where(ticks.k >= 320)
    assert len(after.k) > 1600
    assert (after.gains == whole.where(np.isin(whole.k, after.k)).gains).all()
    recording = Recording([log])
    session = recording.session(recording.choose())
    (gamma,) = (one for one in session.changes if one.tick == 320)
    assert gamma.gains is not None
    assert gamma.gains.named["C2"] == (0.3, 0.3, 0.3)
