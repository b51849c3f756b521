"""Topics: the one table of what crosses the network, with keys, roles, models and sizes.

Frames travel under the session's own keys, so that frames of another controller, or of another wire spec, cannot
arrive. A network with certificates takes its access rules from here (transport/zenoh_config.py).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, get_args

from aeroloop.protocol.messages.models import (
    Claim,
    Description,
    Event,
    Loss,
    Release,
    SessionRecord,
    Status,
    Telemetry,
    Truth,
)
from aeroloop.protocol.messages.operator import Advance, Gains, Inject, Mark, Message, Setpoint, Track

ROOT: Final = "aeroloop"
RoleName = Literal["plant", "controller", "operator", "observer", "recorder"]
"""What a process does on the network: a daemon of that name, or a command with that right."""
_Roles = tuple[RoleName, ...]
ROLES: Final[_Roles] = get_args(RoleName)
Action = Literal["publish", "subscribe", "query", "answer", "hold", "watch"]
"""What a role does with a topic; a liveliness token is held and watched."""

_PLANT: Final[_Roles] = ("plant",)
_CONTROLLER: Final[_Roles] = ("controller",)
_OPERATOR: Final[_Roles] = ("operator",)
_RECORDER: Final[_Roles] = ("recorder",)
_ENDS: Final = _PLANT + _CONTROLLER
_DAEMONS: Final = _ENDS + _RECORDER
_READERS: Final[_Roles] = ("operator", "observer", "recorder")

NAME: Final = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"
"""Pattern of a vehicle's name: one chunk of a Zenoh key, and safe in a file name."""
QUERIES_PER_S: Final = 50.0
"""Most queries a second that a process takes on a topic from one link. Zenoh applies any rule that a wildcard meets."""

FRAME_BYTES: Final = 256  # more than the longest frame: eight elements of 64 bits and a counter
SAMPLE_BYTES: Final = 2048  # one tick's telemetry or truth
MESSAGE_BYTES: Final = 16_384  # an event of many lines
STATUS_BYTES: Final = 65_536  # a status with all notes and twice as many faults as may act at a time
POINTS_BYTES: Final = 2_097_152  # references of `MAX_POINTS` points: in descriptions, requests to track, traces' tails


@dataclass(frozen=True)
class Topic:
    """One row of the table."""

    name: str  # in this program
    key: str  # below `aeroloop/<vehicle>/`; `{session}` and `{role}` are filled in
    kind: Literal["frame", "trace", "json", "query", "token"]  # bits, batches, a model, request and reply, liveliness
    senders: _Roles  # publish it, hold it or query by it; under their own role where the key has one
    receivers: _Roles  # subscribe to it, watch it or answer it
    model: type[Message] | None = None  # of its messages or requests, if they are JSON
    decoded: Literal["always", "limited"] | None = None  # for viewers, always or at most at the limited rate
    limit: int = MESSAGE_BYTES  # most bytes of what is published or answered; what is longer is not received either
    request: int = MESSAGE_BYTES  # most bytes of a query, likewise

    @property
    def recorded(self) -> bool:
        """Whether it is published from a cache and recorded: a subscriber that joins late recovers earlier messages."""
        return self.kind in ("trace", "json")

    @property
    def answered(self) -> bool:
        """Whether roles answer queries on it."""
        return self.kind == "query" or self.name in ("description", "status")


