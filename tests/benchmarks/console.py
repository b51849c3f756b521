"""What ten open pages of the console cost the loop: runs with and without them, in turns.

uv run python -m tests.benchmarks.console 10    # trials each; 10 s a run

Each page is a socket that shows every block at once, on the same machine as the loop.
"""

import json
import subprocess
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from threading import Thread
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

from aeroloop.service.review.review import read
from aeroloop.service.terminal.show import show
from aeroloop.service.testing.hil import Hil

PAGES, SECONDS = 10, 10


def page(address: str) -> None:
    """Show what a page would, until the console ends."""
    place, query = urlsplit(address).netloc, urlsplit(address).query
    with connect(f"ws://{place}/socket?{query}", origin=Origin(f"http://{place}")) as socket:
        try:
            for text in socket:
                json.loads(text)
                socket.send('{"verb": "shown"}')
        except ConnectionClosed:
            return


def trial(pages: int) -> dict[str, float]:
    """Figures of a run with so many pages open."""
    with TemporaryDirectory() as folder, Hil(Path(folder)) as hil:
        hil.start()
        words = ["op", "console", "--port", "0", "--set", f"network.rendezvous={hil.settings.network.rendezvous}"]
        command = [sys.executable, "-P", "-m", "aeroloop", *words]
        console = subprocess.Popen(command, stdout=subprocess.PIPE, text=True) if pages else None
        if console is not None:
            assert console.stdout is not None
            address = console.stdout.readline().split()[4].rstrip(",")
            for _ in range(pages):
                Thread(target=page, args=(address,), daemon=True).start()
        hil.run(2)
        begun = hil.status("controller").ticks * hil.settings.loop.period
        hil.run(SECONDS)
        if console is not None:
            console.terminate()
            console.wait()
        hil.finish()
        found = read(hil.log.path, since_s=begun, until_s=begun + SECONDS).findings
        assert found.latency_us is not None
        return {"p99": found.latency_us.p99, "p99.9": found.latency_us.p999, "skipped": float(found.skipped_ticks or 0)}


def main() -> None:
    """Print medians and ranges of both."""
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    found = {0: list[dict[str, float]](), PAGES: list[dict[str, float]]()}
    for i in range(2 * trials):
        pages = (0, PAGES)[(i + i // 2) % 2]  # a, b, b, a
        found[pages].append(trial(pages))
        print(pages, found[pages][-1], file=sys.stderr)
    rows = []
    for pages, its in found.items():
        columns = {name: sorted(one[name] for one in its) for name in its[0]}
        texts = {name: f"{median(values):.0f} ({values[0]:.0f}…{values[-1]:.0f})" for name, values in columns.items()}
        rows.append({"pages": str(pages), **texts})
    show(rows)


if __name__ == "__main__":
    main()
