"""What a network that loses packets or is narrow does to the loop: `uv run python -m tests.benchmarks.loss`, as root.

Plant and controller are on hosts of their own (network namespaces), at 500 Hz with the default settings; the recorder
is on the controller's. A row is a run of one transport and one condition, which begins once the plant is driven. It
shows the plant's trips, z_track, that as a multiple of the first row of its kind, ticks of either end that the log
lacks, the latency at the plant, what crosses its cable with all headers, and processor time.

    … [--seconds 60] [--transport tcp mixed] [--links plain certificates] [--set KEY=VALUE] [-- CONDITION…]

A condition is words joined by commas: `loss=20` (percent, both ways), `from_plant=5`, `to_plant=1`, `kbit=512` (both).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any, Final

from tests.benchmarks.loop import cpu_s, run
from tests.support.certificates import Authority
from tests.support.namespaces import RECOVERY_S, Hosts
from tests.support.zenoh_network import eventually

LOSSES: Final = ["loss=0", "loss=1", "loss=5", "loss=20", "from_plant=20", "to_plant=20"]
NARROW: Final = ["kbit=1000", "kbit=512", "kbit=256"]
COLUMNS: Final = (
    "transport, condition, trips, z_track, ×, ticks missing, latency p50/p99/max ms, kbit/s from/to plant, "
    "% of a core plant/controller"
)
SETTLE_S: Final = 2.0


def main() -> None:
    """Run all conditions with each transport, and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--transport", nargs="+", default=["tcp", "mixed"])
    parser.add_argument("--links", nargs="+", default=["plain"], help="plain, certificates: mutual TLS, QUIC, rules")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("conditions", nargs="*", default=[*LOSSES, *NARROW])
    given = parser.parse_args()
    names = COLUMNS.split(", ")
    print("| " + " | ".join(names) + " |\n|" + len(names) * "---|")
    first: dict[tuple[str, str], float] = {}
    for condition, transport, links in product(given.conditions, given.transport, given.links):
        overrides = [f"network.transport={transport}", "controller.after_restart=configured", *given.overrides]
        review, kbit_per_s, cores = one_run(overrides, condition, given.seconds, links == "certificates")
        error, latency = review["z_track"] or 0.0, review["latency_us"] or {}
        reference = first.setdefault((transport, links), error)
        row = [
            f"{transport}, {links}", condition, len(review["trips"]), f"{error:.2e}",
            f"{error / reference:.2f}" if reference else "–", sum(review["missing_ticks"].values()),
            "/".join(f"{1e-3 * latency.get(which, 0):.2f}" for which in ("p50", "p99", "max")),
            "/".join(f"{rate:.0f}" for rate in kbit_per_s), "/".join(f"{100 * share:.0f}" for share in cores),
        ]  # fmt: skip
        print("| " + " | ".join(map(str, row)) + " |", flush=True)


def one_run(
    overrides: list[str], condition: str, seconds: float, certificates: bool
) -> tuple[dict[str, Any], list[float], list[float]]:
    """The review of its log, kbit/s on the plant's cable from and to it, shares of a core of plant and controller."""
    words = {name: float(value) for name, _, value in (word.partition("=") for word in condition.split(","))}
    both = words.get("loss", 0.0)
    with tempfile.TemporaryDirectory() as name, Hosts(["plant", "controller"], Path(name)) as hosts:
        if certificates:
            authority = Authority(Path(name) / "keys")
            for role in ("plant", "controller", "recorder"):
                authority.issue(role, "aero")
            overrides = [*overrides, f'network.security.directory="{name}/keys"']
        log = Path(name) / "log.mcap"
        processes = [
            hosts.aeroloop("plant", "plant", overrides=overrides),
            hosts.aeroloop("controller", "controller", "--auto-arm", overrides=overrides),
            hosts.aeroloop("controller", "recorder", "--log", str(log), overrides=overrides),
        ]
        eventually("driving", lambda: "has aero" in hosts.log("controller").read_text())
        time.sleep(SETTLE_S)
        for host, loss in (("plant", words.get("to_plant", both)), ("controller", words.get("from_plant", both))):
            hosts.lose(host, loss, "received")
            if "kbit" in words:
                hosts.narrow(host, round(words["kbit"]))

        def counters() -> list[float]:
            return [8e-3 * crossed for crossed in hosts.crossed("plant")] + [cpu_s(each.pid) for each in processes[:2]]

        before = counters()
        time.sleep(seconds)
        rates = [(late - early) / seconds for early, late in zip(before, counters(), strict=True)]
        for host in ("plant", "controller"):
            hosts.lose(host, 0)
            hosts.plug(host)
        time.sleep(RECOVERY_S)
        for process in processes:
            process.terminate()
            process.wait()
        return json.loads(run("log", "review", str(log), "--json")), rates[:2], rates[2:]


if __name__ == "__main__":
    main()
