"""Process group: starts and stops roles as child processes, for the demo and the tests.

Each child runs the command that a user would type, with the effective configuration in a temporary file. A child ends
when its parent ends. ^C reaches only the parent, which stops its children one by one.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from random import randrange
from typing import Any, Final, Literal, Self, get_args

import zenoh

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.can_format import CanSettings
from aeroloop.protocol.transport.network import POLL_S, join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.transport.probe import accepting
from aeroloop.service.config import ENV_PREFIX, Settings
from aeroloop.service.recording.rolling import parts
from aeroloop.service.testing.fork_server import ForkedProcess, fork_server

RoleName = Literal["controller", "plant", "can-node", "recorder", "router"]

Child = subprocess.Popen[bytes] | ForkedProcess

_BLOCKS: Final = 10_000, 32_000
"""Ports to choose blocks from: below those that the system gives out by itself."""

START_WAIT_S: Final = 20.0
STOP_WAIT_S: Final = 10.0


class ProcessGroupError(AeroloopError):
    """A process did not start or ended early; one line with its last warning or error."""


def free_rendezvous() -> str:
    """A loopback endpoint with free ports from it on, which no other call returns while this process lives.

    Why a UDP socket: it reserves the block against other processes that look for one, and leaves its TCP ports free.
    """
    ports = NetworkSettings().ports
    while True:
        first = randrange(*_BLOCKS, ports)  # noqa: S311  # no secret
        reservation = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with suppress(OSError):
            reservation.bind(("127.0.0.1", first))
            for port in range(first, first + ports):
                socket.create_server(("127.0.0.1", port)).close()
            reservation.detach()  # stays bound until this process ends
            return f"tcp/127.0.0.1:{first}"
        reservation.close()


def private_bus(can: CanSettings) -> CanSettings:
    """The same bus, limited to this machine and to a free port where the interface is UDP multicast."""
    if can.interface != "udp_multicast":
        return can
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
    return can.model_copy(update={"options": {"hop_limit": 0, "port": port, **can.options}})


def standalone(settings: Settings, log: Path, **controller: Any) -> Settings:
    """The settings of a loop that arms and moves by itself and records to a new log, on a free rendezvous and bus.

    Raises:
        ProcessGroupError: The log exists.
    """
    if parts(log):
        raise ProcessGroupError(f"{log} exists, and a log is never written over; name another with --log PATH")
    controller |= {"require_recorder": True, "auto_arm": True, "after_restart": "configured"}
    return settings.model_copy(
        update={
            "network": settings.network.model_copy(update={"rendezvous": [free_rendezvous()]}),
            "controller": settings.controller.model_copy(update=controller),
            "can": private_bus(settings.can),
            "recorder": settings.recorder.model_copy(update={"path": log.absolute()}),
        }
    )


class ProcessGroup:
    """Processes of one network and one configuration on this machine. A context: leaving it stops them all.

    Their configuration and output, a text file each, are kept in the folder if one is given; `zenoh` is a session on
    their network. Clients get a router of their own.
    """

    def __init__(self, settings: Settings, folder: Path | None = None) -> None:
        self._cleanup = ExitStack()
        self._folder = folder or Path(self._cleanup.enter_context(tempfile.TemporaryDirectory(prefix="aeroloop-")))
        self._folder.mkdir(parents=True, exist_ok=True)
        # A stop or a trip outlives its process here, and surprises no other group.
        plant = settings.plant.model_copy(update={"state_directory": self._folder.absolute() / "state"})
        self._settings = settings = settings.model_copy(update={"plant": plant})
        self._config = self._folder / "aeroloop.toml"
        self._config.write_text(settings.toml())
        self._children: dict[str, Child] = {}
        self._alive: set[str] = set()
        self._killed: set[str] = set()  # stopped by `stop`, so an exit code is no failure
        self._changed = threading.Condition()
        if settings.network.mode == "client":
            self._start_router()
        self.zenoh = join(settings.network)  # listens, so that a process links to it as it starts
        self.zenoh.liveliness().declare_subscriber(topics.key("alive", settings.vehicle), self._token, history=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        for role in get_args(RoleName):  # the controller first, recorder and router last
            if role in self._children:
                self.stop(role)
        self.zenoh.close()
        self._cleanup.close()

    def _start_router(self) -> None:
        self.start("router")
        while not accepting(self._settings.network.rendezvous_endpoints):
            self._check("router")
            time.sleep(POLL_S)

    def start_plant(self) -> None:
        """Start the configured plant end, and a node on the bus where the bus is software."""
        if self._settings.plant.via == "can" and self._settings.can.interface == "udp_multicast":
            self.start("can-node")
        self.start("plant")

    def start(self, role: RoleName, *arguments: str, environment: Mapping[str, str] | None = None) -> Child:
        """Start a role; `await_role` waits until it is on the network.

        Args:
            role: The role to start.
            arguments: Further words of its command line.
            environment: Additions to this process's environment. With them the child is a new interpreter, because the
                dynamic linker reads them at start; without, it is a fork (see `fork_server`).
        """
        inherited = {name: value for name, value in os.environ.items() if not name.startswith(ENV_PREFIX)}
        server = None if environment else fork_server()
        parent = server.pid if server else os.getpid()
        words = [role, "--config", str(self._config), f"--with-parent={parent}", *arguments]
        with self._log(role).open("ab") as stderr:
            if server:
                child: Child = server.start(words, inherited, stderr.fileno())
            else:
                child = subprocess.Popen(
                    [sys.executable, "-P", "-m", "aeroloop", *words],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                    env={**inherited, **(environment or {})},
                    start_new_session=True,
                )
        self._children[role] = child
        self._killed.discard(role)
        return child

    def await_role(self, role: RoleName, timeout_s: float = START_WAIT_S) -> None:
        """Wait for a role's liveliness token.

        Raises:
            ProcessGroupError: The role ended, or the time is over.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while role not in self._alive:
                self._check(role)
                if time.monotonic() > deadline:
                    raise ProcessGroupError(f"the {role} did not join the network within {timeout_s:g} s")
                self._changed.wait(0.1)

    def running(self, role: RoleName) -> bool:
        """Whether a started role still runs."""
        return self._children[role].poll() is None

    def stop(self, role: RoleName, how: signal.Signals = signal.SIGTERM) -> int:
        """Stop a role and wait for its end; kill it after `STOP_WAIT_S`. Returns its exit code."""
        self._killed.add(role)
        child = self._children[role]
        if child.poll() is None:
            child.send_signal(how)
            child.send_signal(signal.SIGCONT)  # a paused process handles no other signal
        try:
            return child.wait(STOP_WAIT_S)
        except subprocess.TimeoutExpired:
            child.kill()
            return child.wait()

    def signal(self, role: RoleName, which: signal.Signals) -> None:
        """Send a signal to a started role."""
        self._children[role].send_signal(which)

    def pid(self, role: RoleName) -> int:
        """Process id of a started role."""
        return self._children[role].pid

    def replace_log(self, path: Path) -> None:
        """Set the path of the log for recorders started from now on."""
        recorder = self._settings.recorder.model_copy(update={"path": path})
        self._settings = self._settings.model_copy(update={"recorder": recorder})
        self._config.write_text(self._settings.toml())

    def check(self) -> None:
        """Raise ProcessGroupError, with its last warning or error, if any process has failed."""
        for role in self._children:
            self._check(role)

    def _check(self, role: str) -> None:
        code = self._children[role].poll()
        if code and role not in self._killed:
            lines = self._log(role).read_text(errors="replace").strip().splitlines()
            last = next((f": {line}" for line in reversed(lines) if " INFO " not in line), "")
            raise ProcessGroupError(f"the {role} ended with exit code {code}{last}")

    def _log(self, role: str) -> Path:
        return self._folder / f"{role}.txt"

    def _token(self, sample: zenoh.Sample) -> None:
        address = topics.read_key(str(sample.key_expr))
        if address is None or address.role is None:
            return
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._alive.add(address.role)
            else:
                self._alive.discard(address.role)
            self._changed.notify_all()
