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
    """Messages and topics written, and damages of the log by file."""

    messages: int
    topics: list[str]
    damages: dict[Path, list[Damage]]


def write_decoded(files: LogFiles, out: Path, progress: Callable[[float], None]) -> Written:
    """Write a run as one log with everything decoded.

    Args:
        files: The run.
        out: The new file; an existing one is overwritten.
        progress: Called repeatedly with the share done, 0…1.

    Raises:
        OSError: A file cannot be read or written.
    """
    decoder = Decoder(rate_hz=None)
    for description in files.descriptions.values():
        decoder.configure(description)
    damages: dict[Path, list[Damage]] = {}
    sizes = [path.stat().st_size for path in files.paths]
    with out.open("wb") as file:
        copy = McapCopy(file, "aeroloop log export")

        def follow(topic: str) -> Follow | None:
            """None for topics that the recorder decoded: they begin with a slash, as no key can."""
            return None if topic.startswith("/") else partial(_decode, copy, decoder, topics.read_key(topic))

        for i, path in enumerate(files.paths):
            found: list[Damage] = []
            done = sum(sizes[:i])
            copy.file(path, found, lambda read, done=done: progress((done + read) / sum(sizes)), follow)  # type: ignore[misc]  # the default binds it
            if found:
                damages[path] = found
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
