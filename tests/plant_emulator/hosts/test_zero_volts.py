"""0 V comes first: whatever ends a session, the motors are off before anybody hears of it, in lockstep and without.

A machine, Quanser's board and the network's side write into one journal, so that their order can be read.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.plant_emulator.hosts.quanser_board import QuanserPlant
from aeroloop.plant_emulator.plant import PlantError
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Grant, Refusal
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import PlantChange
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.spec import LoopSettings
from tests.support.fake_quanser import FakeQuanser, modules
from tests.support.plant_end import OFF, PERIOD_NS, WIRE, RecordingPlant, Stage, claim_of, claimed, command

TICKS = 40
ENDS_AT = 20
"""Tick at which a session ends; it is driven long before."""
LINK_LOST = "the link is closed"


class Machine(RecordingPlant):
    """A plant with a power stage that writes what is done to it; `refuses` are the calls that it fails."""

    def __init__(self, journal: list[str]) -> None:
        super().__init__()
        self.journal = journal
        self.refuses: set[str] = set()

    def actuate(self, voltages: Sequence[float]) -> None:
        self._do("volts" if any(voltages) else "0 V")
        super().actuate(voltages)

    def enable(self, on: bool) -> None:
        self._do("on" if on else "off")

    def close(self) -> None:
        self.journal.append("close")
        super().close()

    def _do(self, call: str) -> None:
        if call in self.refuses:
            raise PlantError(f"Machine failed in {call}")
        self.journal.append(call)


class Theatre(Stage):
    """A driver's loop whose network writes each notice into the journal when it would publish, log and keep it."""

    def __init__(self, made: Any, journal: list[str], *, lockstep: bool, between: Callable[[Stage], object]) -> None:
        self.journal = journal
        self.turns = 0
        self.on_send: Callable[[], None] = lambda: None
        self.unanswered: Callable[[], bool] = lambda: False
        self._at_its_end = between

        def answer(stage: Stage, frame: bytes) -> None:
            self.on_send()
            if not self.unanswered():
                stage.command(frame, (9, -9))

        loop = LoopSettings(realtime="off", lockstep=lockstep)
        super().__init__(loop, WIRE, PlantSettings(), between=self._turn, answer=answer, made=made)

    def _turn(self, stage: Stage) -> None:
        self.turns += 1
        if self.turns > 10 * TICKS:  # in lockstep no tick follows the end of a session
            self.stop.set()
        if self.endpoint.session is None and not self.endpoint.changes and self.endpoint.ticked <= 0:
            self.claim()
        if self.endpoint.ticked == ENDS_AT and self.endpoint.session is not None:
            self._at_its_end(stage)

    def follow_session(self) -> None:
        for notice in self.endpoint.notices:
            self.journal.append(notice.kind)
        self.endpoint.notices.clear()
        super().follow_session()


def raises(_: Stage) -> None:
    raise RuntimeError("nobody foresaw this")


def loses_its_link(stage: Stage) -> None:
    assert isinstance(stage, Theatre)

    def on_send() -> None:
        raise OSError(LINK_LOST)

    stage.on_send = on_send


ENDS: dict[str, Callable[[Stage], object]] = {
    "stop": lambda stage: stage.endpoint.stop(),
    "release": lambda stage: stage.endpoint.release("s1"),
    "lost holder": lambda stage: stage.endpoint.lost("c"),
    "trip": lambda stage: stage.endpoint.expire(TripCause.ENVELOPE, "tilted"),
    "duplicate plant": lambda stage: stage.endpoint.stop(TripCause.DUPLICATE, "two plants"),
    "SIGTERM": lambda stage: stage.stop.set(),
    "exception": raises,
    "exception in a send": loses_its_link,
}


def run_to_its_end(stage: Theatre) -> None:
    try:
        stage.run(TICKS)
    except (RuntimeError, OSError) as error:
        stage.journal.append(f"raised {type(error).__name__}")


def operations(stage: Stage) -> list[PlantChange]:
    return [change for batch in stage.batches for change in batch.tail.operations]


def before_it_was_told(journal: list[str]) -> list[str]:
    """The journal until somebody hears that the session has ended."""
    told = [i for i, entry in enumerate(journal) if entry in ("tripped", "released")]
    assert told
    return journal[: told[0]]


