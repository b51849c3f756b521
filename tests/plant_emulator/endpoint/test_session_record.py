"""The record of the last session, which the plant keeps for the next controller; and repeated stops."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.vehicle_claim import VehicleClaim
from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.protocol.messages.models import Grant, SessionRecord
from aeroloop.protocol.messages.operator import Gains, Hold
from aeroloop.protocol.messages.states import TripCause
from tests.support.plant_end import PERIOD_NS, WIRE, RecordingPlant, claim_of

GAINS = Gains(C1=(0.5, 0.5, 0.5), C2=(0.4, 0.4, 0.4), Gamma=(0.1, 0.1, 0.1))


def record(name: str, yaw: float = 30.0) -> SessionRecord:
    """What a controller hands over."""
    return SessionRecord(
        controller=name, session=f"of-{name}", gains=GAINS, gains_from="operator",
        reference=Hold(attitude=(0.0, 0.0, yaw)), reference_from="operator", within_s=2.0, since_tick=0,
    )  # fmt: skip


def last_granted(end: VehicleClaim, name: str) -> SessionRecord | None:
    """The record that a claim is granted with."""
    answer = end.claim(claim_of(name))
    assert isinstance(answer, Grant)
    return answer.last


@pytest.fixture(params=["endpoint", "bridge"])
def end(request: pytest.FixtureRequest) -> VehicleClaim:
    """Both ends that grant claims, armed."""
    if request.param == "endpoint":
        return Endpoint(RecordingPlant(), WIRE, PERIOD_NS, armed=True)
    return Relay(WIRE, PERIOD_NS, lockstep=False, watchdog_s=0.1, armed=True)


def lost_and_stopped(end: VehicleClaim) -> None:
    """A later stop replaces how it ended."""
    end.lost("a")
    end.stop()


ENDINGS: list[tuple[Callable[[VehicleClaim], object], TripCause | str]] = [
    (lambda end: end.release("of-a"), "released"),
    (lambda end: end.lost("a"), TripCause.HOLDER_GONE),
    (lambda end: end.expire(TripCause.NO_ANSWER, "no answer"), TripCause.NO_ANSWER),
    (lambda end: end.stop(), TripCause.OPERATOR),
    (lost_and_stopped, TripCause.OPERATOR),
]


@pytest.mark.parametrize(("ends", "how"), ENDINGS)
def test_the_next_controller_gets_the_last_record_and_how_its_session_ended(
    end: VehicleClaim, ends: Callable[[VehicleClaim], object], how: TripCause | str
) -> None:
    assert not end.keep(record("a"))  # no session
    assert last_granted(end, "a") is None
    changes = list(end.changes)
    assert end.keep(record("a"))
    assert not end.keep(record("b"))  # of another controller, of another session
    assert not end.keep(record("a").model_copy(update={"session": "of-b"}))
    assert end.keep(record("a", yaw=50.0))  # the newest counts
    assert end.changes == changes  # it is no change of the trace
    ends(end)
    assert not end.keep(record("a"))
    end.arm()
    assert last_granted(end, "b") == record("a", yaw=50.0).model_copy(update={"ended": how})
    end.release("of-b")
    assert last_granted(end, "c") is None  # a session without a record leaves none


def test_two_plants_of_one_name_are_a_trip_even_after_an_operators_stop(end: VehicleClaim) -> None:
    end.stop()
    end.stop(TripCause.DUPLICATE, "two plants")
    end.stop()
    assert (end.trip, [notice.kind for notice in end.notices]) == (TripCause.DUPLICATE, ["tripped", "tripped"])
