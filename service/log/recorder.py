"""The recorder process: everything that crosses the network, as it crossed, into an MCAP file.

It is only a subscriber. Zenoh's thread hangs each message on a queue with the time it came; the main thread writes. A
channel per key holds the raw payloads, with the time of publication (Zenoh's timestamp) beside the time of arrival.
Every role's contract, which holds its effective configuration and the wire spec, is fetched when the role appears and
stands in the file as a message and as metadata, so that a log needs nothing else to be read.

A chunk is closed every `chunk_s`, which is the most that a crash of the recorder can cost.
"""

from __future__ import annotations

import json
import time
from collections import deque
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zenoh
from mcap.writer import CompressionType, Writer

from protocol import topics
from protocol.errors import AeroloopError
from protocol.links import published_ns
from protocol.messages import Status, model_of
from protocol.role import Role, versions
from service.log.mcap_records import CHUNK_BYTES, CONTRACT_METADATA
from service.settings import RecorderSettings

DRAIN_WAIT_S: Final = 0.02
FRAME_ENCODING: Final = "x-aeroloop-frame"
MAX_QUEUED: Final = 1_000_000


class RecorderError(AeroloopError):
    """The log cannot be written; one line that says why and what to do."""


class Taken(NamedTuple):
    """A message as it came."""

    key: str
    payload: bytes
    published_ns: int
    arrived_ns: int


class LogFile:
    """An MCAP file of raw messages, with a channel per key made on first use.

    Args:
        path: Where; its folder is made if need be.
        chunk_s: Close a chunk this often [s].

    Raises:
        RecorderError: The file cannot be made.
    """

    def __init__(self, path: Path, chunk_s: float) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise RecorderError(
                f"cannot write the log {path}: {error.strerror}; name another with --log PATH"
            ) from None
        self.path = path
        self.written = 0
        self.chunk_s = chunk_s
        self._flushed = time.monotonic_ns()
        self._channels: dict[str, tuple[int, list[int]]] = {}
        self._schemas: dict[str, int] = {}
        self._contracts: set[tuple[str, bytes]] = set()
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="aeroloop", library=f"aeroloop {versions()['aeroloop']}")

    def add(self, taken: Taken) -> None:
        """Write one message on its key's channel."""
        known = self._channels.get(taken.key)
        if known is None:
            known = self._channels[taken.key] = (self._channel(taken.key), [0])
        channel, sequence = known
        sequence[0] += 1
        self._writer.add_message(
            channel, taken.arrived_ns, taken.payload, taken.published_ns, sequence=sequence[0] & 0xFFFFFFFF
        )
        self.written += 1

    def add_contract(self, key: str, payload: bytes) -> None:
        """Write a role's contract, as a message and as metadata; once each."""
        if (key, payload) in self._contracts:
            return
        self._contracts.add((key, payload))
        now = time.time_ns()
        self.add(Taken(key, payload, now, now))
        self._writer.add_metadata(CONTRACT_METADATA, {"key": key, "json": payload.decode()})

    def flush_when_due(self) -> None:
        """Close the chunk if it has been open for `chunk_s`."""
        if time.monotonic_ns() - self._flushed >= self.chunk_s * 1e9:
            self._flushed = time.monotonic_ns()
            self._writer.flush()
            self._file.flush()

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()
        self._file.close()

    def _channel(self, key: str) -> int:
        address = topics.read_key(key)
        carries = address.topic.carries if address else "unknown"
        schema = self._schema(address.topic) if address else 0
        encoding = {"frame": FRAME_ENCODING, "unknown": "application/octet-stream"}.get(carries, "json")
        return self._writer.register_channel(topic=key, message_encoding=encoding, schema_id=schema)

    def _schema(self, topic: topics.Topic) -> int:
        if topic.model not in self._schemas:
            if topic.carries == "frame":
                encoding = FRAME_ENCODING
                text = f"{topic.model} frame: bits as in protocol/SPEC.md, by the wire spec in the plant's contract"
            else:
                encoding, text = "jsonschema", json.dumps(model_of(topic).model_json_schema())
            self._schemas[topic.model] = self._writer.register_schema(
                f"aeroloop.{topic.model}", encoding, text.encode()
            )
        return self._schemas[topic.model]


class Recorder:
    """The recorder as a process.

    Args:
        role: Its presence on the network.
        settings: Where the log goes.

    Attributes:
        path: The log's file.

    Raises:
        RecorderError: The log cannot be written.
    """

    def __init__(self, role: Role, settings: RecorderSettings) -> None:
        self._role = role
        self._queue: deque[Taken] = deque()
        self._appeared: deque[str] = deque()
        self._lost = 0
        self._status_due = 0.0
        self._status_written = 0
        self.path = settings.path or settings.directory / datetime.now().strftime("aeroloop-%Y%m%d-%H%M%S.mcap")
        self._log = LogFile(self.path, settings.chunk_s)

    def run(self) -> None:
        """Record until the role is told to stop; then take what is still on its way and close the log."""
        subscriber = self._role.zenoh.declare_subscriber(topics.EVERYTHING, self._take)
        self._role.watch_tokens(lambda name, came: self._appeared.append(name) if came else None)
        self._role.announce()
        self._role.event("started", f"recording to {self.path}")
        try:
            while not self._role.stop.is_set():
                self._role.stop.wait(DRAIN_WAIT_S)
                self._drain()
                self._role.take_inbox()
                self._fetch_contracts()
                self._publish_status_when_due()
                self._log.flush_when_due()
        finally:
            self._status_due = 0.0
            self._publish_status_when_due()
            subscriber.undeclare()
            self._drain()
            self._log.close()

    def reconfigure(self, settings: RecorderSettings) -> None:
        """Take over what can change while recording: how often a chunk is closed."""
        self._log.chunk_s = settings.chunk_s

    def _take(self, sample: zenoh.Sample) -> None:
        now = time.time_ns()
        if len(self._queue) < MAX_QUEUED:
            self._queue.append(Taken(str(sample.key_expr), sample.payload.to_bytes(), published_ns(sample, now), now))
        else:
            self._lost += 1

    def _drain(self) -> None:
        queue, add = self._queue, self._log.add
        while queue:
            add(queue.popleft())

    def _fetch_contracts(self) -> None:
        """Ask who appeared for its contract; every role answers for itself."""
        if not self._appeared:
            return
        self._appeared.clear()
        for reply in self._role.zenoh.get(topics.key("contract", "*"), timeout=1.0):
            if reply.ok is not None:
                self._log.add_contract(str(reply.ok.key_expr), reply.ok.payload.to_bytes())

    def _publish_status_when_due(self) -> None:
        now = time.monotonic()
        if now < self._status_due:
            return
        written = self._log.written
        self._role.status(
            Status(
                role=self._role.role,
                state="recording" if not self._role.stop.is_set() else "stopped",
                uptime_s=self._role.uptime_s,
                ticks=0,
                rate_hz=float(written - self._status_written),
                skipped=0,
                received=written,
                notes=[f"{self._lost} messages lost: the disk did not keep up"] if self._lost else [],
            )
        )
        self._status_written, self._status_due = written, now + 1.0
