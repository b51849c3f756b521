"""Driver of an emulator in simulated time: rows of its trace, one per tick of a session, and its faults."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import accumulate

import numpy as np
import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Notice
from aeroloop.plant_emulator.faults.injection import MAX_FAULTS
from aeroloop.plant_emulator.faults.language import KINDS, SIGNALS
from aeroloop.plant_emulator.hosts.driver import IDLE_WAIT_S
from aeroloop.plant_emulator.model.emulated import FrictionSettings
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.trace import MAX_ROWS, Batch, Outcome, PlantChange, Sent
from aeroloop.protocol.wire.frames import TickCounter
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from tests.support.plant_end import Stage
from tests.support.simulated_link import wire_of

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


def test_a_session_begins_on_the_grid_however_long_its_grant_took_and_counts_the_ticks_it_skips() -> None:
    """The controller derives the grid from it; one sent late would put it ticks back."""

    def held_up() -> int:
        if stage.endpoint.ticked == 14:  # as tick 15 begins
            return 3
        return 5 if stage.endpoint.session is not None and not stage.wires.sent else 0

    stage = Stage(LOOP, WIRE, PLANT, between=at({4: Stage.claim}), answer=answer, skip=held_up)
    batches = stage.run(20).batches
    assert rows(batches, "tick") == [*range(11, 16), 19, 20]
    assert [WIRE.measurement.counter(frame) for frame in stage.wires.sent] == [0, 1, 2, 3, 4, 8, 9]
    assert stage.skipped == 3  # what was held up before the session does not count


def test_a_plant_that_steps_on_request_waits_for_requests_and_does_not_spin() -> None:
    passes = 0

    def between(stage: Stage) -> None:
        nonlocal passes
        passes += 1
        if passes == 1:
            stage.claim()
        if passes == 5:
            stage.steps = 3

    stage = Stage(LoopSettings(realtime="off", lockstep=True), WIRE, PLANT, between=between, answer=answer)
    stage.steps = 0
    stage.run(2)
    assert len(stage.wires.sent) == 3
    assert stage.clock.slept == [IDLE_WAIT_S] * 4  # each pass before the request


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
        ("release", 400),  # by the driver, which ends
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
        assert ((received <= sent) | (received == -1)).all()


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


def test_in_lockstep_a_silent_measurement_is_answered_before_the_next_tick() -> None:
    """At rest, most measurements are silent; each still has the counter after the last, which its answer echoes."""
    wire = wire_of("on_change", "periodic")
    loop = LoopSettings(realtime="off", lockstep=True)

    def answer_silence(stage: Stage, _: bytes) -> None:
        echo = stage.endpoint.session_tick % wire.measurement.counters
        stage.wires.deliver(wire.command.pack(echo, (0, 0)), stage.endpoint.ticked)

    plant = PLANT.model_copy(update={"friction": FrictionSettings(coulomb=(1.0, 1.0))})  # so that it stays at rest
    stage = Stage(loop, wire, plant, between=at({-1: Stage.claim}), answer=answer_silence).run(100)
    assert stage.wires.sent.count(UNCHANGED) > 50
    assert rows(stage.batches, "outcome") == [Outcome.NONE] + [Outcome.ACTED] * 100
    assert rows(stage.batches, "answered")[1:] == [*range(100)]


# ── faults: one to come changes nothing, and each begin, end and frame counts ──


CLAIMED_AT = 7
"""The plant's last tick before the claim."""
FIRST = CLAIMED_AT + 2
"""The plant's tick of the session's first measurement: a driver waits for the next tick after a grant."""


class Run(Stage):
    """An emulator with faults, driven from tick 8 on, and what its front was passed."""

    def __init__(self, *faults: str, lockstep: bool = False, between: Callable[[Run], None] = lambda _: None) -> None:
        def before(stage: Stage) -> None:
            assert isinstance(stage, Run)
            if stage.endpoint.ticked == (-1 if lockstep else CLAIMED_AT):  # in lockstep there is no tick before it
                stage.claim()
            between(stage)

        loop = LoopSettings(realtime="off", lockstep=lockstep)
        plant = PlantSettings(faults=list(faults))
        super().__init__(loop, WIRE, plant, between=before, answer=lambda stage, frame: stage.command(frame, (1, -1)))

    @property
    def events(self) -> list[Notice]:
        faults = [notice for notice in self.endpoint.notices if notice.kind == "fault"]
        return [notice for notice in faults if notice.text.startswith(("fault begins", "fault ends"))]

    def column(self, name: str) -> np.ndarray:
        return np.concatenate([batch.columns[name] for batch in self.batches if batch.header.rows])


