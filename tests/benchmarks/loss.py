"""What a network that loses packets, or is narrow, does to the loop: `uv run python -m tests.benchmarks.loss`, as root.

Plant and controller are on hosts of their own (network namespaces), at 500 Hz with the default settings; the recorder
is on the controller's. A row is a run: with a transport, and a condition that begins once the plant is driven and lasts
SECONDS. Printed are the plant's trips, z_track, as a multiple of the first run's of that transport as well, the ticks of
both ends that the log lacks, the plant's latency, and what crosses the plant's cable.

    python -m tests.benchmarks.loss [--seconds 60] [--transport tcp,mixed] [--certificates] [CONDITION…]

A condition is words such as `loss=20`, `from_plant=5`, `to_plant=1` (shares lost, in percent), `kbit=256` (both ways).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from tests.support.namespaces import Hosts
from tests.support.zenoh_network import eventually

CONDITIONS: Final = (
    "loss=0 loss=1 loss=5 loss=20 from_plant=5 to_plant=5 from_plant=20 to_plant=20 kbit=1000 kbit=512 kbit=256".split()
)
RECOVERY_S: Final = 8.0
"""How long the recorder then has to recover what was lost [s]: a publisher repeats its last number every 2 s."""
HEADER: Final = "| transport | condition | trips | z_track | × | ticks missing | frames taken | latency p50/p99/max ms | kbit/s from/to plant |"


def main() -> None:
    """Run all conditions with each transport and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--transport", default="tcp,mixed")
    parser.add_argument("--certificates", action="store_true", help="mutual TLS, and QUIC with it")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("conditions", nargs="*", default=CONDITIONS)
    given = parser.parse_args()
    print(HEADER + "\n|" + HEADER.count("|", 1) * "---|", flush=True)
    for transport in given.transport.split(","):
        quiet: float | None = None
        for condition in given.conditions:
            found = run(transport, condition, given.seconds, given.overrides, certificates=given.certificates)
            quiet = quiet or found["z_track"]
            times = "" if not quiet or not found["z_track"] else f"{found['z_track'] / quiet:.2f}"
            print(
                f"| {transport} | {condition} | {found['trips']} | {found['z_track'] or float('nan'):.2e} | {times} "
                f"| {found['missing']} | {found['taken']:.1%} | {found['latency']} "
                f"| {found['from']:.0f} / {found['to']:.0f} |",
                flush=True,
            )


def run(
    transport: str, condition: str, seconds: float, overrides: list[str], *, certificates: bool = False
) -> dict[str, Any]:
    """One run, and what its log says."""
    words = dict(word.split("=") for word in condition.split(","))
    both = float(words.get("loss", 0))
    with tempfile.TemporaryDirectory() as name, Hosts(["plant", "controller"], Path(name)) as hosts:
        folder = Path(name)
        log = folder / "log.mcap"
        sets = [f"network.transport={transport}", *overrides]
        if certificates:
            sets += keys(folder)
        recorder = hosts.aeroloop("controller", "recorder", "--log", str(log), overrides=sets)
        plant = hosts.aeroloop("plant", "emulator", overrides=sets)
        controller = hosts.aeroloop("controller", "controller", "--auto-arm", overrides=sets)
        eventually("driving", lambda: "has aero" in hosts.log("controller").read_text())
        time.sleep(2)
        hosts.lose("plant", float(words.get("to_plant", both)))
        hosts.lose("controller", float(words.get("from_plant", both)))
        if "kbit" in words:
            for host in ("plant", "controller"):
                hosts.narrow(host, int(words["kbit"]))
        before = hosts.crossed("plant")
        time.sleep(seconds)
        after = hosts.crossed("plant")
        for host in ("plant", "controller"):
            hosts.lose(host, 0)
            hosts.plug(host)
        time.sleep(RECOVERY_S)
        for process in (controller, plant, recorder):
            process.terminate()
            process.wait()
        kbit = [8e-3 * (late - early) / seconds for early, late in zip(before, after, strict=True)]
        return {**judged(log), "from": kbit[0], "to": kbit[1]}


def judged(log: Path) -> dict[str, Any]:
    """What a log's review says, of all its sessions."""
    command = [sys.executable, "-m", "aeroloop", "log", "review", str(log), "--json"]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=False).stdout)
    return found


def keys(folder: Path) -> list[str]:
    """Certificates of both hosts."""
    raise NotImplementedError


if __name__ == "__main__":
    main()
