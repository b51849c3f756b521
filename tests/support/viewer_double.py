"""Viewer double without Foxglove's code: a protobuf decoder and a client of the live server.

Protobuf: https://protobuf.dev/programming-guides/encoding. The client's binary message: opcode 1, the subscription's
id (uint32), the log time in ns (uint64), all little-endian, and the message.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple, Self

from websockets.sync.client import connect
from websockets.typing import Subprotocol

from aeroloop.protocol.wire.attitude import Quaternion

SUBPROTOCOL = Subprotocol("foxglove.sdk.v1")
PATIENCE_S = 20.0  # for what comes within milliseconds on an idle machine

Fields = dict[int, list[Any]]


def fields(data: bytes) -> Fields:
    """A protobuf message: number of a field to its values, messages and strings as bytes."""
    found: Fields = {}
    for number, value in _fields(data):
        found.setdefault(number, []).append(value)
    return found


def _fields(data: bytes) -> Iterator[tuple[int, Any]]:
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        number, kind = tag >> 3, tag & 7
        value: Any
        if kind == 0:
            value, at = _varint(data, at)
        elif kind == 1:
            (value,), at = struct.unpack_from("<d", data, at), at + 8
        else:
            assert kind == 2, kind
            size, at = _varint(data, at)
            assert at + size <= len(data)
            value, at = data[at : at + size], at + size
        yield number, value


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift += 7
        at += 1
        if not data[at - 1] & 0x80:
            return value, at


def quaternion(data: bytes) -> Quaternion:
    x, y, z, w = (fields(data).get(number, [0.0])[0] for number in (1, 2, 3, 4))
    return w, x, y, z


def orientation(frame_transform: bytes) -> Quaternion:
    return quaternion(fields(frame_transform)[5][0])


class Shown(NamedTuple):
    """A message that came: when it was published [ns], and its bytes."""

    at_ns: int
    data: bytes


class Viewer:
    """A client of a server in Foxglove's protocol. A context.

    Attributes:
        info: What the server said of itself.
        channels: What it has advertised so far, by topic.
    """

    def __init__(self, url: str) -> None:
        self._connecting = connect(url, subprotocols=[SUBPROTOCOL], max_queue=None, close_timeout=0.5)
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}

    def __enter__(self) -> Self:
        self._socket = self._connecting.__enter__()
        assert self._socket.subprotocol == SUBPROTOCOL
        self.info = json.loads(self._socket.recv(PATIENCE_S))
        return self

    def __exit__(self, *_: object) -> None:
        self._connecting.__exit__(None, None, None)

    def await_topics(self, *topics: str) -> None:
        while not set(topics) <= set(self.channels):
            self._read()

    def subscribe(self, *topics: str) -> None:
        """Ask for what has been advertised; ids of subscriptions are those of channels and 1000."""
        wanted = [
            {"id": self.channels[topic]["id"] + 1000, "channelId": self.channels[topic]["id"]} for topic in topics
        ]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def first(self, topic: str) -> Shown:
        while True:
            if (message := self._read()) is not None and message[0] == topic:
                return message[1]

    def _read(self) -> tuple[str, Shown] | None:
        message = self._socket.recv(PATIENCE_S)
        if isinstance(message, bytes):
            opcode, subscription, at_ns = struct.unpack_from("<BIQ", message)
            assert opcode == 1
            return self._topics[subscription - 1000], Shown(at_ns, message[13:])
        said = json.loads(message)
        if said["op"] == "advertise":
            for channel in said["channels"]:
                self.channels[channel["topic"]] = channel
                self._topics[channel["id"]] = channel["topic"]
        return None
