"""Loop of the bench: it is driven over either transport, in real time and in lockstep; medians of turns."""

from __future__ import annotations

import pytest

from aeroloop.protocol.messages.states import PlantState
from aeroloop.service.bench import loop
from aeroloop.service.bench.item import Figure
from aeroloop.service.bench.loop import Transport, driven_loop, meeting_places


@pytest.mark.processes
@pytest.mark.parametrize(("transport", "lockstep"), [("unix", "false"), ("tcp", "true")])
def test_a_loop_is_driven(transport: Transport, lockstep: str) -> None:
    """Slack: 20 s to the first command, where a tenth of a second is usual: other tests keep both cores busy."""
    with meeting_places(transport) as network:
        own = [f"loop.lockstep={lockstep}", "loop.realtime=off", "plant.watchdog_s=0.5", "wire.counter_bits=10"]
        with driven_loop(network, *own) as (settings, next_status):
            status = next_status()
            assert status.state == PlantState.DRIVEN
            assert str(settings.loop.lockstep).lower() == lockstep
            assert settings.network.rendezvous == network
            assert all(place.startswith(transport) for place in network)


def test_a_latency_is_the_median_of_its_turns_ours_and_the_floors(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = [((5.0, 50.0), (4.0, 40.0)), ((1.0, 90.0), (9.0, 10.0)), ((3.0, 70.0), (2.0, 20.0))]
    measured = iter(turns)
    monkeypatch.setattr(loop, "_latency", lambda _: next(measured))
    assert loop.latency.__wrapped__("tcp", quick=False) == (Figure(3.0, 4.0), Figure(70.0, 20.0))
    measured = iter(turns)
    assert loop.latency.__wrapped__("tcp", quick=True) == (Figure(5.0, 4.0), Figure(50.0, 40.0))
    assert len([*measured]) == 2
