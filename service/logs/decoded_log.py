"""Export of a log with every message decoded at full rate, beside the raw messages.

The recorder decodes at a bounded rate to keep its files small. This export decodes every message, drops what the
recorder decoded, copies everything else, and merges the files of a rotated run into one.
"""

from __future__ import annotations

from pathlib import Path

from mcap.records import Message

from aeroloop.protocol.messages import topics
from aeroloop.service.logs.mcap_file import Damage
from aeroloop.service.logs.recording import Progress, Recording
from aeroloop.service.logs.recover import McapCopy
from aeroloop.service.viewers.channels import Decoder


def write_decoded(recording: Recording, out: Path, progress: Progress) -> tuple[int, list[str], list[str]]:
    """Write a run as one log with everything decoded; an existing file is overwritten. Raises OSError.

    Returns:
        How many messages were written, their topics, and what of the log could not be read, a line each.
    """
    decoder = Decoder(rate_hz=None)
    for description in recording.descriptions.values():
        decoder.configure(description)
    damages: list[str] = []
    size, done = sum(path.stat().st_size for path in recording.paths), 0
    with out.open("wb") as file:
        copy = McapCopy(file, "aeroloop log export")

        def report(read: int) -> None:
            progress((done + read) / size)

        def decode(topic: str, message: Message) -> None:
            """Add the decoded forms of a message, with its time of publication as log time, as the recorder does."""
            address = topics.read_key(topic)
            for one in decoder.take(address, message.data, message.publish_time) if address is not None else ():
                schema = copy.schema(one.shape.name, one.shape.encoding, one.shape.schema)
                channel = copy.channel(one.topic, one.shape.message_encoding, schema)
                copy.add(channel, one.at_ns, one.at_ns, one.data)

        for path in recording.paths:
            found: list[Damage] = []
            copy.file(path, found, report, decode, dropped=lambda topic: topic.startswith("/"))
            done += path.stat().st_size
            damages += [f"{path}: {damage.what}" for damage in found]
        copy.finish()
    if decoder.malformed:
        damages.append(f"malformed: {decoder.malformed} of what is decoded")
    return copy.messages, sorted(copy.topics), damages
