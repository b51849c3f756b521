"""Deployment that a stranger's host floods, and tries of `op stop` meanwhile."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from aeroloop.protocol.messages.operator import Request
from aeroloop.protocol.transport.network import joined_session
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.host.operator import OperatorError, send_by
from tests.support.certificates import Authority
from tests.support.deployment import HOSTS, Deployment, Kind
from tests.support.zenoh_network import eventually

PATIENT: Final = (
    "plant.watchdog_s=2", "controller.stale_s=2", "wire.counter_bits=12", "loop.realtime=off",
)  # fmt: skip
ROLES: Final = ("plant", "controller", "recorder")
LONGEST_S: Final = 60.0
COMMAND: Final = (
    "import sys; from aeroloop.service.cli.main import execute; from aeroloop.service.host import operator; "
    "print('loaded', flush=True); sys.exit(execute(sys.argv[1:]))"
)
"""The command line, which first says that its modules are loaded: on a busy machine that takes seconds by itself."""


class Try(NamedTuple):
    """A try of `op stop`: whether it ended with 0 and the plant at 0 V, what it took once loaded [s], what it said."""

    stopped: bool
    seconds: float
    says: str


class FloodedDeployment(Deployment):
    """Daemons of an example, and a stranger's host, which has a certificate of another authority."""

    def __init__(self, folder: Path, kind: Kind = "peers") -> None:
        super().__init__(kind, folder, PATIENT, strangers=("stranger",))
        self._foreign = Authority(folder / "foreign")
        self._foreign.issue("operator")
        self._floods: list[Path] = []
        self._armer: subprocess.Popen[bytes] | None = None

    def start(self) -> None:  # type: ignore[override]
        super().start()
        network = self.network.model_dump_json()
        armed = self._folder / "armer"
        words = ("-m", "tests.support.flooded", network)
        self._armer = self.python("operator", *words, stdin=subprocess.PIPE, stdout=armed)
        eventually("links of the operator's process", lambda: armed.exists() and "linked" in armed.read_text())

    def __exit__(self, *exception: object) -> None:
        if self._armer is not None and self._armer.stdin is not None:
            self._armer.stdin.close()
        super().__exit__(*exception)

    def flood(self, kind: str, count: str, roles: Sequence[str] = ROLES) -> None:
        """Begin a flood of these roles' hosts, which lasts until the deployment ends."""
        place_by_role = dict(zip(HOSTS, self.rendezvous, strict=False))
        places = [place_by_role[role] for role in roles]
        words = ("-m", "tests.support.flood", kind, count, str(self._foreign.folder), *places)
        self._floods.append(self._folder / f"flood-{len(self._floods)}")
        self.python("stranger", *words, stdout=self._floods[-1])

    def await_floods(self) -> None:
        """Wait until every flood has run for a second."""
        for file in self._floods:
            eventually("a flood", lambda f=file: f.exists() and "flooding" in f.read_text())  # type: ignore[misc]  # bound now

    def await_operators_trips(self, count: int) -> None:
        """Wait for so many events of a stop by an operator, and see that there are no more."""
        text = "stopped by an operator"

        def trips() -> list[dict[str, Any]]:
            return [line for line in self._seen() if line.get("kind") == "tripped" and text in line["text"]]

        eventually(f"{count} stops", lambda: len(trips()) >= count)
        assert len(trips()) == count

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
        command = self.command("operator", "-P", "-c", COMMAND, "op", "stop", *self.options())
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            assert process.stdout is not None
            process.stdout.readline()  # it is loaded
            begun = time.monotonic()
            said, _ = process.communicate(timeout=LONGEST_S)
            seconds = time.monotonic() - begun
        stopped = process.returncode == 0 and "aero is at 0 V" in said
        return Try(stopped, seconds, " ".join(said.split()))

    def _arm(self) -> None:
        assert self._armer is not None
        assert self._armer.stdin is not None
        self._armer.stdin.write(b"\n")
        self._armer.stdin.flush()


def _arm_on_request(network: NetworkSettings) -> None:
    """Arm the plant at every line of stdin, by a session that is linked from the start."""
    least = len(ROLES) if network.mode == "peer" else 1
    with joined_session(network) as session:
        eventually("links", lambda: len(session.session.info.links()) >= least)
        sys.stdout.write("linked\n")
        sys.stdout.flush()
        for _ in sys.stdin:
            with suppress(OperatorError):  # it is held: the last stop did not reach it
                send_by(session.anew(), network, "aero", "arm", Request())


if __name__ == "__main__":
    _arm_on_request(NetworkSettings.model_validate_json(sys.argv[1]))
