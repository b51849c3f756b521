"""Trace batches: round trips, golden vectors of SPEC.md, and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop import protocol
from aeroloop.protocol.messages.operator import Change, Gains, Hold
from aeroloop.protocol.messages.trace import (
    MAX_ROWS,
    NEVER,
    ControllerRow,
    End,
    PlantChange,
    PlantRow,
    TraceWriter,
    read_batch,
)
from aeroloop.protocol.wire.spec import WireSpec

SPEC: Final = (Path(protocol.__file__).parent / "SPEC.md").read_text(encoding="utf-8")
WIRE: Final = WireSpec()
S: Final = 1_000_000_000
ROW: Final = ControllerRow(0, 0, 1, 10 * S, 10 * S + 1, bytes(7), bytes(3))


def golden(end: str) -> tuple[list[list[Any]], bytes]:
    """Rows and bytes of one golden vector, as the text has them."""
    text = SPEC.partition("### Golden vectors of the trace")[2].partition(f"**{end}**")[2]
    table, _, rest = text.partition("```\n")
    lines = [line for line in table.splitlines() if line.startswith("| ") and "tick" not in line]
    rows = [[_value(cell.strip()) for cell in line.strip("|").split("|")] for line in lines if set(line) - set("|- ")]
    return rows, bytes.fromhex(rest.partition("```")[0])


def _value(cell: str) -> Any:
    if not cell.startswith("`"):
        return int(cell)
    text = cell.strip("`").replace("–", "")
    return tuple(map(float, text.split())) if " " in text else bytes.fromhex(text)


def test_the_golden_batch_of_the_controller_is_what_the_writer_writes() -> None:
    rows, batch = golden("Controller")
    writer = TraceWriter("controller", WIRE, 0x0123456789ABCDEF)
    writer.session = "s1"
    writer.changes.append(Change(session="s1", tick=0, gains=Gains(C1=None, C2=(0.2, 0.2, 0.2), Gamma=None)))
    for row in rows:
        writer.row(ControllerRow(*row))
    assert len(rows) == 3
    assert writer.take(2_650_000_000, 1_800_000_000_650_000_000).hex(" ") == batch.hex(" ")
    assert writer.empty


def test_the_golden_batch_of_the_plant_is_what_the_writer_writes() -> None:
    rows, batch = golden("Plant")
    writer = TraceWriter("plant", WIRE, 0xFEDCBA9876543210)
    for row in rows[:1] * 7:
        writer.row(PlantRow(*row))
    writer.take(0, 0)  # seven rows before
    writer.session = "s1"
    for row in rows:
        writer.row(PlantRow(*row))
    writer.operations.append(PlantChange(tick=1001, kind="stop"))
    assert writer.take(5_004_100_000, 1_800_000_000_004_100_000, final=True).hex(" ") == batch.hex(" ")


def test_a_command_that_was_received_long_before_its_tick_keeps_its_time() -> None:
    """As of a plant that was halted: the first row of its next batch acts on it."""
    writer = TraceWriter("plant", WIRE, 1)
    row = PlantRow(0, 0, 1, 1, 1, 0, -1, 60 * S, 20 * S, bytes(7), bytes(3), (0.0, 0.0))
    writer.row(row)
    writer.row(row._replace(tick=1, sent_ns=60 * S + 2_000_000, received_ns=60 * S + 1_000_000))
    assert not writer.due(60 * S + 50_000_000)
    assert writer.due(60 * S + 100_000_000)
    batch = read_batch(writer.take(61 * S, 0))
    assert batch is not None
    assert batch.times_ns("received").tolist() == [20 * S, 60 * S + 1_000_000]
    assert batch.times_ns("sent").tolist() == [60 * S, 60 * S + 2_000_000]


at_ns = st.integers(10 * S, 12 * S)
ticks = st.integers(0, 2**32 - 2)
acts = st.integers(0, 3)
frames = st.binary(min_size=7, max_size=7), st.binary(min_size=3, max_size=3)
volts = st.tuples(*[st.floats(-24, 24)] * 2)
controller_rows = st.builds(ControllerRow, ticks, acts, acts, at_ns, st.just(0) | at_ns, *frames)
plant_rows = st.builds(
    PlantRow, st.integers(0, 2**64 - 1), ticks, acts, acts, acts, acts, st.integers(-1, 2**32 - 2),
    at_ns, st.just(0) | at_ns, *frames, volts,
)  # fmt: skip


def same(column: npt.NDArray[Any], added: list[Any]) -> bool:
    """Whether a column has these values: numbers, frames or voltages."""
    if column.dtype.kind == "V":
        return [bytes(frame) for frame in column] == added
    if column.dtype == np.uint32:
        added = [value & NEVER for value in added]
    return bool(np.array_equal(column.ravel(), np.array(added, column.dtype).ravel()))


@pytest.mark.parametrize(("end", "drawn"), [("controller", controller_rows), ("plant", plant_rows)])
@given(data=st.data(), final=st.booleans())
def test_batches_read_back_as_the_rows_that_were_added(
    end: End, drawn: st.SearchStrategy[Any], data: st.DataObject, final: bool
) -> None:
    writer = TraceWriter(end, WIRE, 5)
    writer.session = "abc"
    pieces = data.draw(st.lists(st.lists(drawn, max_size=20), min_size=1, max_size=3))
    before = 0
    for rows in pieces:
        writer.state = {"sign": 1}
        for row in rows:
            writer.row(row)
        batch = read_batch(writer.take(13 * S, 77 * S, final=final))
        assert batch is not None
        header = batch.header
        assert (header.rows, header.final, header.session, header.run) == (len(rows), final, "abc", 5)
        assert header.first_row == before
        assert header.wall_ns - header.monotonic_ns == 64 * S
        assert batch.tail.state == {"sign": 1}
        for name, column in batch.columns.items():
            assert name in ("received", "sent") or same(column, [getattr(row, name) for row in rows])
        for when, added in (
            (batch.times_ns("received"), [row.received_ns for row in rows]),
            (batch.times_ns("sent"), [row.sent_ns for row in rows]),
        ):
            for read_ns, added_ns in zip(when.tolist(), added, strict=True):
                if added_ns == 0:
                    assert read_ns == -1
                elif added_ns >= header.monotonic_ns:  # what lies before the base wraps; no end sends so early
                    assert 0 <= added_ns - read_ns < 1000
        before += header.rows


def test_a_batch_is_due_when_it_is_full_or_its_first_row_has_waited_long_enough() -> None:
    writer = TraceWriter("controller", WIRE, 5)
    assert not writer.due(10 * S)
    writer.row(ROW)
    assert not writer.due(10 * S + S // 10 - 1)
    assert writer.due(10 * S + S // 10)
    for k in range(1, MAX_ROWS):
        assert not writer.due(10 * S)
        writer.row(ROW._replace(tick=k))
    assert writer.due(10 * S)


def test_what_is_no_batch_is_refused_whole() -> None:
    for end in ("Controller", "Plant"):
        _, batch = golden(end)
        assert read_batch(batch) is not None
        for size in range(len(batch)):
            assert read_batch(batch[:size]) is None
        assert read_batch(batch + b"\0") is None
        for at, value in ((0, 1), (0, 3), (1, 2), (2, 2), (3, 0), (3, 9), (8, 99), (9, 2), (48, 200)):
            assert read_batch(batch[:at] + bytes([value]) + batch[at + 1 :]) is None, at
        assert read_batch(batch[:-1] + b"]") is None


def test_a_batch_of_more_rows_than_one_may_have_is_refused() -> None:
    writer = TraceWriter("controller", WIRE, 5)
    for rows in (MAX_ROWS, MAX_ROWS + 1):
        for k in range(rows):
            writer.row(ROW._replace(tick=k))
        assert (read_batch(writer.take(11 * S, S)) is not None) == (rows == MAX_ROWS)


def test_a_record_is_of_the_session_that_runs_and_of_none_before_it() -> None:
    """The changes of a session begin with all that holds; of an earlier one nothing does."""
    writer, gains = TraceWriter("controller", WIRE, 1), Gains(C1=None, C2=(0.2, 0.2, 0.2), Gamma=None)
    for i, change in enumerate(
        (Change(session="a", tick=0, gains=gains, reference=Hold()), Change(session="b", tick=0))
    ):
        writer.session = change.session
        writer.changes.append(change)
        writer.take(10 * i * S, 0)
        batch = read_batch(writer.take((10 * i + 5) * S, 0))
        assert batch is not None
        assert {each.session for each in batch.tail.record} == ({"a"} if change.session == "a" else set())