TOPICS: Final = {
    topic.name: topic
    for topic in (
        Topic("claim", "claim", "query", _CONTROLLER, _PLANT, Claim, limit=POINTS_BYTES),
        Topic("release", "release", "query", _CONTROLLER, _PLANT, Release),
        Topic("record", "record", "query", _CONTROLLER, _PLANT, SessionRecord, request=POINTS_BYTES),
        Topic("arm", "arm", "query", _OPERATOR, _PLANT),
        Topic("stop", "stop", "query", _OPERATOR, _PLANT),
        Topic("forward_stop", "forward-stop", "query", _OPERATOR, _CONTROLLER),
        Topic("forwarded_stop", "forwarded-stop", "query", _CONTROLLER, _PLANT),
        Topic("stand_down", "stand-down", "query", _OPERATOR, _CONTROLLER),
        Topic("recall", "recall", "query", _OPERATOR, _CONTROLLER),
        Topic("show", "show", "query", _READERS, _ENDS, limit=POINTS_BYTES),
        Topic("mark", "mark", "query", _OPERATOR, _PLANT, Mark),
        Topic("set_gains", "set-gains", "query", _OPERATOR, _CONTROLLER, Gains),
        Topic("track", "track", "query", _OPERATOR, _CONTROLLER, Track, request=POINTS_BYTES),
        Topic("inject", "inject", "query", _OPERATOR, _PLANT, Inject),
        Topic("advance", "advance", "query", _OPERATOR, _PLANT, Advance),
        Topic("description", "description/{role}", "json", _DAEMONS, _READERS, Description, limit=POINTS_BYTES),
        Topic("measurement", "{session}/measurement", "frame", _PLANT, _CONTROLLER + _READERS, limit=FRAME_BYTES),
        Topic("command", "{session}/command", "frame", _CONTROLLER, _PLANT + _READERS, limit=FRAME_BYTES),
        Topic("telemetry", "telemetry", "json", _CONTROLLER, _READERS, Telemetry, "limited", SAMPLE_BYTES),
        Topic("trace", "trace/{role}", "trace", _ENDS, _READERS, limit=POINTS_BYTES),
        Topic("reference", "reference", "json", _OPERATOR, _CONTROLLER + _READERS, Setpoint, "limited", SAMPLE_BYTES),
        Topic("truth", "truth", "json", _PLANT, _READERS, Truth, "limited", SAMPLE_BYTES),
        Topic("status", "status/{role}", "json", _DAEMONS, _ENDS + _READERS, Status, "always", STATUS_BYTES),
        Topic("event", "event/{role}", "json", _DAEMONS, _READERS, Event, "always"),
        Topic("loss", "loss", "json", _RECORDER, _READERS, Loss, "always"),
        Topic("alive", "alive/{role}", "token", _DAEMONS, _ENDS + _READERS),
    )
}

RECORDED: Final = tuple(topic.name for topic in TOPICS.values() if topic.recorded)  # topics published from a cache

_Actions = tuple[Action, ...]
_CACHED: Final[tuple[_Actions, _Actions]] = ("publish", "answer"), ("subscribe", "query")
ACTIONS: Final[dict[str, tuple[_Actions, _Actions]]] = {
    "frame": (("publish",), ("subscribe",)),
    "json": _CACHED,
    "trace": _CACHED,
    "query": (("query",), ("answer",)),
    "token": (("hold",), ("watch",)),
}
"""What senders and what receivers do, by a topic's kind. A cache answers queries."""

_CACHE: Final = "/@cache"
_CHUNKS: Final = {"session": "(?P<session>[^/]+)", "role": "(?P<role>[^/]+)"}
_PATTERNS: Final = [
    (topic, re.compile(f"{ROOT}/(?P<vehicle>{NAME})/{topic.key.format(**_CHUNKS)}")) for topic in TOPICS.values()
]


class Address(NamedTuple):
    """Parts of a key."""

    topic: Topic
    vehicle: str
    session: str | None
    role: str | None


def key(name: str, vehicle: str, *, session: str = "*", role: str = "*") -> str:
    """The key of a topic of one vehicle; what is left out becomes a wildcard. Raises KeyError for an unknown topic."""
    return f"{ROOT}/{vehicle}/{TOPICS[name].key.format(session=session, role=role)}"


def cache_key(key: str) -> str:
    """The key below a topic's key on which its cache is queried. No wildcard includes a chunk with an @."""
    return key + _CACHE


def cached_key(key: str) -> str:
    """Inverse of `cache_key`."""
    return key.removesuffix(_CACHE)


def read_key(text: str) -> Address | None:
    """Parse a key; None if it is not in the table."""
    for topic, pattern in _PATTERNS:
        if found := pattern.fullmatch(text):
            parts = found.groupdict()
            return Address(topic, parts["vehicle"], parts.get("session"), parts.get("role"))
    return None
