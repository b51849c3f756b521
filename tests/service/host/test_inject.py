"""`aeroloop op inject` against an emulator on a real Zenoh, in this process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from aeroloop.plant_emulator.hosts.zenoh_network import run_plant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.cli.main import execute
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

LOOP = LoopSettings(realtime="off", rate_hz=100)

Inject = Callable[..., tuple[int, str, str]]


@pytest.fixture
def plant(capsys: pytest.CaptureFixture[str]) -> Iterator[tuple[Inject, Callable[[], list[str]], list[Event]]]:
    """`op inject` with exit code and lines of stdout and stderr; the faults of the plant's status; its events."""
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as role:
        settings = PlantSettings(faults=["rate:bias=0.1@9"])
        thread = threading.Thread(target=run_plant, args=(role, LOOP, WireSpec(), settings))
        zenoh, events = gathering.join(), list[Event]()
        key = topics.key("event", "aero")
        zenoh.declare_subscriber(key, lambda one: events.append(Event.model_validate_json(one.payload.to_bytes())))
        thread.start()

        def inject(*arguments: str) -> tuple[int, str, str]:
            code = execute(
                ["op", "inject", *arguments, "--set", f"network.rendezvous=tcp/127.0.0.1:{gathering.ports[0]}"]
            )
            return code, *capsys.readouterr()

        def faults() -> list[str]:
            for reply in zenoh.get(topics.key("status", "aero", role="plant"), timeout=PATIENCE_S):
                if reply.ok is not None:
                    status = Status.model_validate_json(reply.ok.payload.to_bytes())
                    assert status.since is None  # it is of the cause why a plant is not armed, which no fault is
                    return [fault.fault for fault in status.faults]
            return []

        try:
            eventually("its status", lambda: faults() == ["rate:bias=0.1@9"])
            yield inject, faults, events
        finally:
            role.stop.set()
            thread.join()


def test_faults_are_injected_and_cleared_with_one_line_each(
    plant: tuple[Inject, Callable[[], list[str]], list[Event]],
) -> None:
    inject, faults, events = plant
    line = "fault injected: rate:off@1..2; fault injected: command:drop=0.1\n"
    assert inject("rate:off@1..2", "command:drop=0.1") == (0, line, "")
    eventually("three faults", lambda: faults() == ["rate:bias=0.1@9", "rate:off@1..2", "command:drop=0.1"])
    assert inject("--clear") == (0, "no faults any more\n", "")
    eventually("no fault", lambda: faults() == [])
    texts = ["fault injected: rate:off@1..2", "fault injected: command:drop=0.1", "no faults any more"]
    eventually("the events", lambda: [event.text for event in events if event.kind == "fault"] == texts)
    code, out, error = inject("rate:off", "motor3:off")
    assert (code, out) == (1, "")
    assert error == "aeroloop: fault 'motor3:off': the plant has no motor3, but motor1, motor2\n"
    assert faults() == []
