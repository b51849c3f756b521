"""Loop of the bench: it is driven over either transport, in real time and in lockstep."""

from __future__ import annotations

import pytest

from aeroloop.protocol.messages.states import PlantState
from aeroloop.service.bench.loop import Transport, driven_loop, meeting_places


@pytest.mark.processes
@pytest.mark.parametrize(("transport", "lockstep"), [("unix", "false"), ("tcp", "true")])
def test_a_loop_is_driven(transport: Transport, lockstep: str) -> None:
    """Slack: 20 s to the first command, where a tenth of a second is usual: other tests keep both cores busy."""
    with meeting_places(transport) as network:
        own = [f"loop.lockstep={lockstep}", "loop.realtime=off", "plant.watchdog_s=0.5", "wire.counter_bits=10"]
        with driven_loop(network, *own) as (settings, next_status):
            assert next_status().state == PlantState.DRIVEN
            assert settings.network.rendezvous == network
