"""Node: a process's presence on the network, with description, status, events, requests and liveliness."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from contextvars import ContextVar, copy_context
from functools import partial
from typing import Any, Final, Self, TypeVar

import zenoh
from zenoh.handlers import RingChannel

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Description, Event, EventKind, Status
from aeroloop.protocol.messages.operator import MAX_VALUES, Answer, Message, MessageError
from aeroloop.protocol.messages.states import STOPPED
from aeroloop.protocol.runtime.host import host_facts, name_process, versions
from aeroloop.protocol.runtime.stderr_log import dropped_lines
from aeroloop.protocol.runtime.timing import Clock, Throttle
from aeroloop.protocol.transport.history import ADDED_BYTES, CachedPublisher
from aeroloop.protocol.transport.network import COMMAND_S, FrameSession, command_session, join, route
from aeroloop.protocol.transport.network_settings import Identity, NetworkError, NetworkSettings, protected

M = TypeVar("M", bound=Message)
Action = Callable[[], object]  # a function to run between two ticks

AT_ONCE: Final = 8  # actions that run between two ticks; the others wait
WAITING: Final = 64  # queries that may wait to be answered between ticks; more are refused
LONG_S: Final = 10.0  # least time between two requests of a topic that take longer than a fraction of a tick to parse
ASKER_LENGTH: Final = 100  # most characters of an operator's name
ASKED_BY: Final = ContextVar("asked by", default="")
"""The operator that asked for what is done now, as a name for people to read, which nothing authenticates."""
GHOST_S: Final = 3.0  # how long the token of a plant that does not answer has to disappear
GHOST_POLL_S: Final = 0.1
_RECENT_S: Final = 10.0
_GRAVE: Final = ("tripped", "lost", "fault", "refused")

log: Final = logging.getLogger("aeroloop")


def notify_systemd(state: str) -> None:
    """Notify the service manager if `NOTIFY_SOCKET` is set (sd_notify(3)); failures are ignored."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager, suppress(OSError):
        manager.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


def log_event(event: Event, vehicle: str | None) -> None:
    """Log an event, with `event` (its kind), `role`, `vehicle`, `session` and `tick` as attributes of the record."""
    level = logging.WARNING if event.kind in _GRAVE else logging.INFO
    fields = event.model_dump(include={"role", "session", "tick"})
    log.log(level, event.text, extra={"event": event.kind, "vehicle": vehicle, **fields})


def _asker(query: zenoh.Query) -> str:
    """The operator in a query's attachment; empty if it has none, or none to print."""
    with suppress(UnicodeDecodeError):
        name = query.attachment.to_bytes().decode() if query.attachment else ""
        return name if len(name) <= ASKER_LENGTH and name.isprintable() else ""
    return ""


class EncodedOnce:
    """Encodes messages; the last one, as long as it is the same object, only once. For any thread."""

    def __init__(self) -> None:
        self._last: tuple[Message, bytes] | None = None

    def bytes_of(self, message: Message) -> bytes:
        """The message as JSON."""
        last = self._last
        if last is None or last[0] is not message:
            last = message, message.encode()
            self._last = last
        return last[1]


