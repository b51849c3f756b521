"""Recorder benchmark: load and losses of a real recorder process fed by publishers like the ends.

    uv run python -m tests.benchmarks.record

First the messages of a loop at 500 Hz, traces of both ends with telemetry at 25 Hz and truth at 50 Hz: CPU time of the
recorder's process and MB an hour, with and without decoded channels. Then 20 000 JSON messages a second for 10 s from
two publishers; every message is searched in the log. Nothing is asserted; CPU time on a shared machine depends on other
work, so compare figures of the same minutes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.history import CachedPublisher
from aeroloop.protocol.transport.network import join
from aeroloop.service.config import Settings, load
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous
from tests.support.made_messages import VEHICLE, Ends, description_of

LOOP_S = 20.0
FLOOD_PER_S = 20_000
FLOOD_S = 10.0
PUBLISHERS = 2

Put = Callable[[str, bytes, float], None]


def settings_for(log: Path, *overrides: str) -> Settings:
    """A recorder's configuration on a network of its own."""
    return load(overrides=[f"network.rendezvous={free_rendezvous()}", f"recorder.path={log}", *overrides])


def publish(rendezvous: str, name: str, seconds: float) -> None:
    """Publish as both ends of a loop, or, under any other name, as many as it takes; in a process of its own."""
    settings = load(overrides=[f"network.rendezvous={rendezvous}"])
    with join(settings.network) as session:
        publishers: dict[str, CachedPublisher] = {}

        def put(key: str, payload: bytes, per_s: float) -> None:
            if key not in publishers:
                publishers[key] = CachedPublisher(session, key, per_s, lossless=per_s > 1000)
            publishers[key].put(payload)

        if name == "ends":
            description = description_of(settings, "plant").encode()
            put(topics.key("description", VEHICLE, role="plant"), description, 1)
            time.sleep(1.0)
            loop(settings, put, seconds)
        else:
            flood(topics.key("telemetry", name), put, seconds)
        time.sleep(1.0)


def loop(settings: Settings, put: Put, seconds: float) -> None:
    """What both ends publish, in real time."""
    ends, period_s, start = Ends(settings), settings.loop.period, time.monotonic()
    for k in range(round(seconds / period_s)):
        if (ahead := start + k * period_s - time.monotonic()) > 0:
            time.sleep(ahead)
        for said in ends.tick(k, time.monotonic_ns(), time.time_ns()):
            put(said.key, said.payload, 50)


def flood(key: str, put: Put, seconds: float) -> None:
    """Telemetry, 20 messages at a time."""
    said = (said.payload for said in Ends(load()).tick(0, 1, 1) if said.topic == "telemetry")
    payload, rate_hz, start = next(said), FLOOD_PER_S / PUBLISHERS, time.monotonic()
    for sent in range(0, round(rate_hz * seconds), 20):
        if (ahead := start + sent / rate_hz - time.monotonic()) > 0:
            time.sleep(ahead)
        for _ in range(20):
            put(key, payload, rate_hz)


def run_publishers(rendezvous: str, names: list[str], seconds: float) -> None:
    """Run them all and wait."""
    command = [sys.executable, "-m", "tests.benchmarks.record", "publish", rendezvous]
    running = [subprocess.Popen([*command, name, str(seconds)]) for name in names]
    for process in running:
        process.wait()


def cpu_s(pid: int) -> float:
    """CPU time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def counted(folder: Path) -> Counter[str]:
    """Messages in the logs of a folder, by topic, as mcap's own reader counts them."""
    counts: Counter[str] = Counter()
    for path in folder.glob("*.mcap"):
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            assert summary is not None
            assert summary.statistics is not None
            for channel, count in summary.statistics.channel_message_counts.items():
                counts[summary.channels[channel].topic] += count
    return counts


def measured(names: list[str], seconds: float, *overrides: str) -> tuple[Counter[str], float, float]:
    """Messages in the log by topic, share of a core, and MB an hour, while publishers run beside a recorder."""
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_for(Path(folder) / "log.mcap", *overrides)
        with ProcessGroup(settings) as processes:
            processes.start("recorder")
            processes.await_role("recorder")
            pid = processes.pid("recorder")
            before = cpu_s(pid)
            run_publishers(settings.network.rendezvous[0], names, seconds)
            used = cpu_s(pid) - before
            processes.stop("recorder")
        size = sum(path.stat().st_size for path in Path(folder).glob("*.mcap"))
        return counted(Path(folder)), used / seconds, size / seconds * 3600 / 1e6


def main() -> None:
    """Print all figures."""
    for decoded_hz in (0.0, 25.0):
        counts, share, size = measured(["ends"], LOOP_S, f"recorder.decoded_hz={decoded_hz}")
        batches = sum(count for key, count in counts.items() if "/trace/" in key)
        print(
            f"500 Hz, decoded at {decoded_hz:g} Hz: {share:.2%} of one core, {batches} of {20 * LOOP_S:.0f} batches, "
            f"{counts[f'/{VEHICLE}/pose']} poses, {size:.0f} MB/h"
        )
    counts, share, size = measured([f"v{i}" for i in range(PUBLISHERS)], FLOOD_S)
    received = sum(count for key, count in counts.items() if key.endswith("/telemetry"))
    print(
        f"{FLOOD_PER_S}/s for {FLOOD_S:.0f} s: {received} of {FLOOD_PER_S * FLOOD_S:.0f} messages in the log, "
        f"{counts[topics.key('loss', VEHICLE)]} reports of a loss, {share:.0%} of one core, {size:.0f} MB/h"
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["publish"]:
        publish(sys.argv[2], sys.argv[3], float(sys.argv[4]))
    else:
        main()
