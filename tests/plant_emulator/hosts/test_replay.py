"""Replay of the plant from its own rows: byte for byte equal, and every edit of a log found.

Loops of an emulator's driver in simulated time: ticks are skipped; commands are lost, repeated, late and garbled;
faults are injected; sessions begin and end in every way.
"""

from __future__ import annotations

from random import Random
from typing import get_args

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.trace import PlantReplay, PlantReplayed
from aeroloop.plant_emulator.model.emulated import WindSettings
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Batch, Outcome, PlantChangeKind
from aeroloop.protocol.wire.spec import LoopSettings, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Transmit
from tests.support.plant_end import Stage

TICKS = 400
FAULTS = (
    "attitude:drop=0.2@0..0.05",
    "attitude:off@0.02..0.3",
    "rate.y:noise=0.05",
    "rate:delay=0.01@0..0.2",
    "rate.z:stuck@0.01..0.05",
    "motor1:stuck@0..0.1",
    "motors:garble=0.1@0..0.1",
    "measurement:drop=0.2@0..0.2",
    "measurement:delay=0.02@0..0.2",
    "command:delay=0.02@0..0.3",
    "command:delay=0.15@0..0.5",
    "command:drop=0.3@0..0.1",
    "command:garble=0.2@0..0.2",
    "command:duplicate=0.5@0..0.2",
    "command:reorder=0.3@0..0.2",
    "command:stuck@0.02..0.06",
)
WIRES = (
    WireSpec(),
    WireSpec(transmit=Transmit(measurement="on_change", command="on_change")),
    WireSpec(counter_bits=12).with_bits("cont/cont"),
    WireSpec(rate=SignalSpec(bits=6, limit=2.0, kind="hysteresis-uniform"), counter_bits=7),
)
PLANT = PlantSettings(wind=WindSettings(blowing=True))


class Mischief:
    """A controller, a network and an operator that do what chance says."""

    def __init__(self, random: Random, wire: WireSpec) -> None:
        self._random, self._wire = random, wire
        self._quiet = random.random() < 0.3  # then only the network misbehaves
        self._invalid = wire.voltage.quantizer().invalid
        self._late = random.choice((0, 1, 3, 60))

    def skip(self) -> int:
        random = self._random
        return random.choice((1, 2, 5, 70)) if random.random() < 0.01 else 0

    def answer(self, stage: Stage, measurement: bytes) -> None:
        """Commands with small voltages, and what a network may make of them."""
        random, command, wires = self._random, self._wire.command, stage.wires
        now = stage.endpoint.ticked
        counter = self._wire.measurement.counter(measurement) or 0
        limit = 1.0 if command.widths[0] is None else 3
        codes = [random.randint(-3, 3) / 3 * limit for _ in command.widths]
        if command.widths[0] is not None:
            codes = [round(code) for code in codes]
        if random.random() < 0.003:
            codes = [self._invalid] * len(codes)
        frame = command.pack(counter, codes)
        if stage.loop.lockstep:
            if measurement == UNCHANGED or (self._wire.transmit.command == "on_change" and random.random() < 0.3):
                frame = UNCHANGED
            if random.random() > 0.002:
                wires.deliver(frame, now)
            return
        chance = random.random()
        if chance < 0.05:
            return
        if chance < 0.1:
            frame = random.choice((UNCHANGED, frame[:-1], frame + b"\0", random.randbytes(len(frame))))
        wires.deliver(frame, now + (random.randint(0, self._late) if chance < 0.5 else 0))
        if chance > 0.9:
            wires.deliver(frame, now + random.randint(1, 4))

    def between(self, stage: Stage) -> None:
        """Claims, and whatever may end a session or disturb it."""
        random, endpoint = self._random, stage.endpoint
        if endpoint.session is None:
            if random.random() < 0.2:
                endpoint.arm()
            if random.random() < 0.2:
                stage.claim(auto_arm=random.random() < 0.7)
        elif random.random() < 0.01 and not self._quiet:
            random.choice(
                (
                    lambda: endpoint.release(endpoint.session or ""),
                    endpoint.stop,
                    lambda: endpoint.lost("c"),
                    lambda: endpoint.expire(TripCause.NODE, "the test says so"),
                )
            )()
        if random.random() < 0.02 and not self._quiet:
            clear = random.random() < 0.3
            count = random.choice((0, 1, 2) if clear else (1, 1, 2))
            stage.endpoint.inject([Fault.parse(random.choice(FAULTS)) for _ in range(count)], clear=clear)


def traced(seed: int) -> tuple[LoopSettings, WireSpec, PlantSettings, list[Batch]]:
    random = Random(seed)
    loop = LoopSettings(lockstep=random.random() < 0.3, realtime="off")
    wire = random.choice(WIRES)
    faults = random.sample(FAULTS, random.choice((0, 0, 1, 3)))
    limits = PLANT.limits.model_copy(update={"max_rate": random.choice((0.02, 20.0, 20.0))})
    plant = PLANT.model_copy(update={"faults": faults, "fault_seed": seed, "limits": limits})
    mischief = Mischief(random, wire)
    skip = mischief.skip
    stage = Stage(loop, wire, plant, between=mischief.between, answer=mischief.answer, skip=skip)
    if random.random() < 0.3:  # as a process before it left it
        stage.endpoint.start_tripped(TripCause.ENVELOPE, "tilted", operator_only=random.random() < 0.5)
    return loop, wire, plant, stage.run(TICKS).batches


