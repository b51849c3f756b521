"""A flood at the recorder: `uv run python -m tests.benchmarks.record`.

20 000 JSON messages a second for 10 s from two publishers; every message is searched in the log. Nothing is asserted;
CPU time on a shared machine depends on other work, so compare figures of the same minutes.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.history import CachedPublisher
from aeroloop.protocol.transport.network import join
from aeroloop.service.config import load
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous
from tests.benchmarks.loop import cpu_s
from tests.support.made_log import VEHICLE, made

FLOOD_PER_S = 20_000
FLOOD_S = 10.0
PUBLISHERS = 2


def flood(rendezvous: str, vehicle: str) -> None:
    """Publish telemetry, 20 messages at a time; in a process of its own."""
    payload = next(message.payload for message in made(load(), 20) if message.key.endswith("/telemetry"))
    rate_hz = FLOOD_PER_S / PUBLISHERS
    with join(load(overrides=[f"network.rendezvous={rendezvous}"]).network) as session:
        publisher = CachedPublisher(session, topics.key("telemetry", vehicle), rate_hz, lossless=True)
        start = time.monotonic()
        for sent in range(0, round(rate_hz * FLOOD_S), 20):
            if (ahead := start + sent / rate_hz - time.monotonic()) > 0:
                time.sleep(ahead)
            for _ in range(20):
                publisher.put(payload)
        time.sleep(1.0)


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


def main() -> None:
    """Print what the flood left in the log."""
    with tempfile.TemporaryDirectory() as folder:
        settings = load(overrides=[f"network.rendezvous={free_rendezvous()}", f"recorder.path={folder}/log.mcap"])
        with ProcessGroup(settings) as processes:
            processes.start("recorder")
            processes.await_role("recorder")
            pid = processes.pid("recorder")
            before = cpu_s(pid)
            command = [sys.executable, "-m", "tests.benchmarks.record", settings.network.rendezvous[0]]
            running = [subprocess.Popen([*command, f"v{i}"]) for i in range(PUBLISHERS)]
            for process in running:
                process.wait()
            used = cpu_s(pid) - before
            processes.stop("recorder")
        counts = counted(Path(folder))
        size = sum(path.stat().st_size for path in Path(folder).glob("*.mcap"))
    received = sum(count for key, count in counts.items() if key.endswith("/telemetry"))
    print(
        f"{FLOOD_PER_S}/s for {FLOOD_S:.0f} s: {received} of {FLOOD_PER_S * FLOOD_S:.0f} messages in the log, "
        f"{counts[topics.key('loss', VEHICLE)]} reports of a loss, {used / FLOOD_S:.0%} of one core, "
        f"{size / FLOOD_S * 3600 / 1e6:.0f} MB/h"
    )


if __name__ == "__main__":
    if sys.argv[1:]:
        flood(*sys.argv[1:])
    else:
        main()
