"""State machines of the plant end and the controller: states, triggers, and one transition table each.

A state is what an end does; a trigger is what happens to it. SPEC.md has both tables, too; the tests compare them.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Final, Generic, TypeVar

RECORDING: Final = "recording"  # state of a recorder that can write
NOT_RECORDING: Final = "not recording"  # state of a recorder that cannot write
STOPPED: Final = "stopped"  # state of a recorder in its last status, when it ends in order


class PlantState(StrEnum):
    """What the plant end is doing."""

    IDLE = "idle"
    GRANTED = "granted"
    DRIVEN = "driven"
    TRIPPED = "tripped"


class PlantTrigger(StrEnum):
    """What happens to a plant end."""

    GRANT = "claim granted"
    COMMAND = "fresh command"
    RELEASE = "release"
    TRIP = "trip"
    ARM = "arm"


class TripCause(StrEnum):
    """Why a plant end trips. In traces and on a CAN bus a cause is its number."""

    COMMAND_TIMEOUT = "no command in time"
    INVALID_COMMAND = "invalid command"
    ENVELOPE = "attitude or rate envelope"
    SATURATION = "voltage saturation"
    SENSORS = "no valid measurement"
    OPERATOR = "operator's stop"
    HOLDER_GONE = "controller gone"
    NO_ANSWER = "no answer in lockstep"
    BUS = "bus lost"
    NODE = "node lost"
    DUPLICATE = "another plant of this name"
    PLANT = "plant failed"

    @property
    def number(self) -> int:
        """Its place in this list, from 1."""
        return list(TripCause).index(self) + 1


class ControllerState(StrEnum):
    """What the controller is doing."""

    SEARCHING = "searching"
    CLAIMED = "claimed"
    READY = "ready"
    RUNNING = "running"
    HOLDING = "holding"
    FAULTED = "faulted"


class ControllerTrigger(StrEnum):
    """What happens to a controller."""

    GRANT = "claim granted"
    INVALID = "measurement without a valid value"
    ANSWERED = "valid measurement answered"
    LOST = "session lost"
    STAND_DOWN = "released or stopped by an operator"
    FAULT = "law gives no number"
    RECALL = "recalled"


_P, _PT = PlantState, PlantTrigger
_C, _CT = ControllerState, ControllerTrigger

# fmt: off
PLANT_TABLE: Final[Mapping[tuple[PlantState, PlantTrigger], PlantState]] = {
    (_P.IDLE,    _PT.GRANT):   _P.GRANTED,
    (_P.IDLE,    _PT.TRIP):    _P.TRIPPED,
    (_P.IDLE,    _PT.ARM):     _P.IDLE,
    (_P.GRANTED, _PT.COMMAND): _P.DRIVEN,
    (_P.GRANTED, _PT.RELEASE): _P.IDLE,
    (_P.GRANTED, _PT.TRIP):    _P.TRIPPED,
    (_P.DRIVEN,  _PT.COMMAND): _P.DRIVEN,
    (_P.DRIVEN,  _PT.RELEASE): _P.IDLE,
    (_P.DRIVEN,  _PT.TRIP):    _P.TRIPPED,
    (_P.TRIPPED, _PT.TRIP):    _P.TRIPPED,
    (_P.TRIPPED, _PT.ARM):     _P.IDLE,
}
"""Plant end. A claim with `auto_arm` first arms, and is then granted."""

CONTROLLER_TABLE: Final[Mapping[tuple[ControllerState, ControllerTrigger], ControllerState]] = {
    (_C.SEARCHING, _CT.GRANT):      _C.CLAIMED,
    (_C.SEARCHING, _CT.STAND_DOWN): _C.HOLDING,
    (_C.CLAIMED,   _CT.INVALID):    _C.READY,
    (_C.CLAIMED,   _CT.ANSWERED):   _C.RUNNING,
    (_C.CLAIMED,   _CT.LOST):       _C.SEARCHING,
    (_C.CLAIMED,   _CT.FAULT):      _C.FAULTED,
    (_C.CLAIMED,   _CT.STAND_DOWN): _C.HOLDING,
    (_C.READY,     _CT.INVALID):    _C.READY,
    (_C.READY,     _CT.ANSWERED):   _C.RUNNING,
    (_C.READY,     _CT.LOST):       _C.SEARCHING,
    (_C.READY,     _CT.FAULT):      _C.FAULTED,
    (_C.READY,     _CT.STAND_DOWN): _C.HOLDING,
    (_C.RUNNING,   _CT.ANSWERED):   _C.RUNNING,
    (_C.RUNNING,   _CT.INVALID):    _C.READY,
    (_C.RUNNING,   _CT.LOST):       _C.SEARCHING,
    (_C.RUNNING,   _CT.FAULT):      _C.FAULTED,
    (_C.RUNNING,   _CT.STAND_DOWN): _C.HOLDING,
    (_C.HOLDING,   _CT.STAND_DOWN): _C.HOLDING,
    (_C.HOLDING,   _CT.RECALL):     _C.SEARCHING,
    (_C.FAULTED,   _CT.STAND_DOWN): _C.HOLDING,
    (_C.FAULTED,   _CT.RECALL):     _C.SEARCHING,
}
"""Controller. Ready: it has a session but no valid measurement, and commands "no valid value". Holding and faulted: it
has no session and claims none until it is recalled."""
# fmt: on

State = TypeVar("State", bound=StrEnum)
Trigger = TypeVar("Trigger", bound=StrEnum)


class Machine(Generic[State, Trigger]):
    """A state and its transition table, from state and trigger to the next state."""

    def __init__(self, start: State, table: Mapping[tuple[State, Trigger], State]) -> None:
        self.state = start
        self._table = table

    def fire(self, trigger: Trigger) -> State:
        """Apply a trigger and return the next state. Raises KeyError if the table has no such transition."""
        self.state = self._table[self.state, trigger]
        return self.state
