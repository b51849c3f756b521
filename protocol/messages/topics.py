"""Topics: the one table of what crosses the network, with keys, senders, rates and models.

Every key starts with `aeroloop/<vehicle>/`. Frames travel under the session's own keys, so that frames of another
controller, or of another wire spec, cannot arrive. Services and the recorder look topics up here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

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
from aeroloop.protocol.messages.operator import Advance, Gains, Inject, Message, Setpoint, Track

ROOT: Final = "aeroloop"
NAME: Final = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"
"""Pattern of a vehicle's name: one chunk of a Zenoh key, and safe in a file name."""


FRAME_BYTES: Final = 256
"""More than the longest frame: six elements of 64 bits and a counter."""
MESSAGE_BYTES: Final = 16_384
"""Enough for an event of many lines."""
STATUS_BYTES: Final = 65_536
"""Enough for a status with all notes and twice as many faults as may act at a time."""
SAMPLE_BYTES: Final = 2048
"""Enough for one tick's telemetry or truth."""
POINTS_BYTES: Final = 2_097_152
"""Enough for what may hold references of `MAX_POINTS` points: descriptions, requests to track, tails of traces."""


@dataclass(frozen=True)
class Topic:
    """One row of the table.

    Attributes:
        name: Name in this program.
        key: Key below `aeroloop/<vehicle>/`; `{session}` and `{role}` are filled in.
        carries: `frame` (bits, see frames.py), `trace` (batches, see trace.py), `json` (a model), `query` (request and
            reply), `token` (liveliness, no payload).
        sender: Role that publishes or queries it.
        rate: How often.
        model: Model of its messages or requests; None of frames, traces and tokens, and where a request is empty.
        decoded: For viewers: `always` or at most at the `limited` rate; None where nothing is shown.
        limit: Most bytes of payload and attachment of what is published or answered. What is longer is neither
            published nor received.
        request: Most bytes of a query, likewise.
        per_s: Most queries a second that a process takes from one link; what comes sooner after another is dropped.
    """

    name: str
    key: str
    carries: Literal["frame", "trace", "json", "query", "token"]
    sender: str
    rate: str
    model: type[Message] | None = None
    decoded: Literal["always", "limited"] | None = None
    limit: int = MESSAGE_BYTES
    request: int = MESSAGE_BYTES
    per_s: float = 50.0

    @property
    def recorded(self) -> bool:
        """Whether it is published from a cache and recorded: a subscriber that joins late recovers earlier messages."""
        return self.carries in ("trace", "json")

    @property
    def answered(self) -> bool:
        """Whether roles answer queries on it."""
        return self.carries == "query" or self.name in ("description", "status")

    @property
    def title(self) -> str:
        """Name of what it carries, for schemas."""
        return self.model.__name__ if self.model else self.name.capitalize()


TOPICS: Final = {
    topic.name: topic
    for topic in (
        Topic("claim", "claim", "query", "controller", "once a session", Claim, limit=POINTS_BYTES),
        Topic("release", "release", "query", "controller", "once a session", Release),
        Topic(
            "record",
            "record",
            "query",
            "controller",
            "at a session's start and on change",
            SessionRecord,
            request=POINTS_BYTES,
        ),
        Topic("arm", "arm", "query", "operator", "when needed"),
        Topic("stop", "stop", "query", "operator", "when needed"),
        Topic("stand_down", "stand-down", "query", "operator", "when needed"),
        Topic("recall", "recall", "query", "operator", "when needed"),
        Topic("show", "show", "query", "operator", "when needed", limit=POINTS_BYTES),
        Topic("set_gains", "set-gains", "query", "operator", "when needed", Gains),
        Topic("track", "track", "query", "operator", "when needed", Track, request=POINTS_BYTES),
        Topic("inject", "inject", "query", "operator", "when needed", Inject),
        Topic("advance", "advance", "query", "operator", "when needed", Advance, per_s=1000.0),
        Topic(
            "description",
            "description/{role}",
            "json",
            "every role",
            "at start and on change",
            Description,
            limit=POINTS_BYTES,
        ),
        Topic("measurement", "{session}/measurement", "frame", "plant", "every tick of a session", limit=FRAME_BYTES),
        Topic("command", "{session}/command", "frame", "controller", "answers a measurement", limit=FRAME_BYTES),
        Topic("telemetry", "telemetry", "json", "controller", "telemetry_rate", Telemetry, "limited", SAMPLE_BYTES),
        Topic("trace", "trace/{role}", "trace", "plant, controller", "trace_s", limit=POINTS_BYTES),
        Topic("reference", "reference", "json", "operator", "as it streams", Setpoint, "limited", SAMPLE_BYTES),
        Topic("truth", "truth", "json", "plant", "truth_rate", Truth, "limited", SAMPLE_BYTES),
        Topic("status", "status/{role}", "json", "every role", "1 Hz and on change", Status, "always", STATUS_BYTES),
        Topic("event", "event", "json", "every role", "when it happens", Event, "always"),
        Topic("loss", "loss", "json", "recorder", "when it is found", Loss, "always"),
        Topic("alive", "alive/{role}", "token", "every role", "while it runs"),
    )
}

RECORDED: Final = tuple(topic.name for topic in TOPICS.values() if topic.recorded)
"""Topics published from a cache."""

FRAMES: Final = tuple(topic.name for topic in TOPICS.values() if topic.carries == "frame")
"""Topics of frames."""

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


def read_key(text: str) -> Address | None:
    """Parse a key; None if it is not in the table."""
    for topic, pattern in _PATTERNS:
        if found := pattern.fullmatch(text):
            parts = found.groupdict()
            return Address(topic, parts["vehicle"], parts.get("session"), parts.get("role"))
    return None
