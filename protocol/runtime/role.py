"""Role: a process's presence on the network, with description, status, events and liveliness.

A Role joins the network and answers queries for its description and status. Its owner declares the liveliness token
once ready, and publishes through it. It is a context manager: leaving it closes the Zenoh session, without which a
Python process would not end.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Self, TypeVar

import zenoh
from pydantic import ValidationError
from zenoh.handlers import RingChannel

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description, Event, EventKind, Status
from aeroloop.protocol.messages.operator import MAX_VALUES, Answer, Message, MessageError
from aeroloop.protocol.messages.states import STOPPED
from aeroloop.protocol.runtime.event_log import log_event
from aeroloop.protocol.runtime.host_facts import host_facts, versions
from aeroloop.protocol.runtime.processes import name_process
from aeroloop.protocol.runtime.throttle import Throttle
from aeroloop.protocol.transport.datagrams import Datagrams
from aeroloop.protocol.transport.history import ADDED_BYTES, CachedPublisher
from aeroloop.protocol.transport.network import VISIT_S, join, visit
from aeroloop.protocol.transport.network_settings import NetworkSettings, protected
from aeroloop.protocol.transport.router import route
from aeroloop.protocol.transport.security import Identity
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec

M = TypeVar("M", bound=Message)
_RECENT_S: Final = 10.0
_SELDOM_PER_S: Final = 8.0
"""Cached messages per second of a topic that was not declared beforehand: statuses, events."""

AT_ONCE: Final = 8
"""Actions that run between two ticks; the others wait."""
WAITING: Final = 64
"""Queries that may wait to be answered between ticks; more are refused."""
LONG_S: Final = 10.0
"""Least time between two requests of a topic that are too long to be parsed in a fraction of a tick [s]."""

Action = Callable[[], object]
"""A function to run between two ticks."""


def notify_systemd(state: str) -> None:
    """Notify the service manager if `NOTIFY_SOCKET` is set (sd_notify(3)); failures are ignored."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager, suppress(OSError):
        manager.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


class OccupiedError(AeroloopError):
    """The vehicle has a plant already; one line that names it."""


def _refuse_second_plant(network: NetworkSettings, vehicle: str) -> None:
    with visit(network, identity=Identity(("plant",), vehicle), patient=True) as here:
        here.settle()
        if not list(here.session.liveliness().get(topics.key("alive", vehicle, role="plant"), timeout=VISIT_S)):
            return
        where = ""
        for reply in here.session.get(topics.key("status", vehicle, role="plant"), timeout=VISIT_S):
            if reply.ok is not None:
                with suppress(ValidationError):
                    where = f" ({Status.model_validate_json(reply.ok.payload.to_bytes()).process})"
    raise OccupiedError(
        f"{vehicle} has a plant already{where}; stop that one, or give this one a name of its own with "
        "--set vehicle=NAME"
    )


