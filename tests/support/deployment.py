"""Deployment: the daemons of an example configuration, each on a host of its own, and what a trouble costs them.

Times come from the log: these hosts have one wall clock. So a message that a pulled cable holds back for seconds still
says when the plant was at 0 V.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from subprocess import Popen
from typing import Final, Literal, NamedTuple

from aeroloop.protocol.messages.models import Event, Loss, Status
from aeroloop.protocol.transport.network_settings import NetworkSettings, SecuritySettings
from aeroloop.service.cli.show import EXAMPLES
from aeroloop.service.review.review import read
from aeroloop.service.testing.hil_log import HilLog
from tests.support.certificates import Authority
from tests.support.namespaces import RECOVERY_S, STOP_WAIT_S, Hosts, Ways
from tests.support.zenoh_network import PATIENCE_S, eventually

Kind = Literal["peers", "router"]
HOSTS: Final = ("plant", "controller", "recorder", "operator", "router")  # in the order of their addresses
AWAY_S: Final = 2.0  # twice the lease, so that links are given up [s]


class Outcome(NamedTuple):
    """What a trouble cost: trips, seconds to 0 V from its begin, seconds from its end until the plant stays driven."""

    title: str
    trips: int
    rest_s: float | None
    again_s: float | None

    def __str__(self) -> str:
        def in_s(value: float | None) -> str:
            return "–" if value is None else f"{value:.3f}"

        return f"{self.title:44} {self.trips:5} {in_s(self.rest_s):>9} {in_s(self.again_s):>9}"


class Deployment(Hosts):
    """Hosts of an example configuration with a certificate each; `daemons` by host, once started.

    `strangers` are further hosts, without a certificate.
    """

    def __init__(self, kind: Kind, folder: Path, overrides: Sequence[str] = (), strangers: Sequence[str] = ()) -> None:
        super().__init__((*HOSTS, *strangers), folder, EXAMPLES / f"hosts-{kind}.toml")
        self.kind = kind
        self.daemons: dict[str, Popen[bytes]] = {}
        self.log_file = folder / "log.mcap"
        self._overrides = overrides
        self._keys = Authority(folder / "keys")
        for role in HOSTS:
            self._keys.issue(role, "aero" if role in ("plant", "controller") else None)
        self._troubles: list[tuple[str, float, float]] = []  # title, begin and end [s since 1970]
        self._finished = float("inf")  # when the daemons are ended [s since 1970]: what that costs is no trouble's

    def options(self, overrides: Sequence[str] = ()) -> list[str]:
        return super().options([f"network.security.directory={self._keys.folder}", *overrides])

    @property
    def network(self) -> NetworkSettings:
        return super().network.model_copy(
            update={"security": SecuritySettings(directory=str(self._keys.folder), vehicles=["aero"])}
        )

    def start(self, environments: Mapping[str, Mapping[str, str]] | None = None) -> None:
        """Start the daemons, each in its host's environment, and wait until the plant is driven."""
        given = environments or {}
        for host in ("recorder", "plant", "controller", *(["router"] if self.kind == "router" else [])):
            self.start_daemon(host, given.get(host))
        self._seen = self.watch("operator")
        self.await_driven(0.0)

    def start_daemon(self, host: str, environment: Mapping[str, str] | None = None) -> None:
        words = {"plant": ["plant"], "controller": ["controller", "--auto-arm"], "router": ["router"],
                 "recorder": ["recorder", "--log", str(self.log_file)]}[host]  # fmt: skip
        self.daemons[host] = self.aeroloop(host, *words, overrides=self._overrides, environment=environment)

    def suffer(self, title: str, begin: Callable[[], object], end: Callable[[], object], for_s: float = AWAY_S) -> None:
        """Cause a trouble and end it; then wait until the plant is driven, or still is."""
        begun = time.time()
        begin()
        time.sleep(for_s)
        ended = time.time()
        end()
        self._troubles.append((title, begun, ended))
        self.await_driven(time.time() + 0.5)  # by a later status: that one may have been under way

    def cut_off(self, host: str, for_s: float = AWAY_S) -> None:
        self.suffer(
            f"cable of the {host} out for {for_s:g} s", partial(self.pull, host), partial(self.plug, host), for_s
        )

    def cut_off_each(self) -> None:
        for host in HOSTS:
            if host in self.daemons or host == "operator":
                self.cut_off(host)

    def lossy(self, percent: float, ways: Ways, for_s: float) -> None:
        what = {"both": "sends and receives", "sent": "sends", "received": "receives"}[ways]
        title = f"{percent:g} % lost of what the plant {what}"
        self.suffer(title, partial(self.lose, "plant", percent, ways), partial(self.lose, "plant", 0), for_s)

    def slow(self, kbit_per_s: int, for_s: float) -> None:
        title = f"{kbit_per_s} kbit/s to and from the plant"
        self.suffer(title, partial(self.narrow, "plant", kbit_per_s, "both"), partial(self.plug, "plant"), for_s)

    def choke(self, host: str, kbit_per_s: int, for_s: float) -> None:
        title = f"{kbit_per_s} kbit/s to the {host}"
        self.suffer(title, partial(self.narrow, host, kbit_per_s), partial(self.plug, host), for_s)

    def halt(self, host: str, for_s: float = AWAY_S) -> None:
        halted, goes_on = (partial(self.daemons[host].send_signal, which) for which in (signal.SIGSTOP, signal.SIGCONT))
        self.suffer(f"the {host} halted for {for_s:g} s", halted, goes_on, for_s)

    def restart(self, host: str) -> None:
        self.suffer(
            f"the {host} ended, and started again", partial(self._end, host), partial(self.start_daemon, host), 0.0
        )

    def _end(self, host: str) -> None:
        self.daemons[host].send_signal(signal.SIGTERM)
        self.daemons[host].wait(STOP_WAIT_S)

    def await_driven(self, since: float) -> None:
        """Wait for a status of a driven plant that arrives after a time [s since 1970]; processes may start first."""

        def is_driven() -> bool:
            return any(line.get("state") == "driven" and line["at"] > since for line in self._seen())

        eventually("driving", is_driven, 4 * PATIENCE_S)

    def finish(self) -> list[Outcome]:
        """End the daemons, the recorder after the ends, and read what each trouble cost from the log.

        Not before `RECOVERY_S`: nothing shows from outside when the recorder has all that it asks the ends' caches for.
        """
        time.sleep(RECOVERY_S)
        self._finished = time.time()
        for host in ("controller", "plant", "recorder"):
            self._end(host)
        return list(self._outcomes())

    def missed(self) -> tuple[dict[str, int], int]:
        """By the log: ticks of each end that are missing, and other messages that the recorder missed for good.

        Not counted are statuses of the router: one that ends soon after the recorder was cut off takes along what it
        published meanwhile.
        """
        messages = [loss for _, loss in HilLog(self.log_file).messages(Loss)]
        losses = sum(loss.count for loss in messages if not loss.key.endswith("/status/router"))
        return dict(read(self.log_file).findings.missing_ticks), losses

    def _outcomes(self) -> Iterator[Outcome]:
        log = HilLog(self.log_file)
        events = [(at * 1e-9, event) for at, event in log.messages(Event)]
        trips = [at for at, event in events if event.kind == "tripped"]
        states = sorted((at * 1e-9, status.state) for at, status in log.messages(Status) if status.role == "plant")
        ends = [*(begun for _, begun, _ in self._troubles[1:]), self._finished]
        for (title, begun, ended), until in zip(self._troubles, ends, strict=True):
            tripped = [at for at in trips if begun < at < until]
            driven = [at for at, state in states if state == "driven" and tripped and tripped[-1] < at < until]
            yield Outcome(
                title,
                len(tripped),
                tripped[0] - begun if tripped else None,
                max(0.0, driven[0] - ended) if driven else None,
            )
