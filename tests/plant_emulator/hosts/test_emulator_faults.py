"""Faults of an emulator's loop in simulated time: one to come changes nothing, and each begin, end and frame counts."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Notice
from aeroloop.plant_emulator.faults.injection import MAX_FAULTS
from aeroloop.plant_emulator.faults.language import KINDS, SIGNALS
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from tests.support.plant_stage import Stage

WIRE = WireSpec()
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
