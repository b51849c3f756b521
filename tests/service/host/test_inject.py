"""`aeroloop op inject` against an emulator on a real Zenoh, in this process."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import pytest

from aeroloop.plant_emulator.hosts.zenoh_network import run_plant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.cli.main import execute
from aeroloop.service.host.operator import gather
from tests.support.zenoh_network import Gathering, eventually


def test_faults_are_injected_and_cleared_with_one_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    loop, settings = LoopSettings(realtime="off", rate_hz=100), PlantSettings(faults=["rate:bias=0.1@9"])
    with Gathering() as gathering, Node("plant", "aero", gathering.settings, {}) as role:

        def inject(*words: str) -> tuple[int, str, str]:
            code = execute(["op", "inject", *words, "--set", f"network.rendezvous={gathering.settings.rendezvous[0]}"])
            return code, *capsys.readouterr()

        def faults() -> Sequence[str]:
            return [fault.fault for fault in gather(gathering.settings).statuses["aero"]["plant"].faults]

        thread = threading.Thread(target=run_plant, args=(role, loop, WireSpec(), settings))
        thread.start()
        try:
            line = "fault injected: rate:off@1..2; fault injected: command:drop=0.1\n"
            assert inject("rate:off@1..2", "command:drop=0.1") == (0, line, "")
            eventually("three faults", lambda: faults() == ["rate:bias=0.1@9", "rate:off@1..2", "command:drop=0.1"])
            assert inject("--clear") == (0, "no faults any more\n", "")
            eventually("no fault", lambda: faults() == [])
            refused = "aeroloop: fault 'motor3:off': the plant has no motor3, but motor1, motor2\n"
            assert inject("rate:off", "motor3:off") == (1, "", refused)
            assert faults() == []
        finally:
            role.stop.set()
            thread.join()
