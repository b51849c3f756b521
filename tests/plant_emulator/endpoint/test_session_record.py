"""The record of the last session, which the plant keeps for the next controller."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.vehicle_claim import VehicleClaim
from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Claim, Grant, Refusal, SessionRecord
from aeroloop.protocol.messages.operator import Gains, Hold
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.wire.spec import WireSpec

WIRE = WireSpec()
PERIOD_NS = 2_000_000
GAINS = Gains(C1=(0.5, 0.5, 0.5), C2=(0.4, 0.4, 0.4), Gamma=(0.1, 0.1, 0.1))


def endpoint() -> Endpoint:
    """An armed plant end."""
    plant: EmulatedPlant = PlantSettings().build(PERIOD_NS * 1e-9)
    return Endpoint(plant, WIRE, PERIOD_NS, armed=True)


def relay() -> Relay:
    """An armed bridge."""
    return Relay(WIRE, PERIOD_NS, lockstep=False, watchdog_s=0.1, armed=True)


def claim(end: VehicleClaim, name: str) -> Grant | Refusal:
    """A controller claims."""
    return end.claim(
        Claim(controller=name, session=f"of-{name}", period_ns=PERIOD_NS, lockstep=False, auto_arm=True, wire=WIRE)
    )


def record(name: str, yaw: float = 30.0) -> SessionRecord:
    """What it hands over."""
    return SessionRecord(
        controller=name, session=f"of-{name}", gains=GAINS, gains_from="operator",
        reference=Hold(attitude=(0.0, 0.0, yaw)), reference_from="operator", within_s=2.0, since_tick=0,
    )  # fmt: skip


def granted(answer: Grant | Refusal) -> SessionRecord | None:
    """The record that a grant has."""
    assert isinstance(answer, Grant)
    return answer.last


@pytest.fixture(params=[endpoint, relay], ids=["endpoint", "bridge"])
def end(request: pytest.FixtureRequest) -> VehicleClaim:
    """Both ends that grant claims."""
    made: Callable[[], VehicleClaim] = request.param
    return made()


ENDINGS: list[tuple[Callable[[VehicleClaim], object], TripCause | str]] = [
    (lambda end: end.release("of-a"), "released"),
    (lambda end: end.lost("a"), TripCause.HOLDER_GONE),
    (lambda end: end.expire(TripCause.NO_ANSWER, "no answer"), TripCause.NO_ANSWER),
    (lambda end: end.stop(), TripCause.OPERATOR),
]


@pytest.mark.parametrize(("ends", "how"), ENDINGS, ids=[str(how) for _, how in ENDINGS])
def test_the_next_controller_gets_the_last_record_and_how_its_session_ended(
    end: VehicleClaim, ends: Callable[[VehicleClaim], object], how: TripCause | str
) -> None:
    assert granted(claim(end, "a")) is None
    assert end.keep(record("a"))
    assert end.keep(record("a", yaw=50.0))  # the newest counts
    ends(end)
    end.arm()
    assert granted(claim(end, "b")) == record("a", yaw=50.0).model_copy(update={"ended": how})


def test_the_record_names_the_sessions_last_tick() -> None:
    end = endpoint()
    claim(end, "a")
    for k in range(5):
        end.tick(None, k)
    end.keep(record("a"))
    end.lost("a")
    assert end.last is not None
    assert end.last.ended_tick == end.session_tick == 4


def test_an_operators_stop_after_the_session_replaces_how_it_ended(end: VehicleClaim) -> None:
    claim(end, "a")
    end.keep(record("a"))
    end.lost("a")
    end.stop()
    end.arm()
    last = granted(claim(end, "b"))
    assert last is not None
    assert last.ended is TripCause.OPERATOR


@pytest.mark.parametrize(
    ("trips", "events", "cause"),
    [
        (lambda end: end.stop(), ["tripped"], "stopped by an operator: 0 V"),
        (lambda end: end.lost("a"), ["tripped", "changed"], "a is gone: 0 V; then stopped by an operator"),
    ],
)
def test_a_repeated_stop_is_no_second_trip_and_the_first_cause_stays(
    end: VehicleClaim, trips: Callable[[VehicleClaim], object], events: list[str], cause: str
) -> None:
    claim(end, "a")
    end.notices.clear()
    trips(end)
    trip = end.trip
    for _ in range(3):
        end.stop()
    assert [notice.kind for notice in end.notices] == events
    assert (end.trip, end.cause) == (trip, cause)


def test_two_plants_of_one_name_are_a_trip_even_after_an_operators_stop(end: VehicleClaim) -> None:
    end.stop()
    end.stop(TripCause.DUPLICATE, "two plants")
    end.stop()
    assert (end.trip, [notice.kind for notice in end.notices]) == (TripCause.DUPLICATE, ["tripped", "tripped"])


def test_a_session_without_a_record_leaves_none(end: VehicleClaim) -> None:
    claim(end, "a")
    end.keep(record("a"))
    end.lost("a")
    claim(end, "b")
    end.lost("b")
    assert granted(claim(end, "c")) is None


def test_only_the_controller_that_has_the_plant_leaves_a_record(end: VehicleClaim) -> None:
    assert not end.keep(record("a"))
    claim(end, "a")
    assert not end.keep(record("b"))
    assert not end.keep(record("a").model_copy(update={"session": "of-b"}))
    end.lost("a")
    assert not end.keep(record("a"))
    assert end.last is None


def test_keeping_a_record_is_no_operation_of_the_trace(end: VehicleClaim) -> None:
    claim(end, "a")
    before = list(end.changes)
    end.keep(record("a"))
    assert end.changes == before
