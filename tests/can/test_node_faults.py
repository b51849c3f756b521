"""Faults of an emulated node: what its reports say on the bus, and what the bridge makes of them."""

from __future__ import annotations

from math import inf
from threading import Event

import pytest

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.faults.node_faults import NodeFaults
from aeroloop.plant_emulator.hosts.can_node import CanFront
from aeroloop.plant_emulator.hosts.emulator import Emulator
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Claim
from aeroloop.protocol.transport.can_format import FAULT_REPORT_ID, FaultPhase, FaultReport, fault_check
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.can_in_process import Stranger, virtual

WIRE = WireSpec()
LOOP = LoopSettings(realtime="off")
MANY = [*(["rate:bias=0.1@0.2..0.3"] * 3), "command:drop=1@0.4..0.42"]


class Node:
    """An emulated node whose loop turns as fast as the test goes, in a session from its first tick on."""

    def __init__(self, faults: list[str]) -> None:
        settings = virtual()
        self.emulator = Emulator(LOOP, WIRE, PlantSettings(faults=faults, watchdog_s=10), Event())
        self.front = CanFront(settings, LOOP, self.emulator.endpoint, self.emulator.fault_statuses)
        self.bus = Stranger(settings)
        self.emulator.endpoint.claim(
            Claim(controller="a", session="s", period_ns=LOOP.period_ns, lockstep=False, auto_arm=True, wire=WIRE)
        )

    def turn(self, k: int) -> None:
        """Tick k; the command that answers tick k − 1 comes before it."""
        arrived = self.emulator._incoming(WIRE.command.pack((k - 1) % 256, (1, -1)) if k else None)
        self.front.after_tick(self.emulator.tick(arrived, k), None, 0)

    def reports(self) -> list[FaultReport]:
        """Those on the bus since the last call."""
        found = [FaultReport.unpack(bytes(one.data)) for one in self.bus.everything() if one.arbitration_id == 0x401]
        assert None not in found
        return [report for report in found if report is not None]

    def close(self) -> None:
        """Leave the bus."""
        self.front.leave()
        self.bus.__exit__(None, None, None)


def test_the_node_reports_each_begin_and_end_at_its_tick_one_a_tick_and_counts_in_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("aeroloop.plant_emulator.hosts.can_node.HEARTBEAT_S", inf)  # the test sends them
    node = Node(MANY)
    try:
        faults = NodeFaults([Fault.parse(text) for text in MANY], 1)
        turned: dict[tuple[int, FaultPhase], int] = {}
        for k in range(500):
            if beats := k % 50 == 1:
                node.front.publish_status()
            node.turn(k)
            reports = node.reports()
            assert k == 0 or beats <= len(reports) <= beats + 1
            for report in reports:
                turned.setdefault((report.place, report.phase), report.tick)
                assert report.check == fault_check(MANY[report.place])
                faults.take(report, report.tick)
        begins = {(i, FaultPhase.ACTS): 100 for i in range(3)} | {(3, FaultPhase.ACTS): 200}
        ends = {(i, FaultPhase.OVER): 150 for i in range(3)} | {(3, FaultPhase.OVER): 210}
        assert {key: tick for key, tick in turned.items() if key[1] is not FaultPhase.TO_COME} == begins | ends
        published = [(one.fault, one.begin_tick, one.end_tick, one.changed) for one in faults.statuses()]
        its_own = [(one.fault, one.begin_tick, one.end_tick, one.changed) for one in node.emulator.fault_statuses()]
        assert published == its_own
        assert [changed for *_, changed in published] == [50, 50, 50, 10]
    finally:
        node.close()


def test_a_node_without_faults_sends_no_report() -> None:
    node = Node([])
    try:
        for k in range(10):
            node.turn(k)
            node.front.publish_status()
        assert all(message.arbitration_id != FAULT_REPORT_ID + 1 for message in node.bus.everything())
    finally:
        node.close()


def test_a_node_that_was_started_again_has_its_faults_before_it_again() -> None:
    faults = NodeFaults([Fault.parse("rate:off@1..2")], 1)
    check = fault_check("rate:off@1..2")
    said = [
        faults.take(FaultReport(0, phase, 0, check, changed), tick)
        for phase, changed, tick in (
            (FaultPhase.ACTS, 7, 500),
            (FaultPhase.ACTS, 9, 501),
            (FaultPhase.TO_COME, 0, 900),
            (FaultPhase.ACTS, 1, 1400),
            (FaultPhase.OVER, 500, 1900),
            (FaultPhase.OVER, 500, 2000),
        )
    ]
    assert [text.split(" (")[0] if text else None for text in said] == [
        "fault begins", None, None, "fault begins", "fault ends", None,
    ]  # fmt: skip
    (fault,) = faults.statuses()
    assert (fault.begin_tick, fault.end_tick, fault.changed) == (1400, 1900, 500)


@pytest.mark.parametrize("data", [b"", bytes(7), bytes(9), b"\3" + bytes(7)])
def test_a_malformed_report_is_none(data: bytes) -> None:
    assert FaultReport.unpack(data) is None
