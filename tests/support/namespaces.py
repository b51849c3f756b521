"""Hosts on one machine: Linux network namespaces that are cabled to a switch; needs root and `ip`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.network import NetworkSettings, join

STOP_WAIT_S: Final = 10.0


class NoNamespacesError(Exception):
    """This machine makes no network namespaces."""


def _ip(*words: str) -> None:
    try:
        subprocess.run(["ip", *words], check=True, capture_output=True, text=True)  # noqa: S607 - any ip will do
    except (OSError, subprocess.CalledProcessError) as error:
        raise NoNamespacesError(getattr(error, "stderr", None) or str(error)) from None


class Hosts:
    """Hosts by name, each with an address and a cable. A context: leaving it ends their processes and removes them.

    Attributes:
        rendezvous: Zenoh endpoints, one for each host, for `network.rendezvous`.
    """

    def __init__(self, names: Sequence[str], folder: Path) -> None:
        self._folder = folder
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in reversed(self._processes):
            for which in (signal.SIGTERM, signal.SIGCONT):
                process.send_signal(which)
            try:
                process.wait(STOP_WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._remove()

    def aeroloop(self, host: str, *words: str, overrides: Sequence[str] = ()) -> subprocess.Popen[bytes]:
        """Start a command of the program on a host; its log is `<folder>/<host>.log`."""
        given = [f"network.rendezvous={json.dumps(self.rendezvous)}", "network.insecure=true", *overrides]
        sets = [word for override in given for word in ("--set", override)]
        return self.start(host, "-m", "aeroloop", *words, *sets)

    def start(
        self, host: str, *words: str, stdin: int | None = None, stdout: Path | None = None
    ) -> subprocess.Popen[bytes]:
        """Start this Python on a host."""
        command = ["ip", "netns", "exec", self._prefix + host, sys.executable, *words]
        with self.log(host).open("ab") as errors, (stdout or Path(os.devnull)).open("ab") as output:
            process = subprocess.Popen(command, stdin=stdin, stdout=output, stderr=errors)
        self._processes.append(process)
        return process

    def log(self, host: str) -> Path:
        """What processes on a host logged."""
        return self._folder / f"{host}.log"

    def plug(self, host: str) -> None:
        """Plug a host's cable in, at full speed."""
        with suppress(NoNamespacesError):
            self._tc("del", host)
        _ip("-n", self._switch, "link", "set", host, "up")

    def pull(self, host: str) -> None:
        """Pull a host's cable out."""
        _ip("-n", self._switch, "link", "set", host, "down")

    def narrow(self, host: str, kbit_per_s: int) -> None:
        """Limit what a host receives."""
        self._tc("replace", host, "tbf", "rate", f"{kbit_per_s}kbit", "burst", "4kb", "latency", "400ms")

    def lose(self, host: str, percent: float) -> None:
        """Lose a share of what a host receives, at random; 0 for none any more."""
        rules = "add table inet loss; delete table inet loss;"
        if percent:
            chain = "type filter hook prerouting priority -300;"
            drop = f'iifname "cable" numgen random mod 1000 < {round(10 * percent)} drop'
            rules += f"table inet loss {{ chain received {{ {chain} {drop}; }}; }}"
        _ip("netns", "exec", self._prefix + host, "nft", rules)

    def crossed(self, host: str) -> tuple[int, int]:
        """Bytes that a host has sent and received so far, with all headers."""
        show = ["ip", "-n", self._switch, "-s", "-j", "link", "show", host]
        found = json.loads(subprocess.run(show, check=True, capture_output=True, text=True).stdout)[0]["stats64"]
        return found["rx"]["bytes"], found["tx"]["bytes"]

    def _tc(self, verb: str, host: str, *words: str) -> None:
        _ip("netns", "exec", self._switch, "tc", "qdisc", verb, "dev", host, "root", *words)

    def _remove(self) -> None:
        for name in ("switch", *self._addresses):
            with suppress(NoNamespacesError):
                _ip("netns", "del", self._prefix + name)


def _print_messages(rendezvous: list[str]) -> None:
    """Print every status and event on the network as a line of JSON, until SIGTERM."""

    def received(sample: zenoh.Sample) -> None:
        message: dict[str, Any] = json.loads(sample.payload.to_bytes())
        sys.stdout.write(json.dumps({"key": str(sample.key_expr), **message}) + "\n")
        sys.stdout.flush()

    with join(NetworkSettings(rendezvous=rendezvous, insecure=True), listen=False) as session:
        for topic in ("status", "event"):
            session.declare_subscriber(topics.key(topic, "*"), received)
        signal.sigwait([signal.SIGTERM])


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    _print_messages(json.loads(sys.argv[1]))
