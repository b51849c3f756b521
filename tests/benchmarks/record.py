"""What the recorder costs and keeps up with: a real recorder process, and senders that publish as the daemons do.

    uv run python tests/benchmarks/record.py

First a loop at 500 Hz with telemetry and truth at 50 Hz: CPU time of the recorder by its process's own account, and MB
an hour, with and without decoded channels. Then 20 000 messages a second for 30 s from two senders: every message is
looked for in the log. Nothing is asserted; a shared machine's figures are for reading.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import zenoh
from mcap.reader import make_reader

from protocol import topics
from protocol.messages import Telemetry, Truth
from protocol.network import NetworkSettings, join
from service.bench import Bench, free_rendezvous
from service.config import Settings, load

LOOP_S = 20.0
FLOOD_PER_S = 20_000
FLOOD_S = 30.0
SENDERS = 2
TELEMETRY = Telemetry(
    session="s1",
    tick=123456,
    counter=3,
    attitude_error=(0.00123456789, -0.0123456789, 0.0456789123),
    rate_error=(0.0123456789, 0.00123456789, -0.0456789123),
    desired=(0.99123456789, 0.0123456789, 0.0456789123, 0.0789123456),
    damping_estimate=(0.00123456789, 0.00456789123, 0.00789123456),
    voltages=(3.456789123, -2.345678912),
    sign=1,
).encode()
TRUTH = Truth(
    tick=123456,
    attitude=(0.99123456789, 0.0123456789, 0.0456789123, 0.0789123456),
    rate=(0.0123456789, 0.00123456789, -0.0456789123),
    voltages=(3.456789123, -2.345678912),
).encode()


def settings_for(log: Path, *overrides: str) -> Settings:
    """A recorder's configuration on a network of its own."""
    return load(overrides=[f"network.rendezvous={free_rendezvous()}", f"recorder.path={log}", *overrides])


def send(rendezvous: str, name: str, rate_hz: float, seconds: float, flood: bool) -> None:
    """Publish as a plant or a controller does, or as many as it takes; in a process of its own."""
    from protocol.links import Numbered, ZenohLink

    with join(NetworkSettings(rendezvous=rendezvous)) as session:
        if flood:
            frame_key, json_key, payload = topics.key("measurement", name, session="s1"), None, b""
        elif name == "plant":
            frame_key, json_key, payload = topics.key("measurement", "aero", session="s1"), "truth", TRUTH
        else:
            frame_key, json_key, payload = topics.key("command", "aero", session="s1"), "telemetry", TELEMETRY
        blocks = zenoh.CongestionControl.BLOCK
        sender = (
            Numbered(session.declare_publisher(frame_key, congestion_control=blocks)).put
            if flood
            else ZenohLink(session, frame_key, "none/" + name).send
        )
        json = Numbered(session.declare_publisher(topics.key(json_key, "aero"))) if json_key else None
        size = 2 if name == "controller" else 7
        time.sleep(1.0)
        start, sent = time.monotonic(), 0
        while sent < rate_hz * seconds:
            ahead = start + sent / rate_hz - time.monotonic()
            if ahead > 0:
                time.sleep(ahead)
            for _ in range(20 if flood else 1):
                sender(bytes([(sent & 15) << 4]) + os.urandom(size - 1))
                sent += 1
            if json is not None and sent % 10 == 0:
                json.put(payload)
        time.sleep(1.0)


def senders(rendezvous: str, names: list[str], rate_hz: float, seconds: float, *, flood: bool) -> None:
    """Run them all and wait."""
    command = [sys.executable, __file__, "send", rendezvous]
    running = [subprocess.Popen([*command, name, str(rate_hz), str(seconds), str(int(flood))]) for name in names]
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


def loop(decoded_hz: float) -> None:
    """A 500 Hz loop."""
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_for(Path(folder) / "log.mcap", f"recorder.decoded_hz={decoded_hz}")
        with Bench(settings) as bench:
            bench.start("recorder")
            bench.await_role("recorder")
            pid, rate = bench.pid("recorder"), settings.loop.rate_hz
            before, began = cpu_s(pid), time.monotonic()
            senders(settings.network.rendezvous, ["plant", "controller"], rate, LOOP_S, flood=False)
            used, took = cpu_s(pid) - before, time.monotonic() - began
            bench.stop("recorder")
        counts = counted(Path(folder))
        size = sum(path.stat().st_size for path in Path(folder).glob("*.mcap"))
        frames = sum(count for key, count in counts.items() if key.startswith("aeroloop/aero/s1/"))
        print(
            f"500 Hz, decoded at {decoded_hz:g} Hz: {used / LOOP_S:.2%} of one core over {took:.0f} s, "
            f"{frames} of {2 * rate * LOOP_S:.0f} frames, {size / LOOP_S * 3600 / 1e6:.0f} MB/h"
        )


def flood() -> None:
    """20 000 messages a second."""
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_for(Path(folder) / "log.mcap")
        names = [f"v{i}" for i in range(SENDERS)]
        with Bench(settings) as bench:
            bench.start("recorder")
            bench.await_role("recorder")
            pid = bench.pid("recorder")
            before = cpu_s(pid)
            senders(settings.network.rendezvous, names, FLOOD_PER_S / SENDERS, FLOOD_S, flood=True)
            used = cpu_s(pid) - before
            bench.stop("recorder")
        counts = counted(Path(folder))
        size = sum(path.stat().st_size for path in Path(folder).glob("*.mcap"))
        frames = sum(count for key, count in counts.items() if "/s1/" in key)
        lost = counts[topics.key("loss", settings.vehicle)]
        print(
            f"{FLOOD_PER_S}/s for {FLOOD_S:.0f} s: {frames} of {FLOOD_PER_S * FLOOD_S:.0f} messages in the log, "
            f"{lost} reports of a loss, {used / FLOOD_S:.0%} of one core, {size / FLOOD_S * 3600 / 1e6:.0f} MB/h"
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["send"]:
        send(sys.argv[2], sys.argv[3], float(sys.argv[4]), float(sys.argv[5]), sys.argv[6] == "1")
    else:
        loop(0.0)
        loop(25.0)
        flood()
