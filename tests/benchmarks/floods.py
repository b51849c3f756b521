"""What floods cost the loop: `uv run python -m tests.benchmarks.floods [SECONDS] [FLOODERS] [TOPIC ...]`.

Plant, controller and recorder run at 500 Hz with the default settings, open to strangers, who flood each topic of the
table in turn: garbage, nested JSON, as many unknown keys as fit, what is longer than allowed, 1 MB, and well-formed
messages, to keys with and without wildcards. Each flood takes turns with as long a stretch in which nobody floods.
Printed are the ticks that each end skipped, and by how much its memory grew.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import Final

import zenoh
from zenoh.handlers import RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Claim, Event, Loss, SessionRecord
from aeroloop.protocol.messages.operator import Advance, Gains, Hold, Inject, Request, Setpoint, Sinusoid, Track
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.messages.topics import Topic
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import Settings
from aeroloop.service.testing.process_group import ProcessGroup, standalone
from tests.benchmarks.loop import NO_SCOUTING, ROLES, memory_mb

SECONDS: Final = 4.0
LINKED_S: Final = 0.5
"""A stranger is linked to all processes within this time."""
GAINS: Final = Gains(C1=(2.0, 2.0, 2.0), C2=(0.1, 0.1, 0.1), Gamma=(0.05, 0.05, 0.05))
WELL_FORMED: Final = {
    "claim": Claim(controller="stranger", session="stranger", period_ns=2_000_000, lockstep=False, wire=WireSpec()),
    "record": SessionRecord(
        controller="stranger", session="stranger", gains=GAINS, gains_from="operator", reference=Hold(),
        reference_from="operator", within_s=1.0, since_tick=0,
    ),
    "set_gains": Gains(),
    "show": Request(),
    "recall": Request(),
    "track": Track(reference=Sinusoid()),
    "inject": Inject(),
    "advance": Advance(seconds=1.0),
    "reference": Setpoint(attitude=(0.0, 1.0, 2.0)),
    "event": Event(role="plant", kind="fault", text="it never happened"),
    "loss": Loss(key="aeroloop/aero/event/plant", count=1, reason="gone"),
}  # fmt: skip
"""Without certificates an arm, a stop or a plant's status would be taken at its word: of those garbage alone."""


def payloads(topic: Topic) -> Iterator[bytes]:
    """What a stranger sends on a topic, over and over."""
    limit = topic.request if topic.kind == "query" else topic.limit
    keys = ",".join(f'"k{number}":0' for number in range(limit // 9))[: limit - 2].rpartition(",")[0]
    kinds = [
        os.urandom(min(limit, 16_384)),
        (b"[" * limit)[:limit],
        (b'{"a":' * (limit // 5))[:limit],
        f"{{{keys}}}".encode(),
        b"[" + b"0," * (limit // 2 - 2) + b"0]",
        bytes(limit + 1),
        bytes(1_000_000),
    ]
    if topic.name in WELL_FORMED:
        kinds.append(WELL_FORMED[topic.name].encode())
    return cycle(kinds)


def flood(rendezvous: str, name: str, seconds: float) -> None:
    """Flood a topic, as a stranger that links to every process at a rendezvous."""
    os.nice(19)
    topic = topics.TOPICS[name]
    places = NetworkSettings(rendezvous=[rendezvous]).rendezvous_endpoints
    tree = {"connect": {"endpoints": places, "exit_on_failure": False}, **NO_SCOUTING}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(tree))) as session:
        keys = cycle([topics.key(name, "aero", session="s", role="plant")] * 3 + [topics.key(name, "*")])
        tokens: list[zenoh.LivelinessToken] = []
        time.sleep(LINKED_S)
        until = time.monotonic() + seconds
        for number, (key, payload) in enumerate(zip(keys, payloads(topic), strict=False)):
            if time.monotonic() > until:
                break
            if topic.kind == "token":
                holder = (f"{os.getpid()}-{number}", "plant", "recorder", "*")[number % 4]
                tokens.append(session.liveliness().declare_token(f"aeroloop/aero/alive/{holder}"))
                if len(tokens) >= 1000:
                    while tokens:
                        tokens.pop().undeclare()
            elif topic.kind == "query":
                session.get(key, RingChannel(1), payload=payload, timeout=1.0)
            else:
                session.put(key, payload)
                if topic.answered:
                    session.get(key, RingChannel(1), timeout=1.0)
        os._exit(0)  # not after what still waits to be sent


class Ends:
    """Skipped ticks and memory of the loop's processes, once the plant is driven."""

    def __init__(self, processes: ProcessGroup) -> None:
        self._processes = processes
        processes.eventually("driving", lambda: processes.state("plant") == PlantState.DRIVEN)
        self._before = self._now()

    def _now(self) -> dict[str, tuple[int, float]]:
        statuses = self._processes.statuses
        statuses.clear()
        self._processes.eventually("a status of each", lambda: statuses.keys() >= {*ROLES})
        return {role: (statuses[role].skipped, memory_mb(self._processes.pid(role))) for role in ROLES}

    def since(self) -> str:
        """What has changed since the last call, end by end."""
        before, self._before = self._before, self._now()
        changes = [(role, *(b - a for a, b in zip(before[role], self._before[role], strict=True))) for role in ROLES]
        return "  ".join(f"{role} {skipped:4.0f} {grown:+6.1f} MB" for role, skipped, grown in changes)


def main(seconds: float, flooders: int, names: list[str]) -> None:
    """Flood topic by topic, each time after a quiet stretch, and print a line for each."""
    with tempfile.TemporaryDirectory() as folder:
        settings = standalone(Settings(), Path(folder) / "log.mcap")
        with ProcessGroup(settings) as processes:
            processes.start_loop(environment={})  # an interpreter each: forks would share memory
            ends = Ends(processes)
            os.nice(19)  # it watches tokens, too
            time.sleep(seconds)
            ends.since()
            for name in names:
                time.sleep(seconds)
                print(f"{name:12} {'quiet':10} {ends.since()}", flush=True)
                words = ["flood", settings.network.rendezvous[0], name, str(seconds)]
                command = [sys.executable, "-m", "tests.benchmarks.floods", *words]
                for stranger in [subprocess.Popen(command) for _ in range(flooders)]:
                    stranger.wait()
                print(f"{name:12} {'flooded':10} {ends.since()}", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["flood"]:
        flood(sys.argv[2], sys.argv[3], float(sys.argv[4]))
    else:
        seconds, flooders, *chosen = [*sys.argv[1:], *(str(SECONDS), "1")[len(sys.argv[1:3]) :]]
        main(float(seconds), int(flooders), chosen or list(topics.TOPICS))
