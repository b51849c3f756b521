"""Watch of a law in Python: an event while one of its ticks does not end, and the process's end if it never does.

The plant needs none of it: without commands its watchdog sets 0 V. But a loop that hangs in a user's code can neither
say so nor stop when it is asked to.
"""

from __future__ import annotations

import os
import sys
import time
from threading import Thread
from typing import Final

from aeroloop.protocol.runtime.node import Node

REPORT_S: Final = 1.0
"""A tick that lasts longer is reported while it lasts [s]."""
STOP_S: Final = 2.0
"""How long a hanging tick may outlast a request to stop [s]."""
_EVERY_S: Final = 0.1


class LawWatch(Thread):
    """Watches the ticks of a law.

    Attributes:
        begun: When the tick that runs began, on the node's clock; None between ticks. The loop sets it.
    """

    def __init__(self, role: Node, law: str) -> None:
        super().__init__(name="law watch", daemon=True)
        self._role = role
        self._law = law
        self.begun: float | None = None

    def run(self) -> None:
        """Watch until the process ends."""
        reported: float | None = None
        stopping: float | None = None
        while True:
            time.sleep(_EVERY_S)
            begun, now = self.begun, self._role.clock.monotonic()
            stopping = (stopping or now) if self._role.stop.is_set() else None
            if begun is None or now - begun < REPORT_S:
                continue
            if begun != reported:
                reported = begun
                self._role.event("fault", f"{self._law} has not ended a tick for {now - begun:.1f} s")
            if stopping is not None and now - stopping > STOP_S:
                sys.stderr.write(f"aeroloop: {self._law} does not end its tick: the process ends without it\n")
                os._exit(1)
