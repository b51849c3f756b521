"""Export of a log with every message decoded at full rate, beside the raw messages.

The recorder decodes at a bounded rate to keep its files small. This export decodes every message, drops what the
recorder decoded, copies everything else, and merges the files of a rotated run into one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from mcap.records import Message

from aeroloop.protocol.messages import topics
from aeroloop.service.logs.files import LogFiles
from aeroloop.service.logs.mcap_copy import Follow, McapCopy
from aeroloop.service.logs.mcap_file import Damage
from aeroloop.service.viewers.channels import Decoder


class Written(NamedTuple):
    """Messages and topics written, and what of the log could not be read, a line each."""

    messages: int
    topics: list[str]
    damages: list[str]


def write_decoded(files: LogFiles, out: Path, progress: Callable[[float], None]) -> Written:
    """Write a run as one log with everything decoded; an existing file is overwritten.

    Calls `progress` repeatedly with the share done, 0…1. Raises OSError if a file cannot be read or written.
    """
    decoder = Decoder(rate_hz=None)
    for description in files.descriptions.values():
        decoder.configure(description)
    damages: list[str] = []
    sizes = [path.stat().st_size for path in files.paths]
    with out.open("wb") as file:
        copy = McapCopy(file, "aeroloop log export")
        done = 0

        def report(read: int) -> None:
            progress((done + read) / sum(sizes))

        def follow(topic: str) -> Follow | None:
            """None for topics that the recorder decoded: they begin with a slash, as no key can."""
            return None if topic.startswith("/") else partial(_decode, copy, decoder, topics.read_key(topic))

        for path, size in zip(files.paths, sizes, strict=True):
            found: list[Damage] = []
            copy.file(path, found, report, follow)
            done += size
            damages += [f"{path}: {damage.what}" for damage in found]
        copy.finish()
    return Written(copy.messages, sorted(copy.topics), damages)


def _decode(copy: McapCopy, decoder: Decoder, address: topics.Address | None, message: Message) -> None:
    """Add the decoded forms of a message, with its time of publication as log time, as the recorder does."""
    if address is None:
        return
    for decoded in decoder.take(address, message.data, message.publish_time):
        shape = decoded.shape
        schema = copy.schema(shape.name, shape.encoding, shape.schema)
        channel = copy.channel(decoded.topic, shape.message_encoding, schema)
        copy.add(channel, decoded.at_ns, decoded.at_ns, decoded.data)