def last_of(journal: list[str], *entries: str) -> str:
    return [entry for entry in journal if entry in entries][-1]


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("end", list(ENDS))
def test_a_machine_has_0_v_and_no_power_before_anybody_hears_that_a_session_ended(end: str, lockstep: bool) -> None:
    journal: list[str] = []
    stage = Theatre(Machine(journal), journal, lockstep=lockstep, between=ENDS[end])
    run_to_its_end(stage)
    before = before_it_was_told(journal)
    assert "volts" in before
    assert last_of(before, "volts", "0 V") == "0 V"
    assert last_of(before, "on", "off") == "off"
    after = journal[len(before) :]
    assert not {"volts", "on"} & {*after}
    assert journal.count("close") == 1


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("end", list(ENDS))
def test_quansers_board_has_0_v_and_its_amplifier_off_before_anybody_hears_of_it(end: str, lockstep: bool) -> None:
    board = FakeQuanser(PlantSettings(), PERIOD_NS * 1e-9)
    outputs: list[tuple[list[float], list[int]]] = []

    class Watched(list[str]):
        def append(self, entry: str) -> None:
            if entry in ("tripped", "released"):
                outputs.append((list(board.analog), list(board.enabled)))
            super().append(entry)

    with patch.dict(sys.modules, modules(board)):
        settings = PlantSettings(via="quanser")
        plant = QuanserPlant(settings.quanser, PERIOD_NS * 1e-9, settings.watchdog_s)
        driven: list[tuple[float, ...]] = []

        def between(stage: Stage) -> object:
            driven.append(board.motor_voltages)
            return ENDS[end](stage)

        run_to_its_end(Theatre(plant, Watched(), lockstep=lockstep, between=between))
    assert any(driven[0])
    assert outputs[0] == ([0.0, 0.0], [0, 0])


# ── a machine that refuses 0 V has failed, and is closed ──


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("refused", ["0 V", "off"])
@pytest.mark.parametrize("end", ["stop", "release", "lost holder", "trip", "SIGTERM", "exception"])
def test_a_machine_that_refuses_0_v_or_its_power_stage_is_closed_at_once_and_trips_latched(
    end: str, refused: str, lockstep: bool
) -> None:
    journal: list[str] = []
    machine = Machine(journal)

    def between(stage: Stage) -> object:
        machine.refuses = {refused}
        return ENDS[end](stage)

    stage = Theatre(machine, journal, lockstep=lockstep, between=between)
    with pytest.raises(RuntimeError if end == "exception" else PlantError):
        stage.run(TICKS)
    before = before_it_was_told(journal)
    assert "close" in before
    assert last_of(before, "off" if refused == "0 V" else "0 V")  # the other is tried all the same
    after_close = journal[journal.index("close") :]
    assert not {"volts", "0 V", "on", "off"} & {*after_close}  # a closed machine is left alone
    endpoint = stage.endpoint
    assert (endpoint.state, endpoint.trip) == (PlantState.TRIPPED, TripCause.PLANT)
    assert endpoint.trips[TripCause.PLANT] == 1
    assert isinstance(stage.claim(), Refusal)  # auto_arm does not clear it
    wanted = "nobody foresaw this" if end == "exception" else f"Machine failed in {refused}"
    assert wanted in str(endpoint.cause)


def test_a_tick_after_such_a_failure_raises_it_and_does_not_touch_the_machine() -> None:
    journal: list[str] = []
    machine = Machine(journal)
    endpoint = Endpoint(machine, WIRE, PERIOD_NS)
    assert isinstance(endpoint.claim(claim_of()), Grant)
    endpoint.tick(None, 0)
    endpoint.tick(command(0), 1)
    machine.refuses = {"0 V"}
    endpoint.stop()
    journal.clear()
    with pytest.raises(PlantError, match="Machine failed in 0 V"):
        endpoint.tick(None, 2)
    assert journal == []


def test_the_power_is_off_in_the_tick_that_trips() -> None:
    """By the watchdog, a limit or a command without a value: not only at the next tick."""
    journal: list[str] = []
    endpoint = Endpoint(Machine(journal), WIRE, PERIOD_NS)
    assert isinstance(endpoint.claim(claim_of()), Grant)
    endpoint.tick(None, 0)
    endpoint.tick(command(0), 1)
    no_value = WIRE.voltage.quantizer().invalid
    assert endpoint.tick(WIRE.command.pack(1, (no_value, no_value)), 2) is None
    assert endpoint.trip is TripCause.INVALID_COMMAND
    assert (last_of(journal, "on", "off"), last_of(journal, "volts", "0 V")) == ("off", "0 V")


# ── an exception that nobody foresaw ──


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize(
    ("end", "text"),
    [
        ("exception", "unexpected RuntimeError: nobody foresaw this (test_zero_volts.py, line "),
        ("exception in a send", f"unexpected OSError: {LINK_LOST} (test_zero_volts.py, line "),
    ],
)
def test_an_exception_is_a_trip_with_its_text_which_only_an_operator_clears(
    end: str, text: str, lockstep: bool
) -> None:
    journal: list[str] = []
    stage = Theatre(Machine(journal), journal, lockstep=lockstep, between=ENDS[end])
    run_to_its_end(stage)
    assert journal[-1].startswith("raised ")
    assert journal.count("tripped") == 1
    endpoint = stage.endpoint
    assert (endpoint.trip, endpoint.operator_only) == (TripCause.PLANT, True)
    assert str(endpoint.cause).startswith(text)
    assert isinstance(stage.claim(), Refusal)


