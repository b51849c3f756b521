"""What every process is on the network: alive, configured, doing well or not, and stoppable.

A Role joins the network, answers questions about its configuration and, once its owner is ready, shows a liveliness
token; the owner publishes status, events and whatever else through it. It is a context: leaving it closes the Zenoh
session, without which a Python process would not end.
"""

from __future__ import annotations

import logging
import os
import platform
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from types import FrameType, TracebackType
from typing import Any, Final, Self

import zenoh

from protocol import topics
from protocol.messages import Contract, Event, EventKind, Message, Status
from protocol.network import NetworkSettings, join

log: Final = logging.getLogger("aeroloop")


def versions() -> dict[str, str]:
    """Versions of what computes the figures in a log."""
    packages = ("aeroloop", "casadi", "eclipse-zenoh", "mcap", "numpy", "pydantic")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def notify_systemd(state: str) -> None:
    """Tell the service manager, if one asked to be told (sd_notify(3)); nobody listening is no error."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager, suppress(OSError):
        manager.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


class Role:
    """A process's presence on the network.

    Args:
        role: `plant`, `controller` or `recorder`.
        vehicle: Whose topics it speaks on.
        network: Where to meet the others.
        config: Its effective configuration, for the contract.
        name: Name of its liveliness token; the role's name if None.

    Raises:
        NetworkError: The network cannot be joined.
    """

    def __init__(
        self, role: str, vehicle: str, network: NetworkSettings, config: dict[str, Any], name: str | None = None
    ) -> None:
        self.role = role
        self.vehicle = vehicle
        self.name = name or role
        self.stop = threading.Event()
        self.zenoh = join(network)
        self._status = b""
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._started = time.monotonic()
        contract = Contract(
            role=role, vehicle=vehicle, host=socket.gethostname(), versions=versions(), config=config
        ).encode()
        key = topics.key("contract", vehicle, role=role)
        self.answer(key, lambda query: query.reply(key, contract))
        status = topics.key("status", vehicle, role=role)
        self.answer(status, lambda query: query.reply(status, self._status) if self._status else None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        notify_systemd("STOPPING=1")
        self.zenoh.close()

    def announce(self) -> None:
        """Show the liveliness token. Declarations keep their order on a link: who sees it knows ours before it too."""
        notify_systemd("READY=1")
        self._token = self.zenoh.liveliness().declare_token(topics.key("alive", self.vehicle, role=self.name))

    def stop_on_signals(self) -> None:
        """SIGTERM and SIGINT set `stop`; the loop ends at its next tick."""

        def ask_to_stop(_signum: int, _frame: FrameType | None) -> None:
            self.stop.set()

        signal.signal(signal.SIGTERM, ask_to_stop)
        signal.signal(signal.SIGINT, ask_to_stop)

    @property
    def uptime_s(self) -> float:
        """Seconds since the role joined."""
        return time.monotonic() - self._started

    def answer(self, key: str, callback: Callable[[zenoh.Query], None]) -> None:
        """Answer queries on a key for as long as the role lives. The callback runs in a thread of Zenoh's."""
        self.zenoh.declare_queryable(key, callback, complete=True)

    def watch_tokens(self, callback: Callable[[str, bool], None]) -> None:
        """Call back with the name of every liveliness token of any role, and whether it came (True) or went (False).

        The callback runs in a thread of Zenoh's.
        """
        alive = topics.TOPICS["alive"]

        def seen(sample: zenoh.Sample) -> None:
            address = topics.read_key(str(sample.key_expr))
            if address is not None and address.topic is alive and address.role is not None:
                callback(address.role, sample.kind == zenoh.SampleKind.PUT)

        self.zenoh.liveliness().declare_subscriber(topics.key("alive", self.vehicle), seen, history=True)

    def publish(self, topic: str, message: Message) -> None:
        """Publish a message on one of the table's JSON topics."""
        publisher = self._publishers.get(topic)
        if publisher is None:
            publisher = self.zenoh.declare_publisher(
                topics.key(topic, self.vehicle, role=self.role), encoding=zenoh.Encoding.APPLICATION_JSON
            )
            self._publishers[topic] = publisher
        publisher.put(message.encode())

    def event(self, kind: EventKind, text: str, session: str | None = None) -> None:
        """Tell, on the network and on stderr, something that happened."""
        log.log(logging.WARNING if kind in ("tripped", "lost", "fault") else logging.INFO, "%s: %s", self.role, text)
        self.publish("event", Event(role=self.role, kind=kind, text=text, session=session))

    def status(self, status: Status) -> None:
        """Tell how the role is doing, now and to whoever asks before the next time."""
        notify_systemd("WATCHDOG=1")
        self._status = status.encode()
        self.publish("status", status)
