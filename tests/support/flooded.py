"""Deployment that a stranger's host floods, and tries of `op stop` meanwhile."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from aeroloop.protocol.messages.operator import Request
from aeroloop.protocol.transport.network import joined_session
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.host.operator import OperatorError, send_by
from tests.support.certificates import Authority
from tests.support.deployment import HOSTS, Deployment
from tests.support.zenoh_network import eventually

PATIENT: Final = (
    "plant.watchdog_s=2", "controller.stale_s=2", "wire.counter_bits=12", "loop.realtime=off",
)  # fmt: skip
ROLES: Final = ("plant", "controller", "recorder")
LONGEST_S: Final = 60.0


class Try(NamedTuple):
    """A try of `op stop`: whether it ended with 0 and the plant at 0 V, what it took [s], what it said."""

    stopped: bool
    seconds: float
    says: str


class FloodedDeployment(Deployment):
    """Daemons of the example of peers, and a stranger's host, which has a certificate of another authority."""

    def __init__(self, folder: Path, overrides: Sequence[str] = ()) -> None:
        super().__init__("peers", folder, (*PATIENT, *overrides), strangers=("stranger",))
        self._foreign = Authority(folder / "foreign")
        self._foreign.issue("operator")

    def start(self) -> None:  # type: ignore[override]
        super().start()
        network = self.network.model_dump_json()
        armed = self._folder / "armer"
        words = ("-m", "tests.support.flooded", network)
        self._armer = self.python("operator", *words, stdin=subprocess.PIPE, stdout=armed)
        eventually("links of the operator's process", lambda: armed.exists() and "linked" in armed.read_text())

    def flood(self, kind: str, count: str, roles: Sequence[str] = ROLES) -> None:
        """Begin a flood, which lasts until the deployment ends."""
        place_by_role = dict(zip(HOSTS, self.rendezvous, strict=False))
        places = [place_by_role[role] for role in roles]
        self.python("stranger", "-m", "tests.support.flood", kind, count, str(self._foreign.folder), *places)

    def limit_newcomers(self) -> None:
        """Have the firewall's rule that `host units` prints on each role's host."""
        from aeroloop.service.host.units import firewall

        rules = firewall(self.network)
        for host in ROLES:
            self.filter_packets(host, rules)

    def try_to_stop(self) -> Try:
        """Have the plant driven, and stop it by the command."""
        self._arm()
        self.await_driven(time.time())
        begun = time.monotonic()
        command = self.command("operator", "-P", "-m", "aeroloop", "op", "stop", *self.options())
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LONGEST_S)
        seconds = time.monotonic() - begun
        at_rest = "aero is at 0 V" in done.stdout
        return Try(done.returncode == 0 and at_rest, seconds, " ".join((done.stdout + done.stderr).split()))

    def _arm(self) -> None:
        assert self._armer.stdin is not None
        self._armer.stdin.write(b"\n")
        self._armer.stdin.flush()


def _arm_on_request(network: NetworkSettings) -> None:
    """Arm the plant at every line of stdin, by a session that is linked from the start."""
    with joined_session(network) as session:
        eventually("links", lambda: len(session.session.info.peers_zid()) >= len(ROLES))
        sys.stdout.write("linked\n")
        sys.stdout.flush()
        for _ in sys.stdin:
            with suppress(OperatorError):  # it is held: the last stop did not reach it
                send_by(session.anew(), network, "aero", "arm", Request())


if __name__ == "__main__":
    _arm_on_request(NetworkSettings.model_validate_json(sys.argv[1]))
