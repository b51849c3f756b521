"""Every daemon with a stderr that nobody reads, as a halted terminal or a stuck journal: it works, stops and ends."""

from __future__ import annotations

import signal
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Grant, Status
from aeroloop.protocol.messages.states import PlantState
from tests.support.plant_end import Asker
from tests.support.processes import AEROLOOP, LONGEST_S, FullPipe
from tests.support.zenoh_network import Gathering, eventually

VEHICLES = {"plant": "aero", "controller": "other", "recorder": "aero"}
"""The controller has another vehicle, so that the test is the one that claims the plant."""


@pytest.mark.smoke
def test_a_stop_is_obeyed_and_every_daemon_ends_though_stderr_is_a_full_pipe(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """No slack: every wait is for an event, and lasts for ever where a message waits for stderr."""
    folder = tmp_path_factory.mktemp("stuck")
    with ExitStack() as stack:
        pipe = stack.enter_context(FullPipe())
        gathering = stack.enter_context(Gathering())
        zenoh = gathering.join()
        asker = Asker(zenoh)
        network = ["--set", f"network.rendezvous={gathering.settings.rendezvous}"]
        words = {"plant": ["--set", f"plant.state_directory={folder}"], "recorder": ["--log", str(folder / "a.mcap")]}
        processes = {}
        for role, vehicle in VEHICLES.items():
            more = ["--set", f"vehicle={vehicle}", *words.get(role, [])]
            processes[role] = _started(stack, folder, [role, *network, *more], pipe)
        alive = topics.key("alive", "aero", role="plant")
        eventually("a plant", lambda: any(reply.ok for reply in zenoh.liveliness().get(alive)), LONGEST_S)
        assert isinstance(asker.claim(), Grant)
        assert asker.ask("stop").done
        status = Status.model_validate_json(asker.query("status"))
        assert status.state == PlantState.TRIPPED
        for role, vehicle in VEHICLES.items():
            key = topics.key("status", vehicle, role=role)
            eventually(f"the {role}", lambda key=key: any(reply.ok for reply in zenoh.get(key)), LONGEST_S)  # type: ignore[misc]
            processes[role].send_signal(signal.SIGTERM)
            assert processes[role].wait(LONGEST_S) == 0, role


def test_a_daemon_that_is_ended_before_it_has_started_does_not_wait_to_say_so(tmp_path: Path) -> None:
    """Sent at once, the signal is received before, while or after it starts; a CAN node says nothing when it has."""
    words = ["can-node", "--set", "can.interface=udp_multicast", "--set", "can.channel=239.74.163.9"]
    for delay_s in (0.3, 0.6, 1.2, 2.4):
        with ExitStack() as stack:
            process = _started(stack, tmp_path, words, stack.enter_context(FullPipe()))
            time.sleep(delay_s)
            process.send_signal(signal.SIGTERM)
            assert process.wait(LONGEST_S) in (0, -signal.SIGTERM)


def _started(stack: ExitStack, folder: Path, words: list[str], pipe: FullPipe) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([*AEROLOOP, *words], stderr=pipe.write_end, stdout=subprocess.DEVNULL, cwd=folder)
    stack.callback(process.wait)
    stack.callback(process.kill)
    return process
