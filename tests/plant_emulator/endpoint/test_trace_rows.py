"""Rows of the plant's trace: one per tick of a session, with the actions between ticks."""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate

import numpy as np
import pytest

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.trace import MAX_ROWS, Batch, Outcome, PlantChange, Sent
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from tests.support.plant_stage import Stage

LOOP = LoopSettings(realtime="off")
WIRE = WireSpec()
PLANT = PlantSettings()
OFF = (0.0, 0.0)


def answer(stage: Stage, measurement: bytes) -> None:
    stage.command(measurement, (3, -3))


def at(what: dict[int, Callable[[Stage], object]]) -> Callable[[Stage], None]:

    def between(stage: Stage) -> None:
        if act := what.pop(stage.endpoint.ticked, None):
            act(stage)

    return between


def rows(batches: list[Batch], column: str) -> list[object]:
    return [value for batch in batches for value in batch.columns[column].tolist()]


def operations(batches: list[Batch]) -> list[PlantChange]:
    return [operation for batch in batches for operation in batch.tail.operations]


def test_a_session_begins_with_a_measurement_on_the_grid_however_long_its_grant_took() -> None:
    """The controller derives the grid from it; one sent late would put it ticks back."""

    def held_up() -> int:
        return 5 if stage.endpoint.session is not None and not stage.wires.sent else 0

    stage = Stage(LOOP, WIRE, PLANT, between=at({4: Stage.claim}), answer=answer, skip=held_up)
    batches = stage.run(20).batches
    assert rows(batches, "tick") == list(range(11, 21))
    assert [WIRE.measurement.counter(frame) for frame in stage.wires.sent] == list(range(10))
    assert stage.skipped == 0  # what was held up is before the session


def test_every_tick_of_a_session_has_a_row_and_no_other_tick() -> None:
    between = at({4: Stage.claim, 20: lambda stage: stage.endpoint.release("s1"), 30: Stage.claim})
    batches = Stage(LOOP, WIRE, PLANT, between=between, answer=answer).run(400).batches
    # The grid is waited for again after a grant, which takes its time.
    assert rows(batches, "tick") == [*range(6, 21), *range(32, 401)]
    assert rows(batches, "session_tick") == [*range(15), *range(369)]
    with_rows = [batch.header for batch in batches if batch.header.rows]
    assert [(header.session, header.final) for header in with_rows] == [
        ("s1", True),
        *[("s2", False)] * (len(with_rows) - 2),
        ("s2", True),
    ]
    sizes = [header.rows for header in with_rows]
    assert (sizes[0], max(sizes[1:]) <= MAX_ROWS) == (15, True)
    assert [header.first_row for header in with_rows] == [0, *accumulate(sizes[:-1])]
    assert [(operation.kind, operation.tick) for operation in operations(batches)] == [
        ("claim", 4),
        ("release", 20),
        ("claim", 30),
    ]


def test_a_row_holds_what_came_what_was_made_of_it_and_what_was_measured() -> None:
    stage = Stage(LOOP, WIRE, PLANT, between=at({0: Stage.claim}), answer=answer).run(50)
    batches = stage.batches
    assert b"".join(stage.wires.sent) == b"".join(batch.columns["measurement"].tobytes() for batch in batches)
    volts = tuple(WIRE.voltage.quantizer().level(code) for code in (3, -3))
    assert [tuple(row) for batch in batches for row in batch.columns["voltages"]] == [OFF] + [volts] * 48
    assert rows(batches, "outcome") == [Outcome.NONE] + [Outcome.ACTED] * 48
    assert rows(batches, "received_as") == [Sent.NONE] + [Sent.FRAME] * 48
    assert rows(batches, "answered") == [0xFFFF_FFFF, *range(48)]
    for batch in batches:
        sent, received = batch.times_ns("sent"), batch.times_ns("received")
        assert (np.diff(sent) >= 0).all()
        assert ((received < sent) | (received == -1)).all()


@pytest.mark.parametrize(
    ("frame", "received_as", "outcome"),
    [
        (WIRE.command.pack(38, (3, -3)) + b"\0", Sent.MALFORMED, Outcome.MALFORMED),  # the rest would be fresh
        (UNCHANGED, Sent.SILENT, Outcome.MALFORMED),
        (b"\xff" * WIRE.command.size, Sent.FRAME, Outcome.MALFORMED),
        (WIRE.command.pack(3, (31, 31)), Sent.FRAME, Outcome.REPEATED),
    ],
)
def test_what_is_not_acted_upon_is_in_its_row(frame: bytes, received_as: Sent, outcome: Outcome) -> None:
    between = at({0: Stage.claim, 40: lambda stage: stage.wires.deliver(frame, 0)})
    batches = Stage(LOOP, WIRE, PLANT, between=between, answer=answer).run(50).batches
    row = rows(batches, "tick").index(41)
    assert rows(batches, "received_as")[row] == received_as
    assert rows(batches, "outcome")[row] == outcome
    if received_as is Sent.FRAME:
        assert b"".join(b.columns["command"].tobytes() for b in batches)[row * len(frame) :][: len(frame)] == frame
