"""State tables of both ends, SPEC.md, sections 5 and 6."""

from __future__ import annotations

import pytest

from aeroloop.protocol.messages.states import (
    CONTROLLER_TABLE,
    PLANT_TABLE,
    ControllerState,
    ControllerTrigger,
    Machine,
    PlantState,
    PlantTrigger,
)


def reached(start: ControllerState, without: ControllerTrigger | None = None) -> set[ControllerState]:
    """Every state of a controller that can be reached, the first included, without one of the triggers."""
    found, fresh = {start}, {start}
    while fresh:
        edges = CONTROLLER_TABLE.items()
        fresh = {after for (state, trigger), after in edges if state in fresh and trigger is not without} - found
        found |= fresh
    return found


def test_any_plant_can_be_tripped_only_arming_clears_it_and_only_a_granted_one_is_driven() -> None:
    edges = PLANT_TABLE.items()
    assert {state for (state, trigger), after in edges if trigger is PlantTrigger.TRIP} == set(PlantState)
    assert {after for (_, trigger), after in edges if trigger is PlantTrigger.TRIP} == {PlantState.TRIPPED}
    out = {trigger for (state, trigger), after in edges if state is PlantState.TRIPPED is not after}
    assert out == {PlantTrigger.ARM}
    into = {goal: {edge for edge, after in edges if after is goal} for goal in (PlantState.GRANTED, PlantState.DRIVEN)}
    assert into == {
        PlantState.GRANTED: {(PlantState.IDLE, PlantTrigger.GRANT)},
        PlantState.DRIVEN: {(state, PlantTrigger.COMMAND) for state in (PlantState.GRANTED, PlantState.DRIVEN)},
    }


def test_a_controller_stands_down_from_any_state_and_has_a_vehicle_only_by_a_grant() -> None:
    aside = {ControllerState.HOLDING, ControllerState.FAULTED}
    driving = {ControllerState.CLAIMED, ControllerState.READY, ControllerState.RUNNING}
    for state in ControllerState:
        assert CONTROLLER_TABLE[state, ControllerTrigger.STAND_DOWN] is ControllerState.HOLDING
        assert reached(state) == set(ControllerState)  # none is without a way back
    for state in aside:
        assert reached(state, without=ControllerTrigger.RECALL) <= aside
        assert CONTROLLER_TABLE[state, ControllerTrigger.RECALL] is ControllerState.SEARCHING
    assert not reached(ControllerState.SEARCHING, without=ControllerTrigger.GRANT) & driving


def test_a_trigger_that_the_table_does_not_have_is_refused_and_changes_nothing() -> None:
    machine = Machine(PlantState.IDLE, PLANT_TABLE)
    with pytest.raises(KeyError, match=r"idle.*command"):
        machine.fire(PlantTrigger.COMMAND)
    assert machine.state is PlantState.IDLE
