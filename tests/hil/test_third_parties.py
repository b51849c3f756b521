"""Third parties: a process that records, watches or operates costs the loop nothing when its link or itself dies.

The ends and the third party are on hosts of their own, network namespaces of this machine. A watchdog of 0.5 s instead
of 0.1 s allows for a busy machine.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.namespaces import Hosts, NoNamespacesError
from tests.support.zenoh_network import eventually

PATIENT = (
    "plant.watchdog_s=0.5",
    "controller.stale_s=0.5",
    "wire.counter_bits=10",
    "loop.realtime=off",
    "network.transport=tcp",  # the harder case: frames share links and a lease of 1 s with all else
)
AWAY_S = 2.0
"""Twice the lease, so that the ends close the link [s]."""


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[Hosts]:
    """Hosts with an emulator and a controller, and a third one that records and watches; the plant is driven."""
    try:
        with Hosts(["plant", "controller", "third"], tmp_path) as hosts:
            hosts.aeroloop("plant", "plant", overrides=PATIENT)
            hosts.aeroloop("controller", "controller", "--auto-arm", overrides=PATIENT)
            hosts.watch("plant", tmp_path / "seen")
            eventually("driving", lambda: bool(ticks(tmp_path)))
            yield hosts
    except NoNamespacesError as error:
        pytest.skip(f"no network namespaces here: {error}")


def seen(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "seen").read_text().splitlines() if line.endswith("}")]


def ticks(folder: Path) -> list[int]:
    return [int(str(line["ticks"])) for line in seen(folder) if line.get("state") == "driven"]


def pull_the_cable(hosts: Hosts, _: list[object]) -> None:
    hosts.pull("third")
    time.sleep(AWAY_S)
    hosts.plug("third")


def narrow_the_cable(hosts: Hosts, _: list[object]) -> None:
    hosts.narrow("third", 64)
    time.sleep(2 * AWAY_S)  # until what is queued for it fills the queues
    hosts.plug("third")


def halt(_: Hosts, parties: list[object]) -> None:
    for party in parties:
        party.send_signal(signal.SIGSTOP)  # type: ignore[attr-defined]  # a process
    time.sleep(AWAY_S)
    for party in parties:
        party.send_signal(signal.SIGCONT)  # type: ignore[attr-defined]


def kill(_: Hosts, parties: list[object]) -> None:
    for party in parties:
        party.kill()  # type: ignore[attr-defined]


def test_whatever_happens_to_a_third_party_the_session_goes_on(hosts: Hosts, tmp_path: Path) -> None:
    parties: list[object] = [
        hosts.aeroloop("third", "recorder", "--log", str(tmp_path / "log.mcap"), overrides=PATIENT),
        hosts.aeroloop("third", "op", "top"),
    ]

    def await_recording() -> None:
        before = len(seen(tmp_path))  # by a new status: it is linked, or linked again
        eventually("recording", lambda: any(line.get("state") == "recording" for line in seen(tmp_path)[before:]))

    def await_a_second_more() -> None:
        now = ticks(tmp_path)[-1]
        eventually("a second more", lambda: ticks(tmp_path)[-1] > now + 500)

    for happens in (pull_the_cable, narrow_the_cable, halt, kill):
        await_recording()
        happens(hosts, parties)
        await_a_second_more()
        costs = [line["text"] for line in seen(tmp_path) if line.get("kind") in ("tripped", "lost")]
        assert costs == [], happens.__name__
