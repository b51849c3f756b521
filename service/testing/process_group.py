"""Process group: starts, watches and stops roles as child processes, for the demo, `hil`, the tests and the benchmarks.

Each child runs the command that a user would type, with the effective configuration in a file. It is a fork of
multiprocessing's server, which has imported everything. A child ends when this process ends, however that ends. ^C
reaches only this process, which stops its children one by one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from operator import methodcaller
from pathlib import Path
from random import randrange
from runpy import run_module
from threading import Condition, Thread
from typing import Any, Final, Literal, Self, get_args
from unittest.mock import patch

import zenoh

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Status, Telemetry
from aeroloop.protocol.transport.can_format import CanSettings
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import PORTS
from aeroloop.service.config import ENV_PREFIX, Settings
from aeroloop.service.recording.rolling import parts

RoleName = Literal["controller", "plant", "can-node", "recorder"]
"""In the order of stopping."""

PRELOADED: Final = (
    "aeroloop.service.cli.main", "aeroloop.service.daemon.daemon", "aeroloop.service.daemon.roles",
    "aeroloop.service.recording.recorder", "aeroloop.service.testing.process_group",
    "aeroloop.service.theorem.certificate", "aeroloop.service.viewers.channels",
    "aeroloop.plant_emulator.hosts.can_node", "casadi",  # these modules import it at its first use
)  # fmt: skip
"""Modules that the fork server imports, once for all children: they take over half a second of a core."""
START_WAIT_S: Final = 20.0
STOP_WAIT_S: Final = 10.0
PATIENCE_S: Final = 30.0
"""Timeout for a state of the loop: a process starts in about a second here, and CI machines are busy."""

__tracebackhide__ = methodcaller("errisinstance", AeroloopError)  # pytest shows the test's line, not ours


class HilError(AeroloopError):
    """A process did not start or ended early, or the loop did not reach a required state; one line."""

    __module__ = "aeroloop"  # from where users import it, and what pytest prints


def start_command(words: Sequence[str], output: Path, environment: Mapping[str, str] | None = None) -> BaseProcess:
    """Run `aeroloop` with these words in a process and a session of its own; its stderr goes to the end of a file.

    With additions to the environment, even none, it is a new interpreter: the dynamic linker reads them at its start.
    Variables of the configuration are not passed on.
    """
    multiprocessing.set_forkserver_preload([*PRELOADED])
    context: Any = multiprocessing.get_context("forkserver" if environment is None else "spawn")
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(ENV_PREFIX)}
    process: BaseProcess = context.Process(
        target=_run_command, args=([*words], output, inherited | dict(environment or {})), daemon=True
    )
    # NumPy would start threads at its import, before the command blocks the signals that its own thread waits for.
    with patch.dict(os.environ, {"OPENBLAS_NUM_THREADS": "1", **(environment or {})}):
        resource_tracker.ensure_running()  # it ends with SIGINT unblocked
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the server inherits it: ^C is not for it
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return process


def _run_command(words: list[str], output: Path, environment: Mapping[str, str]) -> None:
    os.setsid()
    with output.open("ab") as stderr, open(os.devnull, "wb") as null:
        os.dup2(null.fileno(), 1)
        os.dup2(stderr.fileno(), 2)
    os.environ.clear()
    os.environ.update(environment)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # in the thread, which handles none
    Thread(target=_follow_parent, daemon=True).start()
    signal.pthread_sigmask(signal.SIG_SETMASK, before - {signal.SIGINT})
    sys.argv[1:] = words
    run_module("aeroloop", run_name="__main__")


def _follow_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def free_rendezvous(protocol: Literal["tcp", "tls"] = "tcp") -> str:
    """A loopback endpoint with free ports from it on, which no other call returns while this process lives.

    Why a UDP socket: it reserves the block against other processes that look for one, and leaves its TCP ports free.
    """
    while True:
        first = randrange(10_000, 32_000, PORTS)  # noqa: S311  # no secret; below those that the system gives out
        reservation = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with suppress(OSError):
            reservation.bind(("127.0.0.1", first))
            for port in range(first, first + PORTS):
                socket.create_server(("127.0.0.1", port)).close()
            reservation.detach()  # stays bound until this process ends
            return f"{protocol}/127.0.0.1:{first}"
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

    `controller` are keys of `[controller]`. Raises HilError if the log exists.
    """
    if parts(log):
        raise HilError(f"{log} exists, and a log is never written over; name another with --log PATH")
    controller = {"require_recorder": True, "auto_arm": True, "after_restart": "configured", **controller}
    return settings.model_copy(
        update={
            "network": settings.network.model_copy(update={"rendezvous": [free_rendezvous()], "mode": "peer"}),
            "controller": settings.controller.model_copy(update=controller),
            "can": private_bus(settings.can),
            "recorder": settings.recorder.model_copy(update={"path": log.absolute()}),
        }
    )


