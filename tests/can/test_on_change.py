"""On-change policy on a CAN bus: an empty frame for a silent tick in lockstep, no frame in real time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.can_node import CanNetwork
from aeroloop.protocol.transport.can_format import COMMAND_ID, MEASUREMENT_ID
from aeroloop.protocol.transport.can_link import CanLink
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy
from aeroloop.service.lab.experiment import run_experiment
from tests.support.can_closed_loop import lockstep_settings, run_on_bus
from tests.support.can_in_process import Stranger, virtual
from tests.support.can_stage import measurement
from tests.support.plant_end import PERIOD_NS, RecordingPlant
from tests.support.simulated_link import wire_of

POLICIES: list[tuple[Policy, Policy]] = [
    ("on_change", "on_change"),
    ("on_change", "periodic"),
    ("periodic", "on_change"),
]


BOTH = wire_of("on_change", "on_change")


@pytest.mark.parametrize(
    ("wire", "fd"),
    [
        (WireSpec(), False),
        (WireSpec().with_bits("12/16"), True),
        *((wire_of(*policies), False) for policies in POLICIES),
    ],
    ids=["classic", "FD", *map("-".join, POLICIES)],
)
def test_in_lockstep_the_figures_over_a_bus_are_those_of_the_experiment(
    wire: WireSpec, fd: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CanLink, "silent", False)  # a slow machine is no silent peer
    settings = lockstep_settings(wire)
    on_bus, direct = run_on_bus(virtual(fd=fd), settings, 0.5), run_experiment(settings, 0.5)
    assert on_bus.model_dump(exclude={"reasons"}) == direct.model_dump(exclude={"reasons"})


# The link


@pytest.mark.parametrize("end", ["plant", "controller"])
@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("wire", [WireSpec(), *(wire_of(*policies) for policies in POLICIES)], ids=str)
def test_an_empty_frame_is_refused_and_displaces_nothing_where_it_is_not_what_silence_sends(
    wire: WireSpec, lockstep: bool, end: str
) -> None:
    bus = virtual()
    policy = wire.transmit.command if end == "plant" else wire.transmit.measurement
    link = CanLink(bus, wire, end, lockstep=lockstep)  # type: ignore[arg-type]  # is one of both
    try:
        with Stranger(bus) as stranger:
            frame = bytes((wire.command if end == "plant" else wire.measurement).size)
            identifier = COMMAND_ID + 1 if end == "plant" else MEASUREMENT_ID + 1
            stranger.say(identifier, frame)
            stranger.say(identifier, UNCHANGED)
            stranger.settle(link)
            arrival = link.take()
            assert arrival is not None
            expected = lockstep and policy == "on_change"
            assert (arrival.frame, link.refused) == ((UNCHANGED, 0) if expected else (frame, 1))
    finally:
        link.close()


# The node


@pytest.fixture(params=[False, True], ids=["real time", "lockstep"])
def node(request: pytest.FixtureRequest) -> Iterator[tuple[CanNetwork, Stranger, bool]]:
    """A node's front, a stranger that receives what it sends, and whether it is in lockstep."""
    bus = virtual()
    endpoint = Endpoint(RecordingPlant(), BOTH, PERIOD_NS, lockstep=request.param)
    front = CanNetwork(bus, LoopSettings(lockstep=request.param), endpoint)
    with Stranger(bus) as stranger:
        yield front, stranger, request.param
        front.leave()


def test_a_node_sends_silence_where_it_could_not_be_received_only(node: tuple[CanNetwork, Stranger, bool]) -> None:
    front, stranger, lockstep = node
    for frame in (measurement(0), UNCHANGED, UNCHANGED, measurement(3)):
        front.send(frame)
    said = [bytes(m.data) for m in stranger.everything() if m.arbitration_id == MEASUREMENT_ID + 1]
    silence = [UNCHANGED, UNCHANGED] if lockstep else []
    assert said == [measurement(0), *silence, measurement(3)]