class Role:
    """A process's presence on the network.

    `role` is `plant`, `controller`, `recorder` or `router`, `vehicle` the vehicle in the keys of its topics, `config`
    its effective configuration, for the description. `name` is its liveliness token's; the role's if None. Its owner
    runs until `stop` is set.

    Raises:
        NetworkError: The network cannot be joined.
        SecurityError, CertificateError: Its links cannot be secured.
        OccupiedError: It is a plant's, and the vehicle has one.
    """

    def __init__(
        self,
        role: str,
        vehicle: str,
        network: NetworkSettings,
        config: dict[str, Any],
        name: str | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        self.role = role
        self.vehicle = vehicle
        self.name = name or role
        self.stop = stop or threading.Event()
        if role == "plant":
            _refuse_second_plant(network, vehicle)
        name_process(role)
        identity = Identity((role,), vehicle)
        certificate = protected(network, identity).certificate
        self._certificate_until = certificate.not_after if certificate else None
        self.zenoh = (route if role == "router" else join)(network, identity)
        self.datagrams = Datagrams(network, identity)
        self.process = f"{socket.gethostname()}, pid {os.getpid()}"
        self._status: tuple[float, Status] | None = None  # when it was taken
        self._skipped: deque[tuple[float, int]] = deque()  # of the last `_RECENT_S`, by time
        self._publishers: dict[str, CachedPublisher] = {}
        self._inbox: deque[Action] = deque()
        self._throttle = Throttle()
        self._long = Throttle(LONG_S)
        self._started = time.monotonic()
        self.own_versions: dict[str, str] = {}  # of a user's classes that it runs, for its description
        self.publish_description(config)
        key = topics.key("description", vehicle, role=role)
        self.answer(key, lambda query: query.reply(key, self._description))
        self.answer(topics.key("status", vehicle, role=role), self._answer_status)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        notify_systemd("STOPPING=1")
        self.datagrams.close()
        self.zenoh.close()

    def announce(self) -> None:
        """Declare the liveliness token. A link keeps order: a peer that sees it has all earlier declarations."""
        notify_systemd("READY=1")
        self._token = self.zenoh.liveliness().declare_token(topics.key("alive", self.vehicle, role=self.name))

    def publish_description(self, config: dict[str, Any], certificate: dict[str, Any] | None = None) -> None:
        """Publish the role's description: its effective configuration and, from a controller, its certificate."""
        freshness_s = None
        if "wire" in config and "loop" in config:
            period_ns = LoopSettings.model_validate(config["loop"]).period_ns
            freshness_s = WireSpec.model_validate(config["wire"]).freshness_ns(period_ns) * 1e-9
        self._description = Description(
            protocol=PROTOCOL_VERSION,
            role=self.role,
            vehicle=self.vehicle,
            host=socket.gethostname(),
            versions=versions() | self.own_versions,
            facts=host_facts(),
            config=config,
            freshness_s=freshness_s,
            certificate=certificate,
        ).encode()
        self.publish_bytes("description", self._description)

    @property
    def uptime_s(self) -> float:
        """Seconds since the role joined."""
        return time.monotonic() - self._started

    def answer(self, key: str, callback: Callable[[zenoh.Query], None]) -> None:
        """Answer queries on a key until the role is closed. The callback runs in a thread of its own."""
        self.zenoh.declare_queryable(key, callback, complete=True)

    def serve(self, topic: str, model: type[M], prepare: Callable[[M], Callable[[], Message]]) -> None:
        """Answer a topic's queries between ticks, when the owner calls `take_inbox`.

        A query whose key expression does not end with the topic's name, or that is longer than the topic's requests,
        is not answered and changes nothing. Of requests that take milliseconds to parse, one in `LONG_S` is parsed.

        Args:
            topic: Name of a query in the table.
            model: Model of the request; any other payload is answered by an Answer with the error.
            prepare: Called with the request in a thread of the topic's, for work that takes time. The function that it
                returns runs between ticks and returns the reply. An AeroloopError from either is the reply.
        """
        key = topics.key(topic, self.vehicle)
        name = key.rpartition("/")[2]

        def guarded(query: zenoh.Query, act: Callable[[], Message]) -> None:
            try:
                reply = act()
            except AeroloopError as error:
                reply = Answer(done=False, text=str(error))
            query.reply(key, reply.encode())  # not the query's key, which may name many vehicles
            query.drop()

        def received(query: zenoh.Query) -> None:
            if not str(query.key_expr).endswith(f"/{name}"):  # `**`, by which tools list a network, names no verb
                query.drop()
                return
            payload = query.payload.to_bytes() if query.payload else b"{}"
            if len(payload) > topics.TOPICS[topic].request:  # a key expression with wildcards passes Zenoh's filter
                query.drop()
                return
            try:
                if len(self._inbox) >= WAITING:
                    raise MessageError(f"{WAITING} requests wait already; ask again")
                action = prepare(self._read(topic, model, payload))
            except AeroloopError as error:
                refusal = Answer(done=False, text=str(error))
                guarded(query, lambda: refusal)
            else:
                self._inbox.append(lambda: guarded(query, action))

        self.answer(key, received)

    def _read(self, topic: str, model: type[M], payload: bytes) -> M:
        """Read a request. Raises MessageError."""
        long = len(payload) > topics.MESSAGE_BYTES or payload.count(b",") > MAX_VALUES
        if long and model.max_values > MAX_VALUES and self._long.let_pass(topic) is None:
            raise MessageError(f"of requests as long as this one, one in {LONG_S:g} s is taken; ask again")
        return model.decode(payload)

    def enqueue(self, action: Action) -> None:
        """Queue an action to run between two ticks; may be called from any thread."""
        self._inbox.append(action)

    def take_inbox(self) -> bool:
        """Run the oldest `AT_ONCE` of the queued actions; whether there were any."""
        inbox = self._inbox
        if not inbox:
            return False
        for _ in range(min(AT_ONCE, len(inbox))):
            inbox.popleft()()
        return True

    def watch_token(self, name: str, callback: Callable[[bool], None]) -> Callable[[], None]:
        """Call back when a role's liveliness token appears (True) and disappears, in a thread of its own.

        A token of another name calls no Python. Zenoh merges those of one name: the first appears, the last disappears.

        Returns:
            Ends it.
        """
        key = topics.key("alive", self.vehicle, role=name)

        def seen(sample: zenoh.Sample) -> None:
            if str(sample.key_expr) == key:  # a token may have wildcards
                callback(sample.kind == zenoh.SampleKind.PUT)

        return self.zenoh.liveliness().declare_subscriber(key, seen, history=True).undeclare

    def declare(self, topic: str, per_s: float, *, lossless: bool = False) -> None:
        """Declare a topic's publisher before its first message."""
        kind = topics.TOPICS[topic].kind
        self._publishers[topic] = CachedPublisher(
            self.zenoh,
            topics.key(topic, self.vehicle, role=self.role),
            per_s,
            lossless=lossless,
            encoding=zenoh.Encoding.APPLICATION_JSON if kind == "json" else zenoh.Encoding.ZENOH_BYTES,
        )

    def publish(self, topic: str, message: Message) -> None:
        """Publish a message on one of the table's JSON topics."""
        self.publish_bytes(topic, message.encode())

    def publish_bytes(self, topic: str, payload: bytes) -> None:
        """Publish on one of the table's topics of JSON or traces; what exceeds the topic's limit is not published."""
        limit = topics.TOPICS[topic].limit - ADDED_BYTES
        if len(payload) > limit:
            self.warn(topic, "fault", f"a {topic} of {len(payload)} bytes is not published: at most {limit} may be")
            return
        if topic not in self._publishers:
            self.declare(topic, _SELDOM_PER_S)
        self._publishers[topic].put(payload)

    def event(self, kind: EventKind, text: str, session: str | None = None, tick: int | None = None) -> None:
        """Publish and log an event, with the session's tick if there is one."""
        event = Event(role=self.role, kind=kind, text=text, session=session, tick=tick)
        log_event(event, self.vehicle)
        self.publish("event", event)

    def warn(self, about: str, kind: EventKind, text: str, session: str | None = None, tick: int | None = None) -> None:
        """Publish an event that may recur for long: at most once in ten seconds for each `about`."""
        held_back = self._throttle.let_pass(about)
        if held_back is not None:
            more = f" ({held_back} more like it in the last {self._throttle.period_s:g} s)" if held_back else ""
            self.event(kind, text + more, session, tick)

    def status(self, status: Status) -> None:
        """Publish the status, and answer queries with it until the next one."""
        notify_systemd("WATCHDOG=1")
        now, skipped = time.monotonic(), self._skipped
        skipped.append((now, status.skipped))
        while now - skipped[0][0] > _RECENT_S:
            skipped.popleft()
        recent = status.skipped - skipped[0][1]
        status = status.model_copy(
            update={
                "process": self.process,
                "recent_skipped": recent,
                "certificate_until": self._certificate_until,
            }
        )
        self._status = now, status
        self.publish("status", status)

    def _answer_status(self, query: zenoh.Query) -> None:
        """Answer with the last status and its age, which shows a loop that hangs: the thread that answers does not."""
        if self._status is not None:
            taken, status = self._status
            aged = status.model_copy(update={"age_s": round(time.monotonic() - taken, 3)})
            query.reply(topics.key("status", self.vehicle, role=self.role), aged.encode())


class RecorderWatch:
    """Whether the recorder of a role's vehicle is there, or was there and is gone, killed or cut off.

    Attributes:
        present: Whether its liveliness token is there.
    """

    def __init__(self, role: Role) -> None:
        self.present = False
        self._was_there = self._stopped = False
        key = topics.key("status", role.vehicle, role="recorder")
        self._statuses = role.zenoh.declare_subscriber(key, RingChannel(1))
        role.watch_token("recorder", self._see)

    @property
    def gone(self) -> bool:
        """Whether it disappeared and its last status does not say that it stopped."""
        if (sample := self._statuses.try_recv()) is not None:
            with suppress(MessageError):
                self._stopped = Status.decode(sample.payload.to_bytes(), extra="ignore").state == STOPPED
        return self._was_there and not self.present and not self._stopped

    def _see(self, appeared: bool) -> None:
        self.present = appeared
        self._was_there |= appeared
