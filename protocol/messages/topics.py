"""The one table of what crosses the network, and the keys it travels under.

Every key starts with `aeroloop/<vehicle>/`. Frames travel under the session's own keys, so that frames of another
controller, or of another wire spec, cannot arrive. A service that wants to know what a topic is looks here, and so does
the recorder.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

ROOT: Final = "aeroloop"
NAME: Final = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"
"""What a vehicle may be called: one chunk of a Zenoh key, and safe in a file name."""


@dataclass(frozen=True)
class Topic:
    """One row of the table.

    Attributes:
        name: What the rest of the program calls it.
        key: Key below `aeroloop/<vehicle>/`; `{session}` and `{role}` are filled in.
        carries: `frame` (bits, see frames.py), `trace` (batches, see trace.py), `json` (a model of messages.py),
            `query` (request and reply), `token` (liveliness, no payload).
        sender: SessionKey end speaks.
        rate: How often.
        model: The class in messages.py, or the frame's name.
    """

    name: str
    key: str
    carries: Literal["frame", "trace", "json", "query", "token"]
    sender: str
    rate: str
    model: str


TOPICS: Final = {
    topic.name: topic
    for topic in (
        Topic("claim", "claim", "query", "controller", "once a session", "Claim"),
        Topic("release", "release", "query", "controller", "once a session", "Release"),
        Topic("arm", "arm", "query", "operator", "when needed", ""),
        Topic("stop", "stop", "query", "operator", "when needed", ""),
        Topic("stand_down", "stand-down", "query", "operator", "when needed", ""),
        Topic("recall", "recall", "query", "operator", "when needed", ""),
        Topic("set_gains", "set-gains", "query", "operator", "when needed", "Gains"),
        Topic("track", "track", "query", "operator", "when needed", "Track"),
        Topic("inject", "inject", "query", "operator", "when needed", "Inject"),
        Topic("advance", "advance", "query", "operator", "when needed", "Advance"),
        Topic("description", "description/{role}", "json", "every role", "at start and on change", "Description"),
        Topic("measurement", "{session}/measurement", "frame", "plant", "every tick of a session", "Measurement"),
        Topic("command", "{session}/command", "frame", "controller", "answers a measurement", "Command"),
        Topic("telemetry", "telemetry", "json", "controller", "telemetry_rate", "Telemetry"),
        Topic("trace", "trace/{role}", "trace", "plant, controller", "trace_s", "Trace"),
        Topic("reference", "reference", "json", "operator", "as it streams", "Setpoint"),
        Topic("truth", "truth", "json", "plant", "truth_rate", "Truth"),
        Topic("status", "status/{role}", "json", "every role", "1 Hz and on change", "Status"),
        Topic("event", "event", "json", "every role", "when it happens", "Event"),
        Topic("loss", "loss", "json", "recorder", "when it is found", "Loss"),
        Topic("alive", "alive/{role}", "token", "every role", "while it lives", ""),
    )
}

RECORDED: Final = tuple(topic.name for topic in TOPICS.values() if topic.carries in ("trace", "json"))
"""Topics that are published from a cache: a subscriber that joins late recovers what it missed."""

FRAMES: Final = tuple(topic.name for topic in TOPICS.values() if topic.carries == "frame")
"""Topics of the loop itself."""

_PATTERNS: Final = [
    (
        topic,
        re.compile(
            rf"{ROOT}/(?P<vehicle>{NAME})/"
            + topic.key.replace("{session}", r"(?P<session>[^/]+)").replace("{role}", r"(?P<role>[^/]+)")
        ),
    )
    for topic in TOPICS.values()
]


class Address(NamedTuple):
    """What a key says: the topic, and whose."""

    topic: Topic
    vehicle: str
    session: str | None
    role: str | None


def key(name: str, vehicle: str, *, session: str = "*", role: str = "*") -> str:
    """The key of a topic of one vehicle; what is left out becomes a wildcard. Raises KeyError for an unknown topic."""
    return f"{ROOT}/{vehicle}/{TOPICS[name].key.format(session=session, role=role)}"


def read_key(text: str) -> Address | None:
    """What a key is about, or None if it is not in the table."""
    for topic, pattern in _PATTERNS:
        if found := pattern.fullmatch(text):
            parts = found.groupdict()
            return Address(topic, parts["vehicle"], parts.get("session"), parts.get("role"))
    return None
