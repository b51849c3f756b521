"""Lost packets: between hosts frames are datagrams, so a lost one stalls no other; traces are recovered to the last.

The hosts are network namespaces of this machine. A watchdog of 0.3 s instead of 0.1 s allows for a busy machine; with
`network.transport=tcp` the loop stands for longer than that several times in these 6 s.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any, Final

import pytest

from tests.support.namespaces import RECOVERY_S, Hosts, NoNamespacesError
from tests.support.zenoh_network import eventually

pytestmark = pytest.mark.processes

PATIENT: Final = ("plant.watchdog_s=0.3", "controller.stale_s=0.3", "wire.counter_bits=10", "loop.realtime=off")
LOSS: Final = 20.0
LOST_FOR_S: Final = 6.0


@pytest.fixture(scope="module")
def review(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The review of a session of which 20 % of all packets were lost, both ways, for 6 s."""
    folder = tmp_path_factory.mktemp("loss")
    log = folder / "log.mcap"
    try:
        with Hosts(["plant", "controller"], folder) as hosts:
            parties = [
                hosts.aeroloop("controller", "controller", "--auto-arm", overrides=PATIENT),
                hosts.aeroloop("plant", "emulator", overrides=PATIENT),
                hosts.aeroloop("controller", "recorder", "--log", str(log), overrides=PATIENT),
            ]
            eventually("driving", lambda: "frames by datagrams" in hosts.log("controller").read_text())
            for host in ("plant", "controller"):
                hosts.lose(host, LOSS, "received")
            time.sleep(LOST_FOR_S)
            for host in ("plant", "controller"):
                hosts.lose(host, 0)
            time.sleep(RECOVERY_S)
            for party in parties:
                party.terminate()
                party.wait()
    except NoNamespacesError as error:
        pytest.skip(f"no network namespaces here: {error}")
    command = [sys.executable, "-m", "aeroloop", "log", "review", str(log), "--json"]
    found: dict[str, Any] = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    return found


def test_a_fifth_of_all_packets_lost_both_ways_trips_nothing(review: dict[str, Any]) -> None:
    assert review["trips"] == []
    assert review["sessions"] == 1
    assert review["duration_s"] > LOST_FOR_S
    assert review["gap_count"] > 0, "measurements were lost, too"


def test_no_tick_of_either_end_is_missing_from_the_log(review: dict[str, Any]) -> None:
    assert review["missing_ticks"] == {"controller": 0, "plant": 0}
    assert review["missing"] == []
