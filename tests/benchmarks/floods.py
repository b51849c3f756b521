"""How often `op stop` gets through a flood: `uv run python -m tests.benchmarks.floods`, as root.

The daemons of the example `hosts-peers` are on hosts of their own (network namespaces), with certificates. A stranger's
host, which has none of theirs, floods the TLS ports of all three roles, and in some rows the QUIC ports, too. A try is
`aeroloop op stop` on an operator's host while the plant is driven. A row counts tries that ended with exit code 0 and
the plant at 0 V within 5 s after Python had loaded the command, which takes seconds by itself beside a busy machine's
other work. After each try an operator's process that was linked before the flood arms the plant again.

    … [--tries 20] [-- CONDITION…]

A condition is words joined by commas: `tcp=20` (connections a second at each role), `half-open=200` (connections held
at each role), `quic=20` (handshakes a second at each role, with a foreign certificate), `rule` (the firewall's rules
that `host units` prints, on every role's host).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Final

from tests.support.flooded import FloodedDeployment

CONDITIONS: Final = (
    "tcp=0", "tcp=10", "tcp=20", "tcp=50", "half-open=200",
    "tcp=20,quic=20", "tcp=20,quic=20,rule", "tcp=50,quic=50,rule", "half-open=200,quic=20,rule",
)  # fmt: skip
WITHIN_S: Final = 5.0


def main() -> None:
    """Run all conditions and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=20)
    parser.add_argument("conditions", nargs="*", default=CONDITIONS)
    given = parser.parse_args()
    print(f"| condition | stopped within {WITHIN_S:g} s | longest s | otherwise |\n|---|--:|--:|---|")
    for condition in given.conditions:
        words = dict(word.partition("=")[::2] for word in condition.split(","))
        with tempfile.TemporaryDirectory() as name, FloodedDeployment(Path(name)) as hosts:
            hosts.start()
            if "rule" in words:
                hosts.limit_newcomers()
            for kind in ("tcp", "half-open", "quic"):
                if float(words.get(kind, 0)):
                    hosts.flood(kind, words[kind])
            hosts.await_floods()
            tries = [hosts.try_to_stop() for _ in range(given.tries)]
        good = [attempt for attempt in tries if attempt.stopped and attempt.seconds < WITHIN_S]
        longest = max((attempt.seconds for attempt in good), default=float("nan"))
        others = "; ".join(f"{each.seconds:.1f} s: {each.says}" for each in tries if each not in good)
        print(f"| {condition} | {len(good)} of {len(tries)} | {longest:.2f} | {others} |", flush=True)


if __name__ == "__main__":
    main()
