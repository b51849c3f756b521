"""Hosts on one machine: Linux network namespaces that are cabled to a switch; needs root and `ip`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Literal, Self

import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.config_sources import load_target

STOP_WAIT_S: Final = 10.0
RECOVERY_S: Final = 10.0
"""After a trouble, until a recorder has what it missed [s]: TCP waits seconds after many losses, and links are new."""


class NoNamespacesError(Exception):
    """This machine makes no network namespaces, or loses no packets on request; one line."""


def _ip(*words: str) -> None:
    _run("ip", *words)


def _run(*words: str, given: str | None = None) -> None:
    try:
        subprocess.run(words, check=True, capture_output=True, text=True, input=given)
    except (OSError, subprocess.CalledProcessError) as error:
        raise NoNamespacesError(getattr(error, "stderr", None) or str(error)) from None


Ways = Literal["sent", "received", "both"]


class Hosts:
    """Hosts by name, each with an address and a cable. A context: leaving it ends their processes and removes them."""

    def __init__(self, names: Sequence[str], folder: Path, config: Path | None = None) -> None:
        self._folder = folder
        self._config = config
        self._prefix = f"al{os.getpid()}-"
        self._switch = f"{self._prefix}switch"
        self._addresses = {name: f"10.77.0.{number}" for number, name in enumerate(names, 1)}
        self._processes: list[subprocess.Popen[bytes]] = []
        self.rendezvous = [f"tcp/{address}:7447" for address in self._addresses.values()]

    def __enter__(self) -> Self:
        try:
            _ip("netns", "add", self._switch)
            _ip("-n", self._switch, "link", "add", "bridge", "type", "bridge")
            _ip("-n", self._switch, "link", "set", "bridge", "up")
            for name, address in self._addresses.items():
                host = self._prefix + name
                _ip("netns", "add", host)
                _ip("-n", host, "link", "set", "lo", "up")
                _ip("-n", host, "link", "add", "cable", "type", "veth", "peer", "name", name, "netns", self._switch)
                _ip("-n", self._switch, "link", "set", name, "master", "bridge", "up")
                _ip("-n", host, "addr", "add", f"{address}/24", "dev", "cable")
                _ip("-n", host, "link", "set", "cable", "up")
        except NoNamespacesError:
            self._remove()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):
            for which in (signal.SIGTERM, signal.SIGCONT):
                process.send_signal(which)
            try:
                process.wait(STOP_WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._remove()

    def aeroloop(
        self, host: str, *words: str, overrides: Sequence[str] = (), environment: Mapping[str, str] | None = None
    ) -> subprocess.Popen[bytes]:
        """Start a command of the program on a host; its log is `<folder>/<host>.log`."""
        return self.python(host, "-m", "aeroloop", *words, *self.options(overrides), environment=environment)

    def options(self, overrides: Sequence[str] = ()) -> list[str]:
        """Words of a command line: the configuration, or without one the rendezvous, and overrides."""
        network = [] if self._config else [f"network.rendezvous={json.dumps(self.rendezvous)}", "network.insecure=true"]
        sets = [word for override in [*network, *overrides] for word in ("--set", override)]
        return [*(["--config", str(self._config)] if self._config else []), *sets]

    def command(self, host: str, *words: str) -> list[str]:
        """The words that run Python on a host."""
        return ["ip", "netns", "exec", self._prefix + host, sys.executable, *words]

    def python(
        self,
        host: str,
        *words: str,
        stdin: int | None = None,
        stdout: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> subprocess.Popen[bytes]:
        command = self.command(host, *words)
        with self.log(host).open("ab") as errors, (stdout or Path(os.devnull)).open("ab") as output:
            inherited = {**os.environ, "STATE_DIRECTORY": str(self._folder / "state")}
            process = subprocess.Popen(
                command, stdin=stdin, stdout=output, stderr=errors, env={**inherited, **(environment or {})}
            )
        self._processes.append(process)
        return process

    def watch(self, host: str) -> Callable[[], list[dict[str, Any]]]:
        """Collect every status and event that a host receives from now on; they have `at`, the time of arrival [s].

        A process group collects those of its own host only.
        """
        file = self._folder / f"{host}-seen"
        self.python(host, "-m", "tests.support.namespaces", self.network.model_dump_json(), stdout=file)
        return lambda: [json.loads(line) for line in file.read_text().splitlines() if line.endswith("}")]

    @property
    def network(self) -> NetworkSettings:
        configured = load_target(self._config).network if self._config else None
        return configured or NetworkSettings(rendezvous=self.rendezvous, insecure=True)

    def log(self, host: str) -> Path:
        return self._folder / f"{host}.log"

    def plug(self, host: str) -> None:
        for where, device in self._ends(host):
            with suppress(NoNamespacesError):
                _ip("netns", "exec", where, "tc", "qdisc", "del", "dev", device, "root")
        _ip("-n", self._switch, "link", "set", host, "up")

    def pull(self, host: str) -> None:
        _ip("-n", self._switch, "link", "set", host, "down")

    def narrow(self, host: str, kbit_per_s: int, ways: Ways = "received") -> None:
        for way, (where, device) in zip(("received", "sent"), self._ends(host), strict=True):
            if ways in (way, "both"):
                rate = ("tbf", "rate", f"{kbit_per_s}kbit", "burst", "4kb", "latency", "400ms")
                _ip("netns", "exec", where, "tc", "qdisc", "replace", "dev", device, "root", *rate)

    def lose(self, host: str, percent: float, ways: Ways = "both") -> None:
        """Lose a share of the packets that a host sends, receives, or both, at random; 0 ends it.

        They are dropped where they arrive: a sender would be notified, and send again sooner than on a real cable.
        """
        for way, (where, device) in zip(("sent", "received"), self._ends(host), strict=True):
            table = f"add table netdev {device}; delete table netdev {device};"
            if percent and ways in (way, "both"):
                hook = f'type filter hook ingress device "{device}" priority 0;'
                drop = f"numgen random mod 1000 < {round(10 * percent)} drop;"
                table += f"table netdev {device} {{ chain lossy {{ {hook} {drop} }}; }}"
            _run("ip", "netns", "exec", where, "nft", "-f", "-", given=table)

    def filter_packets(self, host: str, ruleset: str) -> None:
        """Give a host rules of nftables."""
        _run("ip", "netns", "exec", self._prefix + host, "nft", "-f", "-", given=ruleset)

    def crossed(self, host: str) -> tuple[int, int]:
        """Bytes that a host has sent and received so far, with all headers."""
        show = ["ip", "-n", self._switch, "-s", "-j", "link", "show", host]
        found = json.loads(subprocess.run(show, check=True, capture_output=True, text=True).stdout)[0]["stats64"]
        return found["rx"]["bytes"], found["tx"]["bytes"]

    def _ends(self, host: str) -> tuple[tuple[str, str], tuple[str, str]]:
        return (self._switch, host), (self._prefix + host, "cable")

    def _remove(self) -> None:
        for name in ("switch", *self._addresses):
            with suppress(NoNamespacesError):
                _ip("netns", "del", self._prefix + name)


def _print_messages(network: NetworkSettings) -> None:
    """Print every status and event on the network as a line of JSON, until SIGTERM."""

    def received(sample: zenoh.Sample) -> None:
        message: dict[str, Any] = json.loads(sample.payload.to_bytes())
        sys.stdout.write(json.dumps({"key": str(sample.key_expr), "at": time.time(), **message}) + "\n")
        sys.stdout.flush()

    with join(network, listen=False) as session:
        for topic in ("status", "event"):
            session.declare_subscriber(topics.key(topic, "*"), received)
        signal.sigwait([signal.SIGTERM])


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    _print_messages(NetworkSettings.model_validate_json(sys.argv[1]))