def test_a_network_that_cannot_be_served_closes_the_machine_and_trips(monkeypatch: pytest.MonkeyPatch) -> None:
    def serve(stage: Stage) -> None:
        raise OSError(f"{stage.loop.rate_hz:g} Hz and no network")

    monkeypatch.setattr(Stage, "serve", serve)
    journal: list[str] = []
    stage = Theatre(Machine(journal), journal, lockstep=False, between=lambda _: None)
    with pytest.raises(OSError, match="and no network"):
        stage.run(TICKS)
    assert journal == ["0 V", "off", "close", "tripped"]


def test_a_signal_ends_a_session_in_order_and_latches_nothing() -> None:
    journal: list[str] = []
    stage = Theatre(Machine(journal), journal, lockstep=False, between=ENDS["SIGTERM"])
    stage.run(TICKS)
    assert [entry for entry in journal if entry in ("tripped", "released")] == ["released"]
    assert (stage.endpoint.state, stage.endpoint.cause) == (PlantState.IDLE, None)
    assert [change.kind for change in operations(stage)] == ["claim", "release"]


# ── lockstep: a session that begins while an answer is waited for ──


def test_an_answer_to_a_session_that_has_ended_is_not_waited_for_in_the_next() -> None:
    """Else the next session would trip, without an answer to a measurement that was never sent in it."""

    def hand_over(stage: Stage) -> None:
        if stage.endpoint.session == "s1":
            stage.endpoint.release("s1")
            assert isinstance(stage.claim(), Grant)

    journal: list[str] = []
    stage = Theatre(Machine(journal), journal, lockstep=True, between=hand_over)
    stage.unanswered = lambda: stage.endpoint.session == "s1" and stage.endpoint.ticked == ENDS_AT
    stage.run(TICKS)
    assert [change.name for change in operations(stage) if change.kind == "release"] == ["s1", "s2"]
    assert "tripped" not in journal
    assert stage.endpoint.trip is None


def test_in_lockstep_only_the_command_that_answers_the_measurement_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stray command with another echo is passed over, though it comes first."""
    journal: list[str] = []
    stage = Theatre(Machine(journal), journal, lockstep=True, between=lambda _: None)
    arrivals: list[bytes] = []

    def answer(frame: bytes) -> None:
        echo = WIRE.measurement.counter(frame)
        assert echo is not None
        arrivals.extend([command(echo + 1, 31), command(echo, 9)])

    def wait(_: float) -> Arrival | None:
        return Arrival(arrivals.pop(0), stage.clock.monotonic_ns()) if arrivals else None

    stage.wires.answer = answer
    monkeypatch.setattr(stage.wires, "wait", wait)
    stage.run(TICKS, answer_timeout_s=1.0)
    rows = [tuple(row) for batch in stage.batches for row in batch.columns["voltages"].tolist()]
    level = WIRE.voltage.quantizer().level
    assert {*rows[1:]} == {(level(9), level(-9))}


# ── the relay of a CAN bridge sends the node the end of its session first ──


@pytest.mark.parametrize(
    "end",
    [
        lambda relay: relay.stop(),
        lambda relay: relay.release("of-a"),
        lambda relay: relay.lost("a"),
        lambda relay: relay.expire(TripCause.BUS, "no bus"),
        lambda relay: relay.fail(RuntimeError("no idea")),
        lambda relay: relay.leave(),
        lambda relay: relay.watch(10**12),
    ],
)
def test_the_relay_releases_the_node_before_there_is_anything_to_publish(end: Callable[[Relay], object]) -> None:
    relay = Relay(WIRE, PERIOD_NS, lockstep=False, watchdog_s=0.1, armed=True)
    released: list[list[str]] = []
    relay.release_node = lambda: released.append([notice.kind for notice in relay.notices])
    assert isinstance(relay.claim(claim_of()), Grant)
    relay.watch(0)
    end(relay)
    assert released == [["claimed"]]
    assert relay.session is None


def test_a_relay_that_cannot_release_its_node_trips() -> None:
    relay = Relay(WIRE, PERIOD_NS, lockstep=False, watchdog_s=0.1, armed=True)

    def release_node() -> None:
        raise OSError("no such device")

    relay.release_node = release_node
    assert isinstance(relay.claim(claim_of()), Grant)
    assert relay.release("of-a")
    assert (relay.trip, relay.operator_only) == (TripCause.PLANT, True)
    assert "no such device" in str(relay.cause)
    with pytest.raises(OSError, match="no such device"):
        relay.raise_failure()


def test_0_v_goes_past_the_injected_faults_of_motors() -> None:
    endpoint, plant = claimed()
    endpoint.inject(PlantSettings(faults=["motors:bias=3"]).parsed_faults)
    endpoint.tick(command(0), 1)
    assert plant.voltages != OFF
    endpoint.stop()
    assert plant.voltages == OFF