class Node:
    """A process's presence on the network: answers for its description and status, and publishes what its owner says.

    `role` is `plant`, `controller`, `recorder` or `router`, `vehicle` the vehicle in the keys of its topics, `config`
    its effective configuration, for the description. `name` is its liveliness token's; the role's if None. Its owner
    runs until `stop` is set, by `clock`. Leaving it closes the Zenoh session, without which a Python process would not
    end. Errors are those of `join`, and NetworkError for a vehicle's second plant.
    """

    def __init__(
        self,
        role: str,
        vehicle: str,
        network: NetworkSettings,
        config: dict[str, Any],
        name: str | None = None,
        stop: threading.Event | None = None,
        clock: Clock = time,
    ) -> None:
        self.role = role
        self.vehicle = vehicle
        self.name = name or role
        self.stop = stop or threading.Event()
        self.clock = clock
        if role == "plant":
            _refuse_second_plant(network, vehicle)
        name_process(role)
        identity = Identity((role,), vehicle)
        certificate = protected(network, identity).certificate
        self._certificate_until = certificate and certificate.not_after
        self.zenoh = (route if role == "router" else join)(network, identity)
        self.datagrams = FrameSession(network, identity)
        self.process = f"{socket.gethostname()}, pid {os.getpid()}"
        self._publishers: dict[str, CachedPublisher] = {}
        self._inbox: deque[Action] = deque()
        self._queued = threading.Event()  # set with every action; `wait_for_inbox` clears it
        self._long = Throttle(LONG_S, clock)
        self._last: tuple[float, Status] | None = None  # status, and when it was taken; another thread reads it
        self._skipped: deque[tuple[float, int]] = deque()  # of the last `_RECENT_S`, by time
        self._throttle = Throttle(clock=clock)
        self._started = clock.monotonic()
        self.publish_description(config)
        self._answer("description", lambda: self._description)
        self._answer("status", self._aged_status)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        notify_systemd("STOPPING=1")
        self.datagrams.close()
        self.zenoh.close()

    @property
    def uptime_s(self) -> float:
        """Seconds since the node joined."""
        return self.clock.monotonic() - self._started

    # ── requests ──

    def serve(
        self,
        topic: str,
        model: type[M],
        prepare: Callable[[M], Callable[[], Message] | Message],
        *,
        by_datagrams: bool = False,
    ) -> None:
        """Answer a topic's queries between ticks: when the owner of the loop calls `take_inbox`.

        A query whose key expression does not end with the topic's name, or that is longer than the topic's requests,
        is not answered and changes nothing. Of requests that take milliseconds to parse, one in `LONG_S` is parsed.
        `prepare` is called with the request in a thread of the topic's, for work that takes time; the function that it
        returns runs between ticks and returns the reply. An AeroloopError from either is the reply. Both run in the
        context of the operator in the query's attachment, `ASKED_BY`. A message that `prepare` returns instead is the
        reply, sent at once; however often the same one is asked for, it is encoded once.

        With `by_datagrams` the session of the frames answers, too, if it listens by now: a flood of TCP connections
        keeps no newcomer from it.
        """
        key = topics.key(topic, self.vehicle)
        name = key.rpartition("/")[2]
        encoded = EncodedOnce()

        def reply(query: zenoh.Query, work: Callable[[], Message | None]) -> None:
            try:
                answer = work()
            except AeroloopError as error:
                answer = Answer(done=False, text=str(error))
            if answer is not None:
                query.reply(key, encoded.bytes_of(answer))  # not the query's key, which may name many vehicles
                query.drop()

        def received(query: zenoh.Query) -> None:
            payload = query.payload.to_bytes() if query.payload else b"{}"
            named = str(query.key_expr).endswith(f"/{name}")  # `**`, by which tools list a network, names no verb
            if not named or len(payload) > topics.TOPICS[topic].request:  # wildcards pass Zenoh's filter of lengths
                query.drop()
                return

            def accept() -> Message | None:
                if len(self._inbox) >= WAITING:
                    raise MessageError(f"{WAITING} requests wait already; ask again")
                prepared = prepare(self._read(topic, model, payload))
                if isinstance(prepared, Message):
                    return prepared
                self.enqueue(lambda: reply(query, prepared))
                return None

            asked = ASKED_BY.set(_asker(query))
            try:
                reply(query, accept)
            finally:
                ASKED_BY.reset(asked)

        self.zenoh.declare_queryable(key, received, complete=True)
        if by_datagrams and self.datagrams.session is not None:
            self.datagrams.session.declare_queryable(key, received, complete=True)

    def _read(self, topic: str, model: type[M], payload: bytes) -> M:
        """Read a request. Raises MessageError."""
        short = len(payload) <= topics.MESSAGE_BYTES and payload.count(b",") <= MAX_VALUES
        may_be_long = topics.TOPICS[topic].request > topics.MESSAGE_BYTES
        if may_be_long and not short and self._long.let_pass(topic) is None:
            raise MessageError(f"of requests as long as this one, one in {LONG_S:g} s is taken; ask again")
        return model.decode(payload)

    def enqueue(self, action: Action) -> None:
        """Queue an action to run between two ticks; may be called from any thread."""
        self._inbox.append(partial(copy_context().run, action))
        self._queued.set()

    def wait_for_inbox(self, timeout_s: float) -> None:
        """Wait until an action is queued, at most so long [s]."""
        if not self._inbox:
            self._queued.wait(timeout_s)
        self._queued.clear()

    def take_inbox(self) -> bool:
        """Run the oldest `AT_ONCE` of the queued actions; whether there were any."""
        waiting = min(AT_ONCE, len(self._inbox))
        for _ in range(waiting):
            self._inbox.popleft()()
        return waiting > 0

    # ── liveliness ──

    def announce(self) -> None:
        """Declare the liveliness token. A link keeps order: a peer that sees it has all earlier declarations.

        A plant that takes frames by datagrams is seen there, too, by an operator that no TCP port lets in.
        """
        notify_systemd("READY=1")
        key = topics.key("alive", self.vehicle, role=self.name)
        self._tokens = [self.zenoh.liveliness().declare_token(key)]
        if self.datagrams.session is not None:
            self._tokens.append(self.datagrams.session.liveliness().declare_token(key))

    def watch_token(self, name: str, callback: Callable[[bool], None]) -> Callable[[], None]:
        """Call back when a node's liveliness token appears (True) and disappears, in a thread of its own.

        Returns the end of it. Zenoh merges tokens of one name: the first appears, the last disappears.
        """
        key = topics.key("alive", self.vehicle, role=name)

        def seen(sample: zenoh.Sample) -> None:
            if str(sample.key_expr) == key:  # a token may have wildcards
                callback(sample.kind == zenoh.SampleKind.PUT)

        return self.zenoh.liveliness().declare_subscriber(key, seen, history=True).undeclare

    def _answer(self, topic: str, payload: Callable[[], bytes | None]) -> None:
        """Answer queries for a message of this node at any time, also while its loop hangs."""
        key = topics.key(topic, self.vehicle, role=self.role)

        def received(query: zenoh.Query) -> None:
            if (answer := payload()) is not None:
                query.reply(key, answer)

        self.zenoh.declare_queryable(key, received, complete=True)

    # ── publications ──

    def declare(self, topic: str, *, lossless: bool = False) -> None:
        """Declare a topic's publisher before its first message."""
        key, json = topics.key(topic, self.vehicle, role=self.role), topics.TOPICS[topic].kind == "json"
        self._publishers[topic] = CachedPublisher(self.zenoh, key, lossless=lossless, json=json)

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
            self.declare(topic)
        self._publishers[topic].put(payload)

    def publish_description(
        self, config: dict[str, Any], certificate: dict[str, Any] | None = None, law: dict[str, str] | None = None
    ) -> None:
        """Publish the description: effective configuration; of a controller its certificate and its law's version."""
        self._description = Description(
            protocol=PROTOCOL_VERSION,
            role=self.role,
            vehicle=self.vehicle,
            host=socket.gethostname(),
            versions=versions() | (law or {}),
            facts=host_facts() | {"process": self.process},
            config=config,
            certificate=certificate,
        ).encode()
        self.publish_bytes("description", self._description)

    def status(self, status: Status) -> None:
        """Publish the status, with ticks skipped in the last 10 s, and answer queries with it until the next one."""
        notify_systemd("WATCHDOG=1")
        now = self.clock.monotonic()
        self._skipped.append((now, status.skipped))
        while now - self._skipped[0][0] > _RECENT_S:
            self._skipped.popleft()
        more: dict[str, Any] = {
            "recent_skipped": status.skipped - self._skipped[0][1],
            "certificate_until": self._certificate_until,
            "process": self.process,
        }
        if dropped := dropped_lines():
            more["notes"] = [*status.notes, f"the log: {dropped} lines were dropped, as nothing reads stderr"]
        status = status.model_copy(update=more)
        self._last = now, status
        self.publish("status", status)

    def _aged_status(self) -> bytes | None:
        """The last status with its age, which shows a loop that hangs; None before the first."""
        if self._last is None:
            return None
        taken, status = self._last
        return status.model_copy(update={"age_s": round(self.clock.monotonic() - taken, 3)}).encode()

    def event(self, kind: EventKind, text: str, session: str | None = None, tick: int | None = None) -> None:
        """Publish and log an event, with the session's tick if there is one."""
        by = ASKED_BY.get()
        text = f"{text} (by {by})" if by and by not in text else text
        event = Event(role=self.role, kind=kind, text=text, session=session, tick=tick)
        log_event(event, self.vehicle)
        self.publish("event", event)

    def warn(self, about: str, kind: EventKind, text: str, session: str | None = None, tick: int | None = None) -> None:
        """Publish an event that may recur for long: at most once in ten seconds for each `about`."""
        held_back = self._throttle.let_pass(about)
        if held_back is not None:
            more = f" ({held_back} more like it in the last {self._throttle.period_s:g} s)" if held_back else ""
            self.event(kind, text + more, session, tick)