def replayed(loop: LoopSettings, wire: WireSpec, plant: PlantSettings, batches: list[Batch]) -> PlantReplayed:
    replay = PlantReplay(loop, wire, plant)
    for batch in batches:
        replay.feed(batch)
    return replay.result()


def undisturbed() -> tuple[LoopSettings, WireSpec, list[Batch]]:
    """A session from the first tick on, every measurement of which is answered at once."""
    loop, wire = LoopSettings(realtime="off"), WireSpec()

    def claim(stage: Stage) -> None:
        if stage.endpoint.session is None and stage.endpoint.ticked < 10:
            stage.claim()

    stage = Stage(loop, wire, PLANT, between=claim, answer=lambda stage, frame: stage.command(frame, (1, -1)))
    return loop, wire, stage.run(600).batches


@settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(seed=st.integers(0, 2**32 - 1))
def test_whatever_happened_the_plant_is_computed_again_without_a_difference(seed: int) -> None:
    loop, wire, plant, batches = traced(seed)
    result = replayed(loop, wire, plant, batches)
    assert result == PlantReplayed(
        ticks=sum(batch.header.rows for batch in batches), differ=0, first_difference=None, stopped=None
    )


def test_such_loops_do_all_there_is_to_do() -> None:
    """Else the test above proves nothing."""
    outcomes: set[int] = set()
    trips: set[int] = set()
    operations: set[str] = set()
    all_trips = {TripCause.COMMAND_TIMEOUT, TripCause.INVALID_COMMAND, TripCause.ENVELOPE, TripCause.SENSORS}
    wanted = set(Outcome), {cause.number for cause in all_trips}, set(get_args(PlantChangeKind))
    for seed in range(60):
        if outcomes >= wanted[0] and trips >= wanted[1] and operations >= wanted[2]:
            break
        for batch in traced(seed)[3]:
            outcomes |= set(batch.columns["outcome"].tolist())
            trips |= set(batch.columns["trip"].tolist())
            operations |= {operation.kind for operation in batch.tail.operations}
    assert (outcomes, trips & wanted[1], operations) == wanted


COLUMNS = ("session_tick", "sent_as", "outcome", "trip", "answered", "measurement", "voltages")


@pytest.mark.parametrize(("row", "bit", "column"), [(97 * i, i, column) for i, column in enumerate(COLUMNS)])
def test_a_row_that_was_changed_is_found(row: int, bit: int, column: str) -> None:
    loop, wire, batches = undisturbed()
    at = next(i for i, b in enumerate(batches) if b.header.first_row <= row < b.header.first_row + b.header.rows)
    batch = batches[at]
    columns = {name: each.copy() for name, each in batch.columns.items()}
    size = columns[column].nbytes // batch.header.rows
    changed = columns[column].view(np.uint8).reshape(batch.header.rows, size)
    changed[row - batch.header.first_row, 0] ^= 1 << bit
    session_tick = int(columns["session_tick"][row - batch.header.first_row])
    batches[at] = batch._replace(columns=columns)
    result = replayed(loop, wire, PLANT, batches)
    assert (result.differ, result.stopped) == (1, None)
    assert result.first_difference is not None
    assert (result.first_difference.field, result.first_difference.session_tick) == (column, session_tick)
    assert result.first_difference.logged != result.first_difference.computed


def test_batches_that_come_again_are_passed_over() -> None:
    loop, wire, plant, batches = traced(3)
    again = [batch for i in range(len(batches)) for batch in batches[max(0, i - 3) : i + 1]]
    assert replayed(loop, wire, plant, again) == replayed(loop, wire, plant, batches)


def test_it_stops_with_the_reason_where_it_cannot_follow() -> None:
    loop, wire, batches = undisturbed()
    with_rows = [i for i, batch in enumerate(batches) if batch.header.rows]
    second, other = with_rows[1], batches[0]._replace(header=batches[0].header._replace(run=1))
    wider = WireSpec().with_bits("10/10")
    stops: tuple[tuple[WireSpec, list[Batch], int, str], ...] = (
        (wire, batches[:second] + batches[second + 1 :], 51, "51 rows are missing after row 50 of the plant"),
        (wire, batches[second:], 0, "the log lacks the plant's first row, so the plant's state is not known"),
        (wire, batches[with_rows[0] :], 0, "tick 1 is in a session whose claim is missing"),
        (wire, [], 0, "the log has no trace of the plant"),
        (wire, [*batches, other], 600, "the plant was started again"),
        (wider, batches, 0, "the rows are not of the wire that the description describes"),
    )
    for its_wire, fed, ticks, reason in stops:
        result = replayed(loop, its_wire, PLANT, fed)
        assert (result.ticks, result.differ, result.stopped) == (ticks, 0, reason)
