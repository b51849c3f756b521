"""Faults of an emulated node on a CAN bus, as the bridge knows them from the node's reports.

A report has no text. The bridge takes it from its own `plant.faults`; a fault of the node that is not there counts,
too, without its text.
"""

from __future__ import annotations

from collections.abc import Sequence

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.faults.schedule import begins, ends
from aeroloop.protocol.messages.models import FaultStatus
from aeroloop.protocol.transport.can_format import FaultPhase, FaultReport, fault_check


def phase_of(fault: FaultStatus, ticked: int) -> tuple[FaultPhase, int]:
    """How far a fault has got at the plant's last tick, and the plant's tick at which that began."""
    if fault.begin_tick is None or ticked < fault.begin_tick:
        return FaultPhase.TO_COME, ticked
    if fault.end_tick is None or ticked < fault.end_tick:
        return FaultPhase.ACTS, fault.begin_tick
    return FaultPhase.OVER, fault.end_tick


class NodeFaults:
    """Faults of node number `node`. `faults` are those of the bridge's configuration."""

    def __init__(self, faults: Sequence[Fault], node: int) -> None:
        self._configured = faults
        self._node = node
        self._found: dict[int, FaultStatus] = {}

    def take(self, report: FaultReport, tick: int) -> str | None:
        """Take a report. `tick` is the bridge's at which the reported phase began.

        Returns:
            Text of an event, if a fault began or ended.
        """
        place, phase = report.place, report.phase
        fault = self._found.get(place)
        if fault is None or phase is FaultPhase.TO_COME:  # new, or the node was started again
            fault = self._unbegun(report)
        fault = self._found[place] = fault.model_copy(update={"changed": report.changed})
        if phase is FaultPhase.ACTS and fault.begin_tick is None:
            self._found[place] = fault.model_copy(update={"begin_tick": max(0, tick)})
            return begins(fault.fault, fault.source)
        if phase is FaultPhase.OVER and fault.begin_tick is not None and fault.end_tick is None:
            self._found[place] = fault.model_copy(update={"end_tick": max(0, tick)})
            return ends(fault.fault, fault.source, fault.changed, fault.effect)
        return None

    def statuses(self) -> list[FaultStatus]:
        """Status of every fault that was reported, on the bridge's ticks."""
        return [self._found[place] for place in sorted(self._found)]

    def _unbegun(self, report: FaultReport) -> FaultStatus:
        text, effect = f"fault {report.place + 1} of node {self._node}, not in the bridge's plant.faults", "changes"
        if report.place < len(self._configured):
            fault = self._configured[report.place]
            if fault_check(str(fault)) == report.check:
                text, effect = str(fault), fault.effect
        return FaultStatus(fault=text, source="configured", begin_tick=None, end_tick=None, changed=0, effect=effect)