class ProcessGroup:
    """Processes of one network and one configuration on this machine. A context: leaving it stops them all.

    Their configuration and output, a text file each, are kept in the folder if one is given; `zenoh` is a session on
    their network. The last status of each role, every event and the last telemetry are collected as they are received.
    """

    def __init__(self, settings: Settings, folder: Path | None = None) -> None:
        self._cleanup = ExitStack()
        self._folder = folder or Path(self._cleanup.enter_context(tempfile.TemporaryDirectory(prefix="aeroloop-")))
        self._folder.mkdir(parents=True, exist_ok=True)
        # A stop or a trip outlives its process here, and surprises no other group.
        plant = settings.plant.model_copy(update={"state_directory": self._folder.absolute() / "state"})
        self.settings = settings = settings.model_copy(update={"plant": plant})
        self._config = self._folder / "aeroloop.toml"
        self._config.write_text(settings.toml())
        self._children: dict[str, BaseProcess] = {}
        self._alive: set[str] = set()
        self._killed: set[str] = set()  # stopped by `stop`, so an exit code is no failure
        self._changed = Condition()
        self.closed = False
        self.statuses: dict[str, Status] = {}
        self.events: list[Event] = []
        self.telemetry: Telemetry | None = None
        self.zenoh = join(settings.network)  # listens, so that a process links to it as it starts
        for topic in ("status", "event", "telemetry"):
            self.zenoh.declare_subscriber(topics.key(topic, settings.vehicle), self._receive)
        self.zenoh.liveliness().declare_subscriber(topics.key("alive", settings.vehicle), self._receive, history=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop all processes; a second call does nothing."""
        if not self.closed:
            self.closed = True
            for role in get_args(RoleName):
                if role in self._children:
                    self.stop(role)
            self.zenoh.close()
            self._cleanup.close()

    def start_loop(
        self, *, drive: bool = True, own_node: bool = False, environment: Mapping[str, str] | None = None
    ) -> None:
        """Start recorder, plant end, an emulated node on the CAN bus if there is to be one, and a controller.

        Waits for recorder and plant.

        Args:
            drive: Whether to start a controller.
            own_node: Whether to start a `can-node`. Never where a real node may be on the bus.
            environment: Environment variables of the processes, instead of a fork with this process's imports.
        """
        roles: list[RoleName] = ["recorder", "plant"]
        if own_node:
            roles.insert(1, "can-node")
        if drive:
            roles.append("controller")
        for role in roles:
            self.start(role, environment=environment)
        self.await_role("recorder")
        self.await_role("plant")

    def start(self, role: RoleName, *arguments: str, environment: Mapping[str, str] | None = None) -> BaseProcess:
        """Start a role, with further words of its command line; `await_role` waits until it is on the network."""
        words = [role, "--config", str(self._config), *arguments]
        self._children[role] = start_command(words, self._output(role), environment)
        self._killed.discard(role)
        return self._children[role]

    def await_role(self, role: RoleName) -> None:
        """Wait for a role's liveliness token. Raises HilError if it ends, or does not join in time."""
        self.eventually(f"the {role} joins the network", lambda: role in self._alive, START_WAIT_S)

    def eventually(self, what: str, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        """Wait until a condition on the loop holds. Raises HilError if it does not in time, or a process failed."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not condition():
                self.check()
                if time.monotonic() > deadline:
                    last = [f"; {event.role} {event.kind}: {event.text}" for event in self.events[-3:]]
                    states = self.states or "no status was received"
                    raise HilError(f"not within {timeout_s:g} s: {what} ({states}{''.join(last)})")
                self._changed.wait(0.05)

    @property
    def states(self) -> str:
        """The state of each role, in one line."""
        return ", ".join(f"{role} {status.state}" for role, status in sorted(self.statuses.items()))

    def state(self, role: str) -> str | None:
        """The state in a role's last status; None before the first."""
        return self.statuses[role].state if role in self.statuses else None

    def running(self, role: RoleName) -> bool:
        """Whether a started role still runs."""
        return self._children[role].is_alive()

    def stop(self, role: RoleName, how: signal.Signals = signal.SIGTERM) -> int | None:
        """Stop a role and wait for its end; kill it after `STOP_WAIT_S`. Returns its exit code."""
        self._killed.add(role)
        self.signal(role, how)
        self.signal(role, signal.SIGCONT)  # a paused process handles no other signal
        child = self._children[role]
        child.join(STOP_WAIT_S)
        if child.is_alive():
            child.kill()
            child.join()
        return child.exitcode

    def signal(self, role: RoleName, which: signal.Signals) -> None:
        """Send a signal to a started role, unless it has ended."""
        if self.running(role):
            with suppress(ProcessLookupError):  # ended, and its exit code is on the way
                os.kill(self.pid(role), which)

    def pid(self, role: RoleName) -> int:
        """Process id of a started role."""
        return self._children[role].pid or 0

    def check(self) -> None:
        """Raise HilError, with its last warning or error, if any process has failed."""
        for role, child in self._children.items():
            if child.exitcode and role not in self._killed:
                lines = self._output(role).read_text(errors="replace").strip().splitlines()
                last = next((f": {line}" for line in reversed(lines) if " INFO " not in line), "")
                failure = HilError(f"the {role} ended with exit code {child.exitcode}{last}")
                failure.exit_code = 2 if child.exitcode == 2 else 1  # its configuration is wrong
                raise failure

    def _output(self, role: str) -> Path:
        return self._folder / f"{role}.txt"

    def _receive(self, sample: zenoh.Sample) -> None:
        address, content = topics.read_key(str(sample.key_expr)), sample.payload.to_bytes()
        if address is None:
            return
        with self._changed:
            match address.topic.name:
                case "status":
                    status = Status.model_validate_json(content)
                    self.statuses[status.role] = status
                case "event":
                    self.events.append(Event.model_validate_json(content))
                case "telemetry":
                    self.telemetry = Telemetry.model_validate_json(content)
                case "alive" if sample.kind == zenoh.SampleKind.PUT:
                    self._alive.add(address.role or "")
                case "alive":
                    self._alive.discard(address.role or "")
            self._changed.notify_all()