def _refuse_second_plant(network: NetworkSettings, vehicle: str) -> None:
    """Raise NetworkError if a plant of this vehicle is on the network.

    On a busy machine the others may still have the token of a plant that has just ended: their links to it end later
    than its process. So a token whose plant does not answer gets `GHOST_S` to disappear.
    """
    with command_session(network, identity=Identity(("plant",), vehicle), patient=True) as here:
        here.wait_for_links()
        deadline = time.monotonic() + GHOST_S
        process = None
        while _has_token(here.session, vehicle):
            process = _process_of_plant(here.session, vehicle)
            if process is not None or time.monotonic() > deadline:
                break
            time.sleep(GHOST_POLL_S)
        else:
            return
    answer = f"({process})" if process else "(which does not answer: it may be halted)"
    remedy = "stop that one, or give this one a name of its own with --set vehicle=NAME"
    raise NetworkError(f"{vehicle} has a plant already {answer}; {remedy}")


def _has_token(session: zenoh.Session, vehicle: str) -> bool:
    """Whether anyone on the network knows of a plant of this vehicle."""
    replies = session.liveliness().get(topics.key("alive", vehicle, role="plant"), timeout=COMMAND_S)
    return any(reply.ok is not None for reply in replies)


def _process_of_plant(session: zenoh.Session, vehicle: str) -> str | None:
    """Host and pid of a vehicle's plant, by its status; None if it does not answer."""
    for reply in session.get(topics.key("status", vehicle, role="plant"), timeout=COMMAND_S):
        if reply.ok is not None:
            with suppress(MessageError):
                return Status.decode(reply.ok.payload.to_bytes(), extra="ignore").process
    return None


class RecorderWatch:
    """Whether the recorder of a node's vehicle is `present`, by its token, or was there and is `gone`."""

    def __init__(self, node: Node) -> None:
        self.present = False
        self._was_there = self._stopped = False
        key = topics.key("status", node.vehicle, role="recorder")
        self._statuses = node.zenoh.declare_subscriber(key, RingChannel(1))
        node.watch_token("recorder", self._see)

    @property
    def gone(self) -> bool:
        """Whether it was killed or cut off: it disappeared, and its last status does not say that it stopped."""
        if (sample := self._statuses.try_recv()) is not None:
            with suppress(MessageError):
                self._stopped = Status.decode(sample.payload.to_bytes(), extra="ignore").state == STOPPED
        return self._was_there and not self.present and not self._stopped

    def _see(self, appeared: bool) -> None:
        self.present = appeared
        self._was_there |= appeared
