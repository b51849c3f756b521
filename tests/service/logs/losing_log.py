"""A log of which the recorder has lost something: two sessions, with telemetry and truth beside their frames."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader
from mcap.writer import Writer

from protocol import topics
from protocol.messages import Telemetry, Truth
from service.config import Settings
from service.logs.files import LogFiles
from tests.service.logs.made_log import SESSION, START_NS, VEHICLE, make_log

PERIOD_NS = 2_000_000
TICKS = 400
LOST = range(100, 148)
"""Neither their measurements nor their commands were recorded: three times round the counter."""
UNANSWERED = range(200, 204)
"""Only their commands are missing."""
TRUTHS = [START_NS + k * PERIOD_NS + (k % 3) * 1_000_000 - 1_000_000 for k in range(20, TICKS, 10)]
"""When the truth was published: a millisecond before a tick's measurement, with it, and a millisecond after it."""
SHORT = "s2"
"""A second session, of 50 ticks."""


class Read(NamedTuple):
    """A message as the mcap package's reader has it."""

    topic: str
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


def read(path: Path) -> list[Read]:
    with path.open("rb") as file:
        return [
            Read(channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        ]


def write(path: Path, messages: list[tuple[str, int, bytes]], contract: str) -> None:
    """A log of (topic, time, content)."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata(
            "aeroloop.contract", {"key": topics.key("contract", VEHICLE, role="plant"), "json": contract}
        )
        channels: dict[str, int] = {}
        for i, (topic, at_ns, data) in enumerate(sorted(messages, key=lambda message: message[1])):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", 0)
            writer.add_message(channels[topic], at_ns + 5, data, at_ns, i)
        writer.finish()


def make_losing_log(folder: Path, settings: Settings) -> Path:
    """Write it as `log.mcap`."""
    make_log(folder / "made.mcap", TICKS, settings=settings)
    frames = {topics.key(name, VEHICLE, session=SESSION): name for name in ("measurement", "command")}
    messages = []
    for message in read(folder / "made.mcap"):
        tick = (message.publish_time - START_NS) // PERIOD_NS
        name = frames.get(message.topic)
        if not (name and tick in LOST) and not (name == "command" and tick in UNANSWERED):
            messages.append((message.topic, message.publish_time, message.data))
        if name and tick < 50:  # again an hour later, as another session
            key = topics.key(name, VEHICLE, session=SHORT)
            messages.append((key, message.publish_time + 3_600_000_000_000, message.data))
        elif message.topic == topics.key("telemetry", VEHICLE) and tick < 50:
            told = Telemetry.model_validate_json(message.data).model_copy(update={"session": SHORT})
            messages.append((message.topic, message.publish_time + 3_600_000_000_000, told.encode()))
    for i, at_ns in enumerate(TRUTHS):
        truth = Truth(tick=i, attitude=(0.5, 0.5, 0.5, 0.5), rate=(float(i), 0.0, 0.0), voltages=(1.0, -1.0))
        messages.append((topics.key("truth", VEHICLE), at_ns, truth.encode()))
    contract = next(iter(LogFiles([folder / "made.mcap"]).contracts.values()))
    write(folder / "log.mcap", messages, contract.model_dump_json())
    (folder / "made.mcap").unlink()
    return folder / "log.mcap"
