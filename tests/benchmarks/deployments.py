"""What the network's troubles cost a deployment: `uv run python -m tests.benchmarks.deployments peers|router`, as root.

Plant, controller, recorder, operator and, for clients, a router are on hosts of their own (network namespaces), at 500
Hz with the settings of the example. Printed are, trouble by trouble, how often the plant tripped, the time from its
begin to 0 V, and from its end until the plant is driven again; last, what is missing in the log.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from tests.support.deployment import Deployment, Kind
from tests.support.namespaces import Ways

LOSSY_S: Final = 10.0
AWAY_S: Final = 30.0
SETTLE_S: Final = 2.0
RELINK_S: Final = 10.0
"""More, after a host was away for `AWAY_S`: the pauses between TCP's attempts to connect have grown to some 10 s."""
LOSSES: Final[tuple[Ways, ...]] = ("both", "sent", "received")


def main(kind: Kind) -> None:
    """Cause all troubles, one after the other, and print a line for each."""
    with tempfile.TemporaryDirectory() as name, Deployment(kind, Path(name)) as hosts:
        hosts.start()
        time.sleep(SETTLE_S)
        hosts.cut_off_each()
        for percent in (1, 5, 20):
            for ways in LOSSES:
                hosts.lossy(percent, ways, LOSSY_S)
        for kbit_per_s in (2048, 1024, 256):
            hosts.slow(kbit_per_s, LOSSY_S)
        if kind == "router":
            hosts.restart("router")
        hosts.cut_off("recorder", AWAY_S)
        time.sleep(RELINK_S)
        print(f"{'':44} trips  0 V [s]  again [s]")
        for outcome in hosts.finish():
            print(outcome)
        ticks, messages = hosts.missed()
        print(f"missing in the log: ticks {ticks}, other messages {messages}")


if __name__ == "__main__":
    main("router" if sys.argv[1:] == ["router"] else "peers")