def every_fault(when: str) -> list[str]:
    values = {kind: "" if kind in ("off", "stuck") else "=0.5" for kind in KINDS}
    return [f"{name}:{kind}{values[kind]}{when}" for name in SIGNALS for kind in SIGNALS[name].kinds]


@pytest.mark.parametrize("lockstep", [False, True])
def test_faults_that_are_to_come_change_no_byte_and_leave_every_frame_as_it_arrived(lockstep: bool) -> None:
    without = Run(lockstep=lockstep).run(300)
    faults = [text for text in every_fault("@1000") if not re.match("motor[3-8]", text)]  # the Aero has two
    for i in range(0, len(faults), MAX_FAULTS):
        run = Run(*faults[i : i + MAX_FAULTS], lockstep=lockstep).run(300)
        assert run.wires.sent == without.wires.sent
        for name in ("tick", "session_tick", "sent_as", "received_as", "outcome", "answered", "measurement", "command"):
            assert (run.column(name) == without.column(name)).all(), name
        assert (run.column("voltages") == without.column("voltages")).all()
        assert {status.changed for status in run.endpoint.fault_statuses()} == {0}
        assert run.events == []


@pytest.mark.parametrize("fault", ["reorder=0.5", "duplicate=0.5", "drop=0.5", "delay=0.02"])
def test_in_lockstep_an_overtaken_or_repeated_measurement_is_not_answered_and_not_waited_for(fault: str) -> None:
    """The other end answers as a controller does: what is newer than all before it."""
    answered = TickCounter(LOOP.period_ns, WIRE.measurement.counters, lockstep=True)

    def as_a_controller(frame: bytes) -> None:
        counter = WIRE.measurement.counter(frame)
        assert counter is not None
        if answered.advance(counter, 0) is not None:
            run.command(frame, (1, -1))

    run = Run(f"measurement:{fault}", lockstep=True)
    run.wires.answer = as_a_controller
    run.run(600)
    assert run.endpoint.trip is None, run.endpoint.notices
    assert run.column("session_tick").tolist() == list(range(600 + 1))
    assert answered.tick >= 590  # and no tick was taken for one of a later round of the counter
    assert answered.tick <= 600


def test_configured_faults_count_from_the_claim_and_publish_begin_and_end_with_the_sessions_tick() -> None:
    run = Run("command:drop=1@0.1..0.14", "rate:bias=0.1@0.2").run(300)
    begin, later = CLAIMED_AT + 50, CLAIMED_AT + 100
    found = [(status.begin_tick, status.end_tick, status.source) for status in run.endpoint.fault_statuses()]
    assert found == [(begin, begin + 20, "configured"), (later, None, "configured")]
    assert [(notice.tick, notice.text) for notice in run.events] == [
        (begin - FIRST, "fault begins (configured): command:drop=1@0.1..0.14"),
        (begin + 20 - FIRST, "fault ends (configured): command:drop=1@0.1..0.14, 20 commands dropped"),
        (later - FIRST, "fault begins (configured): rate:bias=0.1@0.2"),
    ]
    assert {notice.session for notice in run.events} == {"s1"}
    withheld = run.column("tick")[run.column("outcome") == Outcome.WITHHELD]
    assert withheld.tolist() == list(range(begin + 1, begin + 21))  # a row has the command received before its tick


@pytest.mark.parametrize(
    ("fault", "changed", "effect"),
    [
        ("command:delay=0.01", 10, "commands delayed"),
        ("command:stuck", 10, "commands replaced by the last"),
        ("command:reorder=1", 5, "commands reordered"),  # one that overtakes another counts once for both
        ("measurement:drop=1", 10, "measurements dropped"),
        ("rate:noise=0.001", 10, "samples made noisy"),
        ("motors:delay=0.01", 10, "voltages delayed"),
    ],
)
def test_every_frame_sample_and_voltage_that_a_fault_changed_is_counted(fault: str, changed: int, effect: str) -> None:
    """Ten ticks at 500 Hz, while the loop runs."""
    (status,) = Run(f"{fault}@0.1..0.12").run(150).endpoint.fault_statuses()
    assert (status.changed, status.effect) == (changed, effect)
